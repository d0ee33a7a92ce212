"""Depth edges, moved to where the photo has them.

Photos are compared by windows, so a foreground object's depth extends some pixels beyond its edge (edge fattening).
There the photo has the background's colour, and these pixels get the background's depth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Int64, UInt8

REACH_PX = 3  # the most by which an object's depth extends beyond its edge
AROUND_PX = 2 * REACH_PX + 1  # radius in which both sides of an edge are sampled,
SIGMA_PX = REACH_PX + 1.0  # with this Gaussian weight
MIN_DEPTH_STEP = 0.02  # difference in depth, relative, above which a farther pixel is another object,
MAX_DEPTH_STEP = 0.01  # and within this much is the same object
MIN_CONTRAST = 30.0  # RGB distance (0 to 441) between both sides, below which a pixel cannot be assigned to a side
MAX_COLOUR_RATIO = 0.7  # colour distance of a background pixel to the background over that to the foreground

Pixels = tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]
Values = Float32[np.ndarray, " n"]
Colours = Float32[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class Side:
    """Means around pixels on one side of an edge, a row for each pixel.

    Attributes:
        weight: Sum of the weights; 0 where there is nothing on this side.
        colour: Weighted mean colour, RGB.
        depth: Weighted mean depth.
    """

    weight: Values
    colour: Colours
    depth: Values


def pixels_behind(
    depth: Float32[np.ndarray, "h w"], colour: UInt8[np.ndarray, "h w 3"]
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"], Values]:
    """Find pixels with a foreground depth whose colour is closer to the background's.

    Args:
        depth: Depth along the camera's z; 0 where there is none.
        colour: The photo, RGB.

    Returns:
        Rows and columns of the pixels, and the background's depth there.
    """
    reach = np.ones((2 * REACH_PX + 1, 2 * REACH_PX + 1), np.uint8)
    at_edge = (depth > 0.0) & (cv2.dilate(depth, reach) > depth * (1.0 + MIN_DEPTH_STEP))
    rows, columns = np.nonzero(at_edge)
    front, back = _sides(np.where(at_edge, np.float32(0.0), depth), depth, colour, (rows, columns))
    seen = colour[rows, columns].astype(np.float32)
    decidable = (front.weight > 0.0) & (back.weight > 0.0) & (_difference(front.colour, back.colour) > MIN_CONTRAST)
    wrong = decidable & (_difference(seen, back.colour) < MAX_COLOUR_RATIO * _difference(seen, front.colour))
    return rows[wrong], columns[wrong], back.depth[wrong]


def _sides(
    inner: Float32[np.ndarray, "h w"],
    depth: Float32[np.ndarray, "h w"],
    colour: UInt8[np.ndarray, "h w 3"],
    pixels: Pixels,
) -> tuple[Side, Side]:
    """Foreground and background around pixels at edges, within a circle.

    Args:
        inner: Depths away from edges, from which the foreground is sampled.
        depth: All depths, from which the background is sampled.
        colour: The photo, RGB.
        pixels: Rows and columns.
    """
    wide = [(AROUND_PX, AROUND_PX)] * 2
    inner, own, depth = np.pad(inner, wide), depth[pixels], np.pad(depth, wide)
    colour = np.pad(colour, [*wide, (0, 0)])
    rows, columns = pixels[0] + AROUND_PX, pixels[1] + AROUND_PX
    weights = np.zeros((2, len(own)), np.float32)
    colours, depths = np.zeros((2, len(own), 3), np.float32), np.zeros((2, len(own)), np.float32)
    for down, right, nearness in _around():
        there = rows + down, columns + right
        seen = colour[there].astype(np.float32)
        before, found = inner[there], depth[there]
        belongs = np.abs(before - own) < MAX_DEPTH_STEP * own, found > own * (1.0 + MIN_DEPTH_STEP)
        for side, (here, deep) in enumerate(zip(belongs, (before, found), strict=True)):
            weight = np.where(here, nearness, np.float32(0.0))
            weights[side] += weight
            colours[side] += seen * weight[:, None]
            depths[side] += deep * weight
    total = np.maximum(weights, np.float32(1e-6))
    front, back = (Side(*each) for each in zip(weights, colours / total[..., None], depths / total, strict=True))
    return front, back


def _around() -> Iterator[tuple[int, int, np.float32]]:
    """Offsets down and right within a circle, and their weights."""
    steps = range(-AROUND_PX, AROUND_PX + 1)
    for down in steps:
        for right in steps:
            square = down * down + right * right
            if square <= AROUND_PX * AROUND_PX:
                yield down, right, np.float32(np.exp(-square / (2.0 * SIGMA_PX**2)))


def _difference(a: Colours, b: Colours) -> Values:
    between = a - b
    return np.asarray(np.sqrt((between * between).sum(axis=1)), np.float32)
