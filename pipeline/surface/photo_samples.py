"""Colours of places from a full-size photo, with a filter that fits the scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.sight import Place
from splatpipe.pipeline.surface.sources import DepthSource

PARTS = 32.0  # of a pixel, to which OpenCV rounds places: done here before a window is cut, so that all windows agree
MOST_HALVED = 6  # times: a photo 64 times finer than the cells is softened no further
REACH = 3  # pixels around a place that a cubic may look at, at any scale
ROUND_UP = 0.4  # a photo is halved where its pixels are finer than a cell by 2 to the power of so many more


@dataclass(frozen=True, eq=False)
class Lens:
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

    def pixels(
        self, column: Float64[np.ndarray, " *n"], row: Float64[np.ndarray, " *n"]
    ) -> tuple[Float64[np.ndarray, " *n"], Float64[np.ndarray, " *n"]]:
        """The photo's columns and rows; of places beyond the pinhole's picture those of its rim's squares."""
        rows, columns = self.nodes.shape[:2]
        x, y = (np.nan_to_num(at / self.step) for at in (column, row))
        left = np.clip(x, 0, columns - 2).astype(np.int64)
        top = np.clip(y, 0, rows - 2).astype(np.int64)
        x, y = x - left, y - top
        flat, first = self.nodes.reshape(-1, 2), top * columns + left
        found = []
        for axis in (0, 1):
            a, b, c, d = (flat[first + at, axis] for at in (0, 1, columns, columns + 1))
            found.append((a * (1 - x) + b * x) * (1 - y) + (c * (1 - x) + d * x) * y)
        return found[0], found[1]


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
    lens: Lens | None = None

    def in_photo(self, place: Place) -> Place:
        """Places of the pinhole's in the photo's own grid."""
        if self.lens is None:
            return place
        column, row = self.lens.pixels(place.column, place.row)
        inside = place.inside & (column >= 0.0) & (column < self.lens.width) & (row >= 0.0) & (row < self.lens.height)
        return replace(place, column=column, row=row, inside=inside)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the photo's own grid."""
        return (self.camera.width, self.camera.height) if self.lens is None else (self.lens.width, self.lens.height)


def halvings(camera: Camera, place: Place, cell_m: float) -> Int64[np.ndarray, " *n"]:
    """How often a photo is halved at each place before it is sampled."""
    finer = cell_m * max(camera.fx, camera.fy) / np.where(place.inside, place.depth, 1.0)
    level = np.floor(np.log2(np.maximum(finer, 1.0)) + ROUND_UP)
    return np.minimum(level, MOST_HALVED).astype(np.int64)


def sampled(
    pixels: UInt8[np.ndarray, "h w 3"], place: Place, level: Int64[np.ndarray, "a b"], tone: UInt8[np.ndarray, "256 3"]
) -> UInt8[np.ndarray, "a b 3"]:
    """Colours at places by a cubic, black outside of the photo; the same bits however places are tiled.

    Args:
        pixels: The whole photo; only what lies around the places is read.
        place: Where they are.
        level: How often the photo is halved there.
        tone: What becomes of each value in each channel.
    """
    result = np.zeros((*place.column.shape, 3), np.uint8)
    if not place.inside.any():
        return result
    for halved in np.unique(level[place.inside]):
        here = place.inside & (level == halved)
        side = 1 << int(halved)
        left, top, window = _window(pixels, place, here, side)
        window = np.asarray(cv2.LUT(window, tone.reshape(1, 256, 3)))
        for _ in range(int(halved)):
            window = np.asarray(
                cv2.resize(window, (window.shape[1] // 2, window.shape[0] // 2), interpolation=cv2.INTER_AREA)
            )
        column, row = (
            np.where(here, np.round((at / side - 0.5) * PARTS) / PARTS - first // side, 0.0).astype(np.float32)
            for at, first in ((place.column, left), (place.row, top))
        )
        found = cv2.remap(window, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        result[here] = found[here]
    return result


def _window(
    pixels: UInt8[np.ndarray, "h w 3"], place: Place, here: np.ndarray, side: int
) -> tuple[int, int, UInt8[np.ndarray, "a b 3"]]:
    """The part of a photo around places, from and to whole multiples of ``side``; its rim goes on beyond the photo."""
    height, width = pixels.shape[:2]
    spans = []
    for at, length in ((place.row[here], height), (place.column[here], width)):
        first = max(0, (int(at.min()) // side - REACH) * side)
        last = min(-(-length // side) * side, (int(at.max()) // side + REACH + 1) * side)
        spans.append((first, last))
    (top, bottom), (left, right) = spans
    part = np.asarray(pixels[top:bottom, left:right])
    beyond = ((0, bottom - top - part.shape[0]), (0, right - left - part.shape[1]), (0, 0))
    return left, top, np.ascontiguousarray(np.pad(part, beyond, mode="edge"))


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
