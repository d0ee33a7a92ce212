"""What a photo's depths say about a place: it is what the photo sees there, something is before it, or nothing is."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.sources import DepthMap

TOLERANCE_PX = 3.0  # depths this many pixels' widths apart are the same, at a right angle to the surface;
LEAST_SINE = 0.2  # more where the ray is flat, up to this one


@dataclass(frozen=True)
class Place:
    """Where points lie in a photo.

    Attributes:
        column: With fractions; the first pixel's centre is 0.5.
        row: Likewise.
        depth: Along the view axis, metres.
        sine: Of the ray's angle against the ground.
        inside: Whether the photo has that pixel, before it.
    """

    column: Float64[np.ndarray, " *n"]
    row: Float64[np.ndarray, " *n"]
    depth: Float64[np.ndarray, " *n"]
    sine: Float64[np.ndarray, " *n"]
    inside: Bool[np.ndarray, " *n"]


def place_in(
    camera: Camera,
    east: Float64[np.ndarray, "*#n"],
    north: Float64[np.ndarray, "*#n"],
    up: Float64[np.ndarray, "*#n"],
) -> Place:
    """Project points, each by itself, so that the bits do not depend on how many there are; nan is outside."""
    m = camera.cam_from_world
    x, y, depth = (m[i, 0] * east + m[i, 1] * north + m[i, 2] * up + m[i, 3] for i in range(3))
    ahead = depth > 0.0
    safe = np.where(ahead, depth, 1.0)
    column, row = camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy
    inside = ahead & (column >= 0.0) & (column < camera.width) & (row >= 0.0) & (row < camera.height)
    centre = camera.centre()
    sine = (centre[2] - up) / np.sqrt(np.square(x) + np.square(y) + np.square(np.where(ahead, depth, 1.0)))
    return Place(column, row, depth, sine, inside)


def tolerance(camera: Camera, place: Place) -> Float64[np.ndarray, " *n"]:
    """How far two depths of the ground may be apart and be the same, metres along the view axis."""
    flat = np.maximum(place.sine, LEAST_SINE)
    return np.asarray(TOLERANCE_PX * place.depth / max(camera.fx, camera.fy) / flat)


@dataclass(frozen=True)
class Sight:
    """What a photo says about points.

    Attributes:
        seen: It sees them.
        through: It sees something behind them.
        mixed: It sees them, but a nearer surface lies in the next pixel.
        unknown: It looks there, but has no depth: it may see them.
    """

    seen: Bool[np.ndarray, " *n"]
    through: Bool[np.ndarray, " *n"]
    mixed: Bool[np.ndarray, " *n"]
    unknown: Bool[np.ndarray, " *n"]


def sight(found: DepthMap, place: Place, least_m: float) -> Sight:
    """Compare points with a photo's depths.

    Args:
        found: Its depths.
        place: Of the points in the depths' own grid.
        least_m: Differences up to it are none.
    """
    column = np.clip(np.where(place.inside, place.column, 0.0), 0, found.camera.width - 1).astype(np.int64)
    row = np.clip(np.where(place.inside, place.row, 0.0), 0, found.camera.height - 1).astype(np.int64)
    near, least = _nearest_and_least(found, row, column)
    limit = np.maximum(tolerance(found.camera, place), least_m)
    seen = place.inside & (near > 0.0) & (np.abs(near - place.depth) <= limit)
    through = place.inside & (least > 0.0) & (least - place.depth > limit) & ~seen
    mixed = seen & (least > 0.0) & (least < place.depth - limit)
    return Sight(seen, through, mixed, place.inside & (near <= 0.0))


def _nearest_and_least(
    found: DepthMap, row: Int64[np.ndarray, " *n"], column: Int64[np.ndarray, " *n"]
) -> tuple[Float32[np.ndarray, " *n"], Float32[np.ndarray, " *n"]]:
    """A pixel's depth, and the least of it and those around it; 0 where one of them has none.

    A point at an edge lies in a pixel that may show what is behind: only where all pixels around do, too, is it in
    the way of the photo's rays.
    """
    if not row.size:
        empty = np.zeros(row.shape, np.float32)
        return empty, empty
    top, bottom = max(0, int(row.min()) - 1), min(found.camera.height, int(row.max()) + 2)
    left, right = max(0, int(column.min()) - 1), min(found.camera.width, int(column.max()) + 2)
    part = np.ascontiguousarray(found.depth[top:bottom, left:right])
    least = np.asarray(cv2.erode(part, np.ones((3, 3), np.uint8)))
    return part[row - top, column - left], least[row - top, column - left]
