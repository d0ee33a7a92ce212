"""The sparse model in world coordinates: camera positions, ground footprints and overlap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.geometry.lens_projection import project_through_lens
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.photos.colmap.colmap_reconstruction import read_reconstruction

BORDER_STEPS = 6  # rays along each side of an image, for its footprint
GROUND_PERCENTILE = 5.0  # percentile of the sparse points' heights taken as ground: roofs and walls are above
REACH_PERCENTILE = 95.0  # percentile of the distances to a photo's own points that limits its footprint
REACH_POINTS = 20_000  # points used for that: all of them, for hundreds of photos, would take seconds
MIN_DROP = 0.02  # least drop over a ray's length: flatter rays meet the ground beyond the reach
BOX_PERCENTILES = (4.0, 96.0)  # percentiles of the sparse points that bound the scene: some lie far behind it
BOX_MARGIN = 0.15  # border around the box, as a share of its longer side
GRID_CELLS = 240  # along the longer side of the overlap map
FIELD_CELLS = 16  # along the longer side of an image, for the mean residuals
FIELD_PHOTOS = 24  # photos used for them: enough observations, and more would take seconds
MIN_IN_CELL = 5  # observations needed for a meaningful mean


@dataclass(frozen=True)
class RegisteredPhotos:
    """The registered photos, sorted by name.

    Attributes:
        names: The photos' names.
        centres: Camera centres, world units.
        axes: Unit viewing directions in the world.
        points: Number of sparse points each observes.
        footprints: Outline of each ground footprint, east and north, cut off at the photo's reach.
    """

    names: Sequence[str]
    centres: Float64[np.ndarray, "n 3"]
    axes: Float64[np.ndarray, "n 3"]
    points: Int64[np.ndarray, " n"]
    footprints: Sequence[Float64[np.ndarray, "_ 2"]]


@dataclass(frozen=True)
class ResidualField:
    """Mean residuals of the sparse points by position in one camera's images.

    Attributes:
        size: Image width and height, pixels.
        places: Centre of each cell, pixels.
        residuals: Mean of projected minus observed in each cell, pixels.
    """

    size: tuple[int, int]
    places: Float64[np.ndarray, "c 2"]
    residuals: Float64[np.ndarray, "c 2"]


@dataclass(frozen=True)
class OverlapGrid:
    """The number of footprints that cover each place.

    Attributes:
        counts: Number of footprints per cell, northernmost row first; 0 outside all.
        box: West, east, south, north.
        shares: Share of the cells with sparse points covered by at least n footprints, by n.
    """

    counts: Int64[np.ndarray, "h w"]
    box: tuple[float, float, float, float]
    shares: Mapping[int, float]


@dataclass(frozen=True)
class Geometry:
    """The geometry of the sparse model.

    Attributes:
        photos: The registered photos.
        points: Sparse points in the world, (n, 3).
        colours: Their RGB colours, 0 to 255.
        tracks: Track length of each point.
        errors_px: Mean reprojection error of each point; NaN if unknown.
        box: West, east, south, north of the scene.
        ground: Height of the ground.
        overlap: The overlap grid.
        fields: Residual fields of the cameras with enough observations.
    """

    photos: RegisteredPhotos
    points: Float64[np.ndarray, "m 3"]
    colours: Int64[np.ndarray, "m 3"]
    tracks: Int64[np.ndarray, " m"]
    errors_px: Float64[np.ndarray, " m"]
    box: tuple[float, float, float, float]
    ground: float
    overlap: OverlapGrid
    fields: Sequence[ResidualField]


def read_geometry(model_path: Path, frame_path: Path | None) -> Geometry:
    """Read a sparse model and transform it to world coordinates.

    Args:
        model_path: Its folder.
        frame_path: `frame.json`; None leaves the model in its own frame.

    Raises:
        OSError, ValueError, SplatpipeError: if it is empty or any part cannot be read.
    """
    similarity = Similarity.from_matrix(np.eye(4)) if frame_path is None else _similarity(frame_path)
    model = read_reconstruction(model_path)
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    numbers = sorted(model.points3D)
    if not images or not numbers:
        raise ValueError("the sparse model is empty")
    listed = [model.points3D[number] for number in numbers]
    points = similarity.apply(np.array([point.xyz for point in listed], np.float64))
    errors = np.array([point.error for point in listed], np.float64)
    box, ground = _box(points), float(np.percentile(points[:, 2], GROUND_PERCENTILE))
    photos = _photos(images, points, similarity, ground)
    return Geometry(
        photos=photos,
        points=points,
        colours=np.array([point.color for point in listed], np.int64),
        tracks=np.array([point.track.length() for point in listed], np.int64),
        errors_px=np.where(errors >= 0.0, errors, np.nan),
        box=box,
        ground=ground,
        overlap=_overlap(photos.footprints, points, box),
        fields=_fields(model, images),
    )


def _similarity(path: Path) -> Similarity:
    value: dict[str, Any] = read_json(path)
    return Similarity.from_matrix(np.array(value["world_from_model"], np.float64).reshape(4, 4))


def _box(points: Float64[np.ndarray, "m 3"]) -> tuple[float, float, float, float]:
    low, high = np.percentile(points[:, :2], BOX_PERCENTILES, axis=0)
    margin = BOX_MARGIN * float(max(high - low))
    return float(low[0]) - margin, float(high[0]) + margin, float(low[1]) - margin, float(high[1]) + margin


def _photos(
    images: Sequence[pycolmap.Image], points: Float64[np.ndarray, "m 3"], similarity: Similarity, ground: float
) -> RegisteredPhotos:
    poses = np.stack([np.asarray(image.cam_from_world().matrix(), np.float64) for image in images])
    world_from_cam = similarity.rotation @ poses[:, :, :3].transpose(0, 2, 1)
    centres = similarity.apply(-np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3]))
    middle = np.median(points, axis=0)
    some = points[:: max(1, len(points) // REACH_POINTS)]
    footprints = []
    for image, centre, rotation in zip(images, centres, world_from_cam, strict=True):
        reach = _reach(some, centre, rotation, float(np.linalg.norm(middle - centre)))
        footprints.append(_footprint(_border_rays(image.camera) @ rotation.T, centre, ground, reach))
    counts = np.array([image.num_points3D for image in images], np.int64)
    return RegisteredPhotos([image.name for image in images], centres, world_from_cam[:, :, 2], counts, footprints)


def _reach(
    points: Float64[np.ndarray, "m 3"],
    centre: Float64[np.ndarray, " 3"],
    rotation: Float64[np.ndarray, "3 3"],
    otherwise: float,
) -> float:
    """A photo's reach: the distance to most points within its view, approximated by a cone of 30° about its axis."""
    to_point = points - centre
    distances = np.linalg.norm(to_point, axis=1)
    inside = to_point @ rotation[:, 2] > np.cos(np.radians(30.0)) * distances
    return float(np.percentile(distances[inside], REACH_PERCENTILE)) if inside.any() else otherwise


