"""Colours of places from a full-size photo, with a filter that fits the scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64, UInt8, UInt16

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster import _native
from splatpipe.pipeline.raster.native_camera import native_camera
from splatpipe.pipeline.surface.point_visibility import Points, contiguous
from splatpipe.pipeline.surface.sources import DepthSource


@dataclass(frozen=True, eq=False)
class DistortionGrid:
    """The way from a pinhole's pixels to those of the photo that it stands for.

    Distortion is smooth: it is sampled every few pixels, and straight between (within 0.001 px for lenses that drones
    have, where the lens model itself takes ten times as long).

    Attributes:
        width: Of the photo.
        height: Of the photo.
        step: Pinhole pixels from node to node.
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
        camera: A pinhole, local metres: of the photo as it is without its lens, or of the photo where it has none.
        load: Reads the photo's own pixels, (h, w, 3), 8 bits.
        depths: What tells whether it sees a place; None where nothing does, and then it colours nothing.
        lens: Where the photo's own pixels show what the pinhole's would; None where they are those. So colours are
            taken from a photo once, and not from one that was made straight before.
    """

    camera: Camera
    load: Callable[[], UInt8[np.ndarray, "h w 3"]]
    depths: DepthSource | None
    lens: DistortionGrid | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the photo's own grid."""
        return (self.camera.width, self.camera.height) if self.lens is None else (self.lens.width, self.lens.height)


def rated(
    camera: Camera, points: Points, cell_m: float, said: UInt8[np.ndarray, " *n"]
) -> tuple[UInt16[np.ndarray, " *n"], Bool[np.ndarray, " *n"]]:
    """What it costs to colour points by a photo, in thousandths, and whether it sees them.

    It leans, is coarser than the cells, they lie near its edge, or its depths are not sure of them.

    Args:
        camera: The photo's pinhole.
        points: East, north, up; nan is nowhere.
        cell_m: Side of the points' cells.
        said: What its depths say, as of ``sight``.
    """
    cost, seen = np.empty(said.shape, np.uint16), np.empty(said.shape, np.bool_)
    _native.rate(native_camera(camera), contiguous(points), cell_m, said, cost, seen.view(np.uint8))
    return cost, seen


def sampled(
    source: PhotoSource,
    pixels: UInt8[np.ndarray, "h w 3"],
    points: Points,
    seen: Bool[np.ndarray, " *n"],
    cell_m: float,
    tone: UInt8[np.ndarray, "256 3"],
) -> UInt8[np.ndarray, " *n 3"]:
    """Colours of points in a photo by a cubic, black where it does not see them.

    Where its pixels are finer than the cells it is halved before, as often as fits. The same bits whatever points are
    asked for at once.

    Args:
        source: The photo.
        pixels: All of it; only what lies around the points is read.
        points: East, north, up.
        seen: Whether it sees them; what lies beyond its edges has the edge's colour.
        cell_m: Side of the points' cells.
        tone: What becomes of each value in each channel.

    Raises:
        ValueError: if the pixels are not of the photo's size.
    """
    colour = np.zeros((*seen.shape, 3), np.uint8)
    lens = None if source.lens is None else (source.lens.step, source.lens.nodes)
    photo = (pixels, tone, native_camera(source.camera), lens)
    _native.sample_photo(photo, contiguous(points), cell_m, seen.view(np.uint8), colour)
    return colour


def loaded(source: PhotoSource) -> tuple[UInt8[np.ndarray, "h w 3"], int]:
    """A photo and its size in memory, as a shelf wants it.

    Raises:
        ValueError: if it is not of its camera's size.
    """
    pixels = source.load()
    width, height = source.size
    if pixels.shape != (height, width, 3):
        raise ValueError(f"{source.camera.name}: pixels of {pixels.shape} for {width} × {height}")
    return pixels, pixels.nbytes


def loader(source: PhotoSource) -> Callable[[], tuple[UInt8[np.ndarray, "h w 3"], int]]:
    """``loaded`` of it, for later."""
    return partial(loaded, source)


PLAIN_TONE = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)


def tone_curve(gain: Float64[np.ndarray, " 3"]) -> UInt8[np.ndarray, "256 3"]:
    """Values of a photo as if it had been exposed so many times longer, a channel each (IEC 61966-2-1 for sRGB)."""
    light = linear(np.arange(256) / 255.0)[:, None] * gain
    encoded = np.where(light <= 0.0031308, light * 12.92, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return np.asarray(np.clip(np.round(encoded * 255.0), 0, 255), np.uint8)


def linear(value: Float64[np.ndarray, " *n"]) -> Float64[np.ndarray, " *n"]:
    """Light of sRGB values from 0 to 1."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
