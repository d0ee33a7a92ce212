"""Accuracy of the splat itself: surveyed points compared with their positions by the splat's own depth.

Each observed pixel of a surveyed point is unprojected at the trained model's rendered median depth; the per-coordinate
median over the photos is compared with the survey. If enough held-out photos see the point, only they are used, because
the others' pixels were fitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.plan_area import read_world_area
from splatpipe.pipeline.photos.files.names import NameFinder
from splatpipe.pipeline.survey.control.residuals import accuracy_table
from splatpipe.pipeline.survey.crs.frames import Frame, load_frame

MAX_DEPTH_STEP = 0.02  # relative, between neighbouring pixels of one surface: slopes have less, edges far more
MIN_HELD_OUT_PHOTOS = 3  # that show a point: with two, one floater moves the median by half of its distance
AROUND_PX = 8  # around surveyed points that is rendered: interpolation takes the four pixels nearest to each
DIGITS = 5  # decimals of lengths in metres: a hundredth of a millimetre
POINT_FACTS = ("name", "role", "why", "surveyed_crs", "surveyed_m", "sigma_m", "estimated_m", "residual_m")
DepthMap = Float[np.ndarray, "h w"]


@dataclass(frozen=True)
class Observation:
    """A surveyed point in a photo.

    Attributes:
        photo: Name of the dataset's photo.
        ray: x / z and y / z in its camera.
    """

    photo: str
    ray: Float64[np.ndarray, " 2"]


@dataclass(frozen=True)
class ObservedPoint:
    """A surveyed point and the photos that show it.

    Attributes:
        name: Name of the point.
        role: ``control``, ``check`` or ``left_out``.
        place_m: East, north, up in the world frame; up is NaN if it was not measured.
        observations: Those in photos of the dataset, without marks that georef rejected.
    """

    name: str
    role: str
    place_m: Float64[np.ndarray, " 3"]
    observations: tuple[Observation, ...]


def measure_accuracy(
    parts: Mapping[str, Path],
    cameras: Sequence[Camera],
    held_out: Sequence[str],
    depth_of: Callable[[Camera], DepthMap],
) -> dict[str, Any]:
    """The `accuracy` entry of metrics.json: georef's tables and points, and the splat's own.

    Args:
        parts: Has ``georef.frame``, ``georef.control``, ``georef.accuracy`` and ``georef.boundary``, outside of which
            points do not count for the splat; all absent if only a dataset is evaluated.
        cameras: Cameras of the dataset's photos, at the size that depth is rendered at.
        held_out: Names of the held-out photos.
        depth_of: Renders a camera's median depth: that of a photo, or of a part of one.

    Raises:
        StageError: if a part is broken.
    """
    if "georef.control" not in parts:
        return {"gsd_m": None, "tables": {}, "points": [], "splat": None}
    frame = load_frame(parts["georef.frame"])
    result: dict[str, Any] = {**_read(parts["georef.accuracy"]), "points": georef_points(parts["georef.control"])}
    points = read_surveyed(parts["georef.control"], [camera.name for camera in cameras])
    if (area := read_world_area(parts.get("georef.boundary"))) is not None:  # outside the splat is coarse
        points = [point for point in points if area.contains(np.nan_to_num(point.place_m)[None])[0]]
    if frame.kind != "enu" or not any(point.observations for point in points):
        return {**result, "splat": None}
    by_name = {camera.name: camera for camera in cameras}
    seen_by = {point.name: _chosen(point, held_out) for point in points}
    wanted = sorted({seen.photo for chosen in seen_by.values() for seen in chosen})
    places: dict[str, list[dict[str, Any]]] = {point.name: [] for point in points}
    for photo in wanted:
        here = [(name, seen) for name, chosen in seen_by.items() for seen in chosen if seen.photo == photo]
        camera = _around(by_name[photo], [seen.ray for _, seen in here])
        depth = depth_of(camera)
        for name, seen in here:
            places[name] += _unprojected(seen, camera, depth, frame)
    return {**result, "splat": _splat(points, places, set(held_out))}


def georef_points(control: Path) -> list[dict[str, Any]]:
    """Each point of `control.json` with georef's results, without its individual observations.

    Raises:
        StageError: if it is broken.
    """
    try:
        entries = []
        for point in _read(control)["points"]:
            entry = {name: point.get(name) for name in POINT_FACTS}
            used = [seen for seen in point["observations"] if seen.get("used", True)]
            squares = [x * x + y * y for x, y in filter(None, (seen["residual_px"] for seen in used))]
            rms = math.sqrt(math.fsum(squares) / len(squares)) if squares else None
            entries.append({**entry, "photos": len(used), "rms_px": None if rms is None else round(rms, 3)})
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise StageError(f"{control.name} is broken: {error!r}.", hint="Run again with --rerun georef.") from error
    return entries


def read_surveyed(control: Path, photos: Sequence[str]) -> list[ObservedPoint]:
    """The points of `control.json`, with their observations in these photos.

    Raises:
        StageError: if it is broken.
    """
    find = NameFinder(sorted(photos))
    try:
        points = []
        for point in _read(control)["points"]:
            east, north, up = point["surveyed_m"]
            observations = []
            for seen in point["observations"]:
                photo = find(str(seen["photo"]))
                if photo is not None and seen.get("ray") is not None and seen.get("used", True):
                    ray = np.array(seen["ray"], dtype=np.float64).reshape(2)
                    observations.append(Observation(photo, ray))
            place = np.array([east, north, math.nan if up is None else up], dtype=np.float64)
            points.append(ObservedPoint(str(point["name"]), str(point["role"]), place, tuple(observations)))
    except (KeyError, TypeError, ValueError) as error:
        raise StageError(f"{control.name} is broken: {error!r}.", hint="Run again with --rerun georef.") from error
    return points


def depth_at(depth: DepthMap, pixel: Float64[np.ndarray, " 2"]) -> float | None:
    """Depth interpolated between pixel centres; that of the nearest pixel if the four around are not one surface.

    On a plane 1 / depth is linear over the image, so 1 / depth is interpolated.

    Args:
        depth: World units along the view axis; 0 where there is none.
        pixel: x, y; the centre of the first pixel is (0.5, 0.5).

    Returns:
        World units; None outside the image and where there is no depth.
    """
    h, w = depth.shape
    if not (0.0 <= pixel[0] < w and 0.0 <= pixel[1] < h):
        return None
    column, row = math.floor(pixel[0]), math.floor(pixel[1])
    left, top = (min(max(math.floor(at - 0.5), 0), size - 2) for at, size in zip(pixel, (w, h), strict=True))
    four = depth[max(top, 0) : top + 2, max(left, 0) : left + 2].astype(np.float64)
    nearest = float(depth[row, column])
    if four.shape != (2, 2) or not (four > 0.0).all() or four.max() > (1.0 + MAX_DEPTH_STEP) * four.min():
        return nearest if nearest > 0.0 and math.isfinite(nearest) else None
    across, down = np.clip(pixel - 0.5 - [left, top], 0.0, 1.0)
    weights = np.outer([1.0 - down, down], [1.0 - across, across])
    return float(1.0 / (weights / four).sum())


def _chosen(point: ObservedPoint, held_out: Sequence[str]) -> list[Observation]:
    """The observations in held-out photos; all observations if these are too few for a median."""
    unseen = [seen for seen in point.observations if seen.photo in set(held_out)]
    return unseen if len(unseen) >= MIN_HELD_OUT_PHOTOS else list(point.observations)


def _around(camera: Camera, rays: Sequence[Float64[np.ndarray, " 2"]]) -> Camera:
    """The part of a photo that is needed for the depths at these rays."""
    pixels, size = camera.pixels_of(np.array(rays)), np.array([camera.width, camera.height])
    first = np.clip(np.floor(pixels.min(axis=0) - AROUND_PX), 0, size - 1).astype(np.int64)
    last = np.clip(np.ceil(pixels.max(axis=0) + AROUND_PX), first + 1, size).astype(np.int64)
    left, top = first.tolist()
    width, height = (last - first).tolist()
    return camera.crop(left, top, width, height)


def _unprojected(seen: Observation, camera: Camera, depth: DepthMap, frame: Frame) -> list[dict[str, Any]]:
    """World position of an observation by the splat's depth; empty if it has none."""
    pixel = camera.pixels_of(seen.ray)
    z = depth_at(depth, pixel)
    if z is None:
        return []
    place = frame.world_from_model.apply(camera.unproject(pixel[None], np.array([z])))[0]
    return [{"photo": seen.photo, "depth_m": z * frame.world_from_model.scale, "place": place}]