def _border_rays(camera: pycolmap.Camera) -> Float64[np.ndarray, "b 3"]:
    """Rays through an image's border: x / z, y / z, 1."""
    steps = np.arange(BORDER_STEPS) / BORDER_STEPS
    ones, zeros = np.ones(BORDER_STEPS), np.zeros(BORDER_STEPS)
    sides = [(steps, zeros), (ones, steps), (1.0 - steps, ones), (zeros, 1.0 - steps)]
    border = np.concatenate([np.stack(side, axis=1) for side in sides]) * (camera.width, camera.height)
    rays = np.asarray(camera.cam_from_img(border), np.float64)
    return np.concatenate([rays[:, :2], np.ones((len(rays), 1))], axis=1)


def _footprint(
    rays: Float64[np.ndarray, "b 3"], centre: Float64[np.ndarray, " 3"], ground: float, reach: float
) -> Float64[np.ndarray, "b 2"]:
    """Points where the rays meet the ground, or end at the photo's reach."""
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    height = centre[2] - ground
    falls = (unit[:, 2] < -MIN_DROP) & (height > 0.0)
    lengths = np.where(falls, height / np.maximum(-unit[:, 2], MIN_DROP), reach)
    return np.asarray(centre[:2] + np.minimum(lengths, reach)[:, None] * unit[:, :2])


