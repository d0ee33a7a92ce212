"""Visibility of points by a photo's depths: seen, hidden, or seen through."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.native_camera import native_camera
from splatpipe.pipeline.surface.depths.sources import PosedDepthMap

Points = tuple[Float64[np.ndarray, " *n"], Float64[np.ndarray, " *n"], Float64[np.ndarray, " *n"]]  # east, north, up


@dataclass(frozen=True)
class PhotoCoordinates:
    """Image coordinates of points.

    Attributes:
        column: Fractional; the first pixel's centre is 0.5.
        row: Fractional, likewise.
        depth: Depth along the optical axis, metres.
        sine: Sine of the ray's angle to the ground.
        inside: Whether the point is in front of the camera and inside the image.
    """

    column: Float64[np.ndarray, " *n"]
    row: Float64[np.ndarray, " *n"]
    depth: Float64[np.ndarray, " *n"]
    sine: Float64[np.ndarray, " *n"]
    inside: Bool[np.ndarray, " *n"]


def project_points(
    camera: Camera,
    east: Float64[np.ndarray, "*#n"],
    north: Float64[np.ndarray, "*#n"],
    up: Float64[np.ndarray, "*#n"],
) -> PhotoCoordinates:
    """Project points, each independently, so that the bits do not depend on their number; NaN is outside."""
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
    """Visibility of points in a photo.

    Attributes:
        flags: Bit flags for each point, as in the kernels.
    """

    flags: UInt8[np.ndarray, " *n"]

    @property
    def seen(self) -> Bool[np.ndarray, " *n"]:
        """Points that the photo sees."""
        return np.asarray(self.flags & _native.SEEN != 0)

    @property
    def through(self) -> Bool[np.ndarray, " *n"]:
        """Points that the photo sees through, to something behind them."""
        return np.asarray(self.flags & _native.THROUGH != 0)

    @property
    def mixed(self) -> Bool[np.ndarray, " *n"]:
        """Points that the photo sees, but with a nearer surface in an adjacent pixel."""
        return np.asarray(self.flags & _native.MIXED != 0)

    @property
    def unknown(self) -> Bool[np.ndarray, " *n"]:
        """Points in view where the photo has no depth, so it may see them."""
        return np.asarray(self.flags & _native.UNKNOWN != 0)


def classify_points(
    found: PosedDepthMap, points: Points, least_m: float, sines: Float64[np.ndarray, " *n"] | None = None
) -> PointVisibility:
    """Compare points with a photo's depths, with a tolerance of a few pixel widths, larger for grazing rays.

    Args:
        found: The depths.
        points: East, north, up; NaN for missing points.
        least_m: Differences along the optical axis up to this are ignored, metres.
        sines: Sines of the rays' angles to the surface; None: to the ground.

    Raises:
        ValueError: if the depths do not fit their camera.
    """
    flags = np.empty(points[2].shape, np.uint8)
    _native.look(found.depth, native_camera(found.camera), contiguous(points), sines, least_m, flags)
    return PointVisibility(flags)


def contiguous(points: Points) -> Points:
    """Points as contiguous arrays for the kernels."""
    east, north, up = (np.ascontiguousarray(part, np.float64) for part in points)
    return east, north, up