def _splat(
    points: Sequence[ObservedPoint], places: Mapping[str, list[dict[str, Any]]], held_out: set[str]
) -> dict[str, Any]:
    entries: list[dict[str, Any]] = []
    residuals: dict[str, list[Float64[np.ndarray, " 3"]]] = {"control": [], "check": []}
    for point in points:
        found = places[point.name]
        entry: dict[str, Any] = {"name": point.name, "role": point.role, "estimated_m": None, "residual_m": None}
        if found:
            estimated = np.median([seen["place"] for seen in found], axis=0)
            entry |= {"estimated_m": _rounded(estimated), "residual_m": _rounded(estimated - point.place_m)}
            if point.role in residuals:
                residuals[point.role].append(estimated - point.place_m)
        entry["held_out"] = bool(found) and all(seen["photo"] in held_out for seen in found)
        entry["observations"] = [
            {
                "photo": seen["photo"],
                "depth_m": round(seen["depth_m"], DIGITS),
                "residual_m": _rounded(seen["place"] - point.place_m),
            }
            for seen in found
        ]
        entries.append(entry)
    groups = {**residuals, "all": [*residuals["control"], *residuals["check"]]}
    tables = {name: accuracy_table(np.array(group).reshape(-1, 3)) for name, group in groups.items()}
    return {"tables": tables, "points": entries}


def _rounded(vector: Float64[np.ndarray, " 3"]) -> list[float | None]:
    return [round(float(value), DIGITS) if math.isfinite(value) else None for value in vector]


def _read(path: Path) -> dict[str, Any]:
    try:
        value = read_json(path)
        if not isinstance(value, dict):
            raise ValueError("no object")
    except (OSError, ValueError) as error:
        raise StageError(f"{path.name} cannot be read: {error}", hint="Run again with --rerun georef.") from error
    return value