def _overlap(
    footprints: Sequence[Float64[np.ndarray, "_ 2"]],
    points: Float64[np.ndarray, "m 3"],
    box: tuple[float, float, float, float],
) -> OverlapGrid:
    west, east, south, north = box
    cell = max(east - west, north - south) / GRID_CELLS or 1.0
    columns, rows = max(1, round((east - west) / cell)), max(1, round((north - south) / cell))
    counts = np.zeros((rows, columns), np.int64)
    for outline in footprints:
        if np.isfinite(outline).all():
            cells = np.stack([(outline[:, 0] - west) / cell, (north - outline[:, 1]) / cell], axis=1)
            layer = np.zeros((rows, columns), np.uint8)
            cv2.fillPoly(layer, [np.clip(np.round(cells), -30000, 30000).astype(np.int32)], 1)
            counts += layer
    across = np.floor((points[:, 0] - west) / cell).astype(np.int64)
    down = np.floor((north - points[:, 1]) / cell).astype(np.int64)
    inside = (across >= 0) & (across < columns) & (down >= 0) & (down < rows)
    there = np.unique(down[inside] * columns + across[inside])
    seen = counts.ravel()[there]
    shares = {least: float((seen >= least).mean()) if len(seen) else 0.0 for least in (1, 3, 5)}
    return OverlapGrid(counts, box, shares)


def _fields(model: pycolmap.Reconstruction, images: Sequence[pycolmap.Image]) -> list[ResidualField]:
    step = max(1, len(images) // FIELD_PHOTOS)
    by_camera: dict[int, list[tuple[Any, Any]]] = {}
    for image in images[::step]:
        seen = image.get_observation_points2D()
        if len(seen):
            observed = np.array([point.xy for point in seen], np.float64)
            xyz = np.array([model.points3D[point.point3D_id].xyz for point in seen], np.float64)
            pose = np.asarray(image.cam_from_world().matrix(), np.float64)
            projected, _ = project_through_lens(image.camera, pose, xyz)
            by_camera.setdefault(image.camera_id, []).append((observed, projected - observed))
    fields = []
    for number, seen in sorted(by_camera.items()):
        camera = model.cameras[number]
        observed, residuals = (np.concatenate([pair[which] for pair in seen]) for which in (0, 1))
        fields.append(_field((camera.width, camera.height), observed, residuals))
    return [field for field in fields if len(field.places)]


def _field(
    size: tuple[int, int], observed: Float64[np.ndarray, "n 2"], residuals: Float64[np.ndarray, "n 2"]
) -> ResidualField:
    cell = max(size) / FIELD_CELLS
    columns = int(np.ceil(size[0] / cell))
    good = np.isfinite(residuals).all(axis=1)
    index = np.floor(observed[good] / cell).astype(np.int64)
    flat = np.maximum(index[:, 1], 0) * columns + np.clip(index[:, 0], 0, columns - 1)
    number = np.bincount(flat)
    sums = np.stack([np.bincount(flat, weights=residuals[good][:, axis]) for axis in range(2)], axis=1)
    full = np.flatnonzero(number >= MIN_IN_CELL)
    places = np.stack([full % columns + 0.5, full // columns + 0.5], axis=1) * cell
    return ResidualField(size, places, sums[full] / number[full, None])
