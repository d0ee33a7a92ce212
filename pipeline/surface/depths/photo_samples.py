"""Colours of points from a full-size photo, with a filter that fits the scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64, UInt8, UInt16

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.native_camera import native_camera
from splatpipe.pipeline.surface.depths.point_visibility import Points, contiguous
from splatpipe.pipeline.surface.depths.sources import DepthSource


@dataclass(frozen=True, eq=False)
class DistortionGrid:
    """Mapping from a pinhole camera's pixels to those of the original photo.

    Distortion is smooth, so it is sampled every few pixels and interpolated linearly (within 0.001 px for drone lenses,
    ten times as fast as the lens model itself).

    Attributes:
        width: Width of the photo, pixels.
        height: Height of the photo, pixels.
        step: Spacing of the nodes, pinhole pixels.
        nodes: Column and row in the photo of the pinhole's pixels (0, 0), (step, 0), …
    """

    width: int
    height: int
    step: float
    nodes: Float64[np.ndarray, "rows columns 2"]


@dataclass(frozen=True, eq=False)
class PhotoSource:
    """A photo that colours the surface.

    Attributes:
        camera: Pinhole camera, local metres: of the undistorted photo, or of the photo itself if it has no distortion.
        load: Reads the photo's original pixels, (h, w, 3), 8 bits.
        depths: Depths for visibility tests; None if there are none, and then the photo colours nothing.
        lens: Mapping from pinhole to original pixels; None if they are the same. With it, colours are resampled once
            from the original photo instead of from an undistorted copy.
    """

    camera: Camera
    load: Callable[[], UInt8[np.ndarray, "h w 3"]]
    depths: DepthSource | None
    lens: DistortionGrid | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the original photo, pixels."""
        return (self.camera.width, self.camera.height) if self.lens is None else (self.lens.width, self.lens.height)


def rate_points(
    camera: Camera, points: Points, cell_m: float, flags: UInt8[np.ndarray, " *n"]
) -> tuple[UInt16[np.ndarray, " *n"], Bool[np.ndarray, " *n"]]:
    """Cost of colouring points from a photo, in thousandths, and whether it sees them.

    The cost grows for an oblique view, pixels coarser than the cells, points near the photo's edge, and uncertain
    depths.

    Args:
        camera: The photo's pinhole camera.
        points: East, north, up; NaN for missing points.
        cell_m: Size of the points' cells, metres.
        flags: Visibility according to its depths, from ``classify_points``.
    """
    cost, seen = np.empty(flags.shape, np.uint16), np.empty(flags.shape, np.bool_)
    _native.rate(native_camera(camera), contiguous(points), cell_m, flags, cost, seen.view(np.uint8))
    return cost, seen


def sample_colours(
    source: PhotoSource,
    pixels: UInt8[np.ndarray, "h w 3"],
    points: Points,
    seen: Bool[np.ndarray, " *n"],
    cell_m: float,
    tone: UInt8[np.ndarray, "256 3"],
) -> UInt8[np.ndarray, " *n 3"]:
    """Sample colours of points from a photo with a cubic filter; black where it does not see them.

    If its pixels are finer than the cells, the photo is first halved as often as fits. A point's bits do not depend on
    the other points.

    Args:
        source: The photo.
        pixels: All its pixels; only those around the points are read.
        points: East, north, up.
        seen: Whether the photo sees them; beyond its edges, the edge's colour is repeated.
        cell_m: Size of the points' cells, metres.
        tone: Output value for each input value and channel.

    Raises:
        ValueError: if the pixels do not have the photo's size.
    """
    colour = np.zeros((*seen.shape, 3), np.uint8)
    lens = None if source.lens is None else (source.lens.step, source.lens.nodes)
    photo = (pixels, tone, native_camera(source.camera), lens)
    _native.sample_photo(photo, contiguous(points), cell_m, seen.view(np.uint8), colour)
    return colour


def load_pixels(source: PhotoSource) -> tuple[UInt8[np.ndarray, "h w 3"], int]:
    """Load a photo's pixels; returns them with their size in bytes, as ``LruCache`` needs.

    Raises:
        ValueError: if its size differs from its camera's.
    """
    pixels = source.load()
    width, height = source.size
    if pixels.shape != (height, width, 3):
        raise ValueError(f"{source.camera.name}: pixels of {pixels.shape} for {width} × {height}")
    return pixels, pixels.nbytes


def pixel_loader(source: PhotoSource) -> Callable[[], tuple[UInt8[np.ndarray, "h w 3"], int]]:
    """``load_pixels`` for this photo as a function to call later."""
    return partial(load_pixels, source)


PLAIN_TONE = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)


def tone_curve(gain: Float64[np.ndarray, " 3"]) -> UInt8[np.ndarray, "256 3"]:
    """Lookup table that multiplies a photo's exposure by a gain per channel (IEC 61966-2-1 for sRGB)."""
    light = linear_light(np.arange(256) / 255.0)[:, None] * gain
    encoded = np.where(light <= 0.0031308, light * 12.92, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return np.asarray(np.clip(np.round(encoded * 255.0), 0, 255), np.uint8)


def linear_light(value: Float64[np.ndarray, " *n"]) -> Float64[np.ndarray, " *n"]:
    """Linear light of sRGB values, 0 to 1."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
