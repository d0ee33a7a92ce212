"""The photos that may colour each triangle of a mesh, what each costs, and the colours that they show there.

Costs are the orthophoto's (``rate_points``): oblique and coarse views, the rims of photos and uncertain depths cost
more. It rates views of level ground, so each triangle is turned until its normal points up, in one of a few hundred
directions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int16, Int64, UInt8, UInt16

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.depths.photo_samples import (
    PLAIN_TONE,
    load_pixels,
    rate_points,
    sample_colours,
)
from splatpipe.pipeline.surface.depths.photo_set import MIN_COSINE, PhotoSet, SurfacePieces, view_pieces
from splatpipe.pipeline.surface.depths.point_visibility import classify_points
from splatpipe.pipeline.surface.ortho.mosaic import MAX_CANDIDATES
from splatpipe.pipeline.surface.shapes.triangles import TriangleMesh

HIDDEN = 4000  # cost of a photo that does not see a place, and the largest cost, as in the orthophoto's kernels
NONE = -1  # instead of a photo
SAMPLES = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]]) / np.array([[3.0], [6.0], [6.0], [6.0]])
DIRECTIONS = 256  # of normals: neighbours are some 13 degrees apart
GOLDEN_ANGLE = np.pi * (3.0 - 5.0**0.5)  # between consecutive directions (Vogel's spiral on the sphere)
WHITE, BLACK = 250, 5  # grey levels beyond which there is no detail
CLIPPED_COST = 400.0  # cost of a photo that is over- or underexposed at a place, thousandths
COARSE_COST = 500.0  # cost of a photo half as sharp as the others: as of one with pixels twice as large
LEAST_SHARP = 0.2  # sharpness below which the cost no longer grows
SHARP_ENOUGH = 0.9  # sharpness of a photo, relative to the others, that costs nothing
MIN_COMPARED = 200  # triangles at which a photo's sharpness is measured; with fewer, it counts as sharp


@dataclass(frozen=True, eq=False)
class FaceViews:
    """The best photos of each triangle, by number; empty places come last.

    Attributes:
        photo: Their numbers, ``NONE`` where there are no more.
        cost: Cost of each, thousandths; ``HIDDEN`` where there is none.
        colour: Levelled mean colour of the triangle in each photo; black where there is none.
    """

    photo: Int16[np.ndarray, "m k"]
    cost: Float32[np.ndarray, "m k"]
    colour: UInt8[np.ndarray, "m k 3"]


@dataclass(frozen=True, eq=False)
class FaceSamples:
    """Triangles as photos are asked about them, in the order of their directions.

    Attributes:
        order: Row of each one in the mesh.
        starts: Where each direction begins in this order, and the end.
        turns: Rotation of each direction to up.
        points: Four places on each triangle, its centre first: east, north, up.
        normal: Unit normals, smoothed over their surroundings.
    """

    order: Int64[np.ndarray, " m"]
    starts: Int64[np.ndarray, " _"]
    turns: Float64[np.ndarray, "d 3 3"]
    points: Float64[np.ndarray, "4 3 m"]
    normal: Float64[np.ndarray, "3 m"]


def sample_faces(mesh: TriangleMesh) -> FaceSamples:
    """Prepare a mesh's triangles to be rated."""
    normal = mesh.normals()[mesh.triangles].sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    directions = _directions()
    nearest = np.empty(len(normal), np.int64)
    for start in range(0, len(normal), 1 << 16):
        part = np.s_[start : start + (1 << 16)]
        alike = sum(normal[part, axis, None] * directions[None, :, axis] for axis in range(3))
        nearest[part] = np.argmax(alike, axis=1)
    order = np.argsort(nearest, kind="stable")
    starts = np.searchsorted(nearest[order], np.arange(DIRECTIONS + 1))
    corners = mesh.vertices[mesh.triangles[order]]
    points = np.empty((len(SAMPLES), 3, len(order)))
    for place, weights in zip(points, SAMPLES, strict=True):
        place[:] = (weights[0] * corners[:, 0] + weights[1] * corners[:, 1] + weights[2] * corners[:, 2]).T
    turns = np.stack([_turn_up(direction) for direction in directions])
    return FaceSamples(order, starts, turns, points, np.ascontiguousarray(normal[order].T))


def _directions() -> Float64[np.ndarray, "d 3"]:
    number = np.arange(DIRECTIONS)
    up = 1.0 - (2.0 * number + 1.0) / DIRECTIONS
    away, angle = np.sqrt(1.0 - up * up), GOLDEN_ANGLE * number
    return np.stack([away * np.cos(angle), away * np.sin(angle), up], axis=1)


