"""What a photo's depths say about a place: it is what the photo sees there, something is before it, or nothing is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster import _native
from splatpipe.pipeline.raster.native_camera import native_camera
from splatpipe.pipeline.surface.sources import PosedDepthMap

Points = tuple[Float64[np.ndarray, " *n"], Float64[np.ndarray, " *n"], Float64[np.ndarray, " *n"]]  # east, north, up


@dataclass(frozen=True)
class PhotoCoordinates:
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
) -> PhotoCoordinates:
    """Project points, each by itself, so that the bits do not depend on how many there are; nan is outside."""
    m = camera.cam_from_world
    x, y, depth = (m[i, 0] * east + m[i, 1] * north + m[i, 2] * up + m[i, 3] for i in range(3))
    ahead = depth > 0.0
    safe = np.where(ahead, depth, 1.0)
    column, row = camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy
    inside = ahead & (column >= 0.0) & (column < camera.width) & (row >= 0.0) & (row < camera.height)
    centre = camera.centre()
    sine = (centre[2] - up) / np.sqrt(np.square(x) + np.square(y) + np.square(np.where(ahead, depth, 1.0)))
    return PhotoCoordinates(column, row, depth, sine, inside)


@dataclass(frozen=True)
class PointVisibility:
    """What a photo says about points.

    Attributes:
        said: Bits for each, as kernels take them.
    """

    said: UInt8[np.ndarray, " *n"]

    @property
    def seen(self) -> Bool[np.ndarray, " *n"]:
        """It sees them."""
        return np.asarray(self.said & _native.SEEN != 0)

    @property
    def through(self) -> Bool[np.ndarray, " *n"]:
        """It sees something behind them."""
        return np.asarray(self.said & _native.THROUGH != 0)

    @property
    def mixed(self) -> Bool[np.ndarray, " *n"]:
        """It sees them, but a nearer surface lies in the next pixel."""
        return np.asarray(self.said & _native.MIXED != 0)

    @property
    def unknown(self) -> Bool[np.ndarray, " *n"]:
        """It looks there, but has no depth: it may see them."""
        return np.asarray(self.said & _native.UNKNOWN != 0)


def sight(
    found: PosedDepthMap, points: Points, least_m: float, sines: Float64[np.ndarray, " *n"] | None = None
) -> PointVisibility:
    """Compare points with a photo's depths: they are the same within some pixels' widths, more where the ray is flat.

    Args:
        found: The depths.
        points: East, north, up; nan is nowhere.
        least_m: Differences along the view axis up to it are none.
        sines: Of the rays' angles against the surface there; None: against the ground.

    Raises:
        ValueError: if the depths do not fit their camera.
    """
    said = np.empty(points[2].shape, np.uint8)
    _native.look(found.depth, native_camera(found.camera), contiguous(points), sines, least_m, said)
    return PointVisibility(said)


def contiguous(points: Points) -> Points:
    """Points as kernels take them."""
    east, north, up = (np.ascontiguousarray(part, np.float64) for part in points)
    return east, north, up
