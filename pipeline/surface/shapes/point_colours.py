"""Colours of points from all photos that see them, weighted by resolution; each photo is read once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.surface.depths.exposures import COMPARED_POINTS, exposure_levels
from splatpipe.pipeline.surface.depths.photo_gains import PhotoGains
from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource, load_pixels
from splatpipe.pipeline.surface.depths.photo_set import PhotoSet, SurfacePieces, unproject_pixels, view_pieces
from splatpipe.pipeline.surface.depths.point_visibility import project_points
from splatpipe.pipeline.surface.depths.sources import LruCache, PosedDepthMap

# A photo's weight falls with this power of its footprint: with pixels twice as large, it is a sixteenth.
FOOTPRINT_POWER = 4
EDGE_WEIGHT = 0.01  # weight where an adjacent pixel of the depths shows a nearer surface: its colour may be mixed in
BATCH = 1 << 17  # points at a time
CACHE_BYTES = 300 << 20  # depths in memory


def photo_set(sources: Sequence[PhotoSource], cell_m: float, threads: int) -> PhotoSet:
    """Photos with levelled exposures.

    Args:
        sources: Photos in local metres, always in the same order.
        cell_m: Resolution at which they colour a product, metres.
        threads: Photos in parallel.
    """
    photos = PhotoSet(sources, PhotoGains.plain(len(sources)), LruCache(CACHE_BYTES))
    numbers = photos.with_depths()
    most = -(-COMPARED_POINTS // max(len(numbers), 1))
    places = [_sample_positions(photos.depth_map(number), most) for number in numbers]
    every = np.concatenate([np.zeros((0, 3)), *places])
    return replace(photos, levels=exposure_levels(sources, every, 2.0 * cell_m, threads))


def without_depths(photos: PhotoSet) -> PhotoSet:
    """The same photos with none of their depths in memory."""
    return replace(photos, depths=LruCache(CACHE_BYTES))


def _sample_positions(found: PosedDepthMap, most: int) -> Float64[np.ndarray, "n 3"]:
    """Evenly sampled points of a photo's depths."""
    height, width = found.depth.shape
    step = max(1, int((height * width / most) ** 0.5))
    row, column = (grid.ravel() for grid in np.mgrid[step // 2 : height : step, step // 2 : width : step])
    depth = found.depth[row, column].astype(np.float64)
    known = depth > 0.0
    return np.ascontiguousarray(unproject_pixels(found.camera, row[known], column[known], 1.0 / depth[known]).T)


@dataclass(frozen=True, eq=False)
class _PhotoColours:
    """Colours that one photo contributes.

    Attributes:
        rows: Rows of the points that it sees.
        colour: Their colours in the photo.
        weight: Their weights.
    """

    rows: Int64[np.ndarray, " k"]
    colour: UInt8[np.ndarray, "k 3"]
    weight: Float32[np.ndarray, " k"]


def point_colours(
    photos: PhotoSet, pieces: SurfacePieces, cell_m: float, threads: int
) -> tuple[UInt8[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Weighted mean colour of points over the photos that see them, and which are seen at all; black if unseen.

    Args:
        photos: Photos with their depths.
        pieces: The points.
        cell_m: Size of the area whose colour a point gets, metres.
        threads: Photos in parallel.

    Raises:
        ValueError: if depths or pixels do not fit their camera.
    """
    size = pieces.xyz.shape[1]
    total, weights = np.zeros((size, 3), np.float32), np.zeros(size, np.float32)
    for offer in ordered_map(partial(_colours_from, photos, pieces, cell_m), photos.with_depths(), threads):
        total[offer.rows] += offer.weight[:, None] * offer.colour
        weights[offer.rows] += offer.weight
    known = weights > 0.0
    mean = total / np.where(known, weights, np.float32(1.0))[:, None]
    return np.clip(np.round(mean), 0, 255).astype(np.uint8), known


def _colours_from(photos: PhotoSet, pieces: SurfacePieces, cell_m: float, number: int) -> _PhotoColours:
    seen = [
        (start + rows, weight)
        for start in range(0, pieces.xyz.shape[1], BATCH)
        for rows, weight in [_visible_rows(photos, number, pieces.select(np.s_[start : start + BATCH]), cell_m)]
    ]
    rows = np.concatenate([np.zeros(0, np.int64), *(each for each, _ in seen)])
    weight = np.concatenate([np.zeros(0, np.float32), *(each for _, each in seen)])
    if not rows.size:
        return _PhotoColours(rows, np.zeros((0, 3), np.uint8), weight)
    source = photos.sources[number]
    pixels, _ = load_pixels(source)
    east, north, up = pieces.xyz[:, rows]
    colour = photos.levels.sample(number, (source, pixels), (east, north, up), np.ones(len(rows), np.bool_), cell_m)
    return _PhotoColours(rows, colour, weight)


def _visible_rows(
    photos: PhotoSet, number: int, pieces: SurfacePieces, cell_m: float
) -> tuple[Int64[np.ndarray, " k"], Float32[np.ndarray, " k"]]:
    """Rows of the points that a photo sees, and the weights of its colours."""
    camera = photos.sources[number].camera
    rows = np.flatnonzero(project_points(camera, *pieces.xyz).inside)
    if not rows.size:
        return rows, np.zeros(0, np.float32)
    found = photos.depth_map(number)
    view = view_pieces(found.camera, pieces.select(rows))
    facing = np.flatnonzero(np.isfinite(view.footprint))
    visibility = view.classify(found, facing)
    coarse = np.maximum(view.footprint[facing] / cell_m, 0.1)  # finer ones are no better, and powers stay finite
    weight = np.where(visibility.seen, np.where(visibility.mixed, EDGE_WEIGHT, 1.0), 0.0) / coarse**FOOTPRINT_POWER
    kept = weight > 0.0
    return rows[facing[kept]], weight[kept].astype(np.float32)