def _turn_up(direction: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """The rotation that turns a direction to up."""
    side = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = np.cross(side, direction)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first), direction])


@dataclass(frozen=True, eq=False)
class FaceRating:
    """What a photo costs on triangles.

    Attributes:
        rows: Their places in ``FaceSamples``' order.
        cost: Mean cost of their samples, thousandths.
        seen: Whether the photo's depths confirm that it sees the centre; if not, it may be hidden there, or unknown.
    """

    rows: Int64[np.ndarray, " k"]
    cost: UInt16[np.ndarray, " k"]
    seen: Bool[np.ndarray, " k"]


def rate_faces(photos: PhotoSet, faces: FaceSamples, cell_m: float, threads: int, report: Reporter) -> FaceViews:
    """Find the photos that see each triangle best; bit-identical for any number of threads.

    Args:
        photos: Photos with depths and gains.
        faces: The triangles.
        cell_m: Resolution that photos are to have on them, metres.
        threads: Photos in parallel.
        report: Receives progress.

    Raises:
        ValueError: if depths or pixels do not fit their camera.
    """
    size = len(faces.order)
    photo = np.full((size, MAX_CANDIDATES), NONE, np.int16)
    cost = np.full((size, MAX_CANDIDATES), HIDDEN, np.uint16)
    numbers = photos.with_depths()
    rate = partial(_rate_photo, photos, faces, cell_m)
    for done, (number, rating) in enumerate(zip(numbers, ordered_map(rate, numbers, threads), strict=True), start=1):
        held = cost[rating.rows]
        worst = held.argmax(axis=1)
        better = np.flatnonzero(rating.cost < np.take_along_axis(held, worst[:, None], axis=1)[:, 0])
        at = rating.rows[better], worst[better]
        cost[at], photo[at] = rating.cost[better], number
        report.progress(done, 2 * len(numbers), "choosing photos for the mesh", "photos")
    order = np.argsort(np.where(photo == NONE, np.iinfo(np.int16).max, photo), axis=1, kind="stable")
    photo, cost = np.take_along_axis(photo, order, axis=1), np.take_along_axis(cost, order, axis=1)
    found = _with_colours(photos, faces, (photo, cost), cell_m, _Steps(threads, report))
    back = np.empty(size, np.int64)
    back[faces.order] = np.arange(size)
    return FaceViews(found.photo[back], found.cost[back], found.colour[back])


def _rate_photo(photos: PhotoSet, faces: FaceSamples, cell_m: float, number: int) -> FaceRating:
    """The triangles that a photo sees."""
    view = view_pieces(photos.sources[number].camera, SurfacePieces(faces.points[0], faces.normal))
    rows = np.flatnonzero(np.isfinite(view.footprint) & (view.place.sine > MIN_COSINE))
    found = rate_rows(photos, faces, cell_m, number, rows)
    return FaceRating(found.rows[found.seen], found.cost[found.seen], found.seen[found.seen])


def rate_rows(
    photos: PhotoSet, faces: FaceSamples, cell_m: float, number: int, rows: Int64[np.ndarray, " k"]
) -> FaceRating:
    """Rate a photo on some triangles.

    Args:
        photos: Photos with depths.
        faces: The triangles.
        cell_m: Resolution that photos are to have on them, metres.
        number: The photo.
        rows: Places in the triangles' order, increasing.
    """
    camera, found = photos.sources[number].camera, photos.depth_map(number)
    view = view_pieces(camera, SurfacePieces(faces.points[0][:, rows], faces.normal[:, rows]))
    sines = np.ascontiguousarray(view.place.sine)
    total, seen = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.bool_)
    centre = np.zeros(len(rows), np.uint16)
    ends = np.searchsorted(rows, faces.starts)
    for number_of_sample, points in enumerate(faces.points):
        east, north, up = points[:, rows]
        flags = classify_points(found, (east, north, up), 0.0, sines).flags
        for turn, start, end in zip(faces.turns, ends[:-1], ends[1:], strict=True):
            part = np.s_[start:end]
            if start == end:
                continue
            x, y, z = (turn[k, 0] * east[part] + turn[k, 1] * north[part] + turn[k, 2] * up[part] for k in range(3))
            cost, visible = rate_points(_turned(camera, turn), (x, y, z), cell_m, flags[part])
            total[part] += cost
            if number_of_sample == 0:
                seen[part], centre[part] = visible, cost
    facing = np.isfinite(view.footprint) & (view.place.sine > MIN_COSINE) & (centre < HIDDEN)
    return FaceRating(rows, np.where(facing, total // len(SAMPLES), HIDDEN).astype(np.uint16), seen & facing)


def _turned(camera: Camera, turn: Float64[np.ndarray, "3 3"]) -> Camera:
    """The camera in a frame whose axes are the rows of ``turn``."""
    back = np.eye(4)
    back[:3, :3] = turn.T
    return replace(camera, cam_from_world=camera.cam_from_world @ back)


@dataclass(frozen=True)
class _Steps:
    """How many photos are read in parallel, and who is told."""

    threads: int
    report: Reporter


@dataclass(frozen=True, eq=False)
class _Colours:
    """What a photo shows on triangles: places in ``FaceSamples``' order and in their lists, and there the levelled
    colour, the contrast between its samples in grey levels, and whether light or dark areas are clipped."""

    rows: Int64[np.ndarray, " k"]
    places: Int64[np.ndarray, " k"]
    colour: UInt8[np.ndarray, "k 3"]
    contrast: Float32[np.ndarray, " k"]
    clipped: Bool[np.ndarray, " k"]


def _with_colours(
    photos: PhotoSet, faces: FaceSamples, held: tuple[np.ndarray, np.ndarray], cell_m: float, steps: _Steps
) -> FaceViews:
    photo, cost = held[0], held[1].astype(np.float32)
    colour, contrast = np.zeros((*photo.shape, 3), np.uint8), np.full(photo.shape, np.nan, np.float32)
    numbers = photos.with_depths()
    for done, each in enumerate(_colours_by_photo(photos, faces, photo, cell_m, steps.threads), start=1):
        at = each.rows, each.places
        colour[at], contrast[at] = each.colour, each.contrast
        cost[at] += np.where(each.clipped, np.float32(CLIPPED_COST), np.float32(0.0))
        steps.report.progress(len(numbers) + done, 2 * len(numbers), "choosing photos for the mesh", "photos")
    blur = _blur_costs(photo, contrast, len(photos.sources))
    cost += np.where(photo == NONE, np.float32(0.0), blur[photo])
    return FaceViews(photo, np.minimum(cost, np.float32(HIDDEN)), colour)


def _colours_by_photo(
    photos: PhotoSet, faces: FaceSamples, photo: np.ndarray, cell_m: float, threads: int
) -> Iterator[_Colours]:
    return ordered_map(partial(_colours_of, photos, faces, photo, cell_m), photos.with_depths(), threads)


def _colours_of(photos: PhotoSet, faces: FaceSamples, photo: np.ndarray, cell_m: float, number: int) -> _Colours:
    rows, places = np.nonzero(photo == number)
    source = photos.sources[number]
    if not rows.size:
        return _Colours(rows, places, np.zeros((0, 3), np.uint8), np.zeros(0, np.float32), np.zeros(0, np.bool_))
    pixels, _ = load_pixels(source)
    every = np.ones(len(rows), np.bool_)
    samples = []
    for points in faces.points:
        east, north, up = points[:, rows]
        samples.append(photos.levels.sample(number, (source, pixels), (east, north, up), every, cell_m))
    east, north, up = faces.points[0][:, rows]
    plain = sample_colours(source, pixels, (east, north, up), every, cell_m, PLAIN_TONE)
    clipped = np.asarray((plain >= WHITE).all(axis=1) | (plain <= BLACK).all(axis=1))
    shown = np.stack(samples).astype(np.int32)
    grey = shown.sum(axis=2)  # three times the grey level
    contrast = (grey.max(axis=0) - grey.min(axis=0)).astype(np.float32) / np.float32(3.0)
    mean = (shown.sum(axis=0) + len(samples) // 2) // len(samples)
    return _Colours(rows, places, mean.astype(np.uint8), contrast, clipped)


def _blur_costs(photo: np.ndarray, contrast: np.ndarray, photos: int) -> Float32[np.ndarray, " n"]:
    """What each photo costs for being less sharp than the others where they show the same triangles."""
    known = np.isfinite(contrast)
    count = known.sum(axis=1)
    shared = known & (count >= 3)[:, None]
    total = np.where(known, contrast, np.float32(0.0)).sum(axis=1, dtype=np.float64)
    others = (total[:, None] - np.where(known, contrast, 0.0)) / np.maximum(count - 1, 1)[:, None]
    number = photo[shared].astype(np.int64)
    own, theirs = (np.bincount(number, each[shared], photos) for each in (contrast.astype(np.float64), others))
    enough = np.bincount(number, minlength=photos) >= MIN_COMPARED
    sharpness = np.where(enough, np.round(own / np.maximum(theirs, 1e-9), 4), 1.0)
    sharpness = np.clip(sharpness / SHARP_ENOUGH, LEAST_SHARP, 1.0)
    return (COARSE_COST * (1.0 / sharpness - 1.0)).astype(np.float32)
