"""Edges of a depth map, put where the photo has them.

Photos are compared by windows, so what is in front has its depth some pixels beyond its edge as well. There the photo
looks like what lies behind, and that is how deep these pixels are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Int64, UInt8

REACH_PX = 3  # beyond its edge a thing is too wide by so much at most
AROUND_PX = 2 * REACH_PX + 1  # so far both sides are looked at,
SIGMA_PX = REACH_PX + 1.0  # what is near counting for more
BEHIND = 0.02  # of the depth: so much further is another thing,
SAME = 0.01  # and within so much the same
LEAST_APART = 30.0  # of 441, between the colours of both sides: where they look alike, a pixel tells nothing
LIKER = 0.7  # times the difference from what is in front, the difference from what is behind at most

Pixels = tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]
Values = Float32[np.ndarray, " n"]
Colours = Float32[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class Side:
    """What lies around pixels on one side of an edge, a row for each.

    Attributes:
        weight: How much of it there is; 0 where there is nothing.
        colour: Its mean.
        depth: Its mean.
    """

    weight: Values
    colour: Colours
    depth: Values


def pixels_behind(
    depth: Float32[np.ndarray, "h w"], colour: UInt8[np.ndarray, "h w 3"]
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"], Values]:
    """Pixels before an edge that look like what is behind it rather than like what they are said to belong to.

    Args:
        depth: Along the camera's z; 0 where there is none.
        colour: What the photo shows, RGB.

    Returns:
        Their rows, their columns, and how deep what is behind lies.
    """
    reach = np.ones((2 * REACH_PX + 1, 2 * REACH_PX + 1), np.uint8)
    at_edge = (depth > 0.0) & (cv2.dilate(depth, reach) > depth * (1.0 + BEHIND))
    rows, columns = np.nonzero(at_edge)
    front, back = _sides(np.where(at_edge, np.float32(0.0), depth), depth, colour, (rows, columns))
    seen = colour[rows, columns].astype(np.float32)
    told = (front.weight > 0.0) & (back.weight > 0.0) & (_apart(front.colour, back.colour) > LEAST_APART)
    wrong = told & (_apart(seen, back.colour) < LIKER * _apart(seen, front.colour))
    return rows[wrong], columns[wrong], back.depth[wrong]


def _sides(
    inner: Float32[np.ndarray, "h w"],
    depth: Float32[np.ndarray, "h w"],
    colour: UInt8[np.ndarray, "h w 3"],
    pixels: Pixels,
) -> tuple[Side, Side]:
    """Before and behind the edges beside pixels, within a circle.

    Args:
        inner: Depths away from edges: what pixels are said to belong to is looked for there.
        depth: All depths.
        colour: RGB.
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
        belongs = np.abs(before - own) < SAME * own, found > own * (1.0 + BEHIND)
        for side, (here, deep) in enumerate(zip(belongs, (before, found), strict=True)):
            weight = np.where(here, nearness, np.float32(0.0))
            weights[side] += weight
            colours[side] += seen * weight[:, None]
            depths[side] += deep * weight
    total = np.maximum(weights, np.float32(1e-6))
    front, back = (Side(*each) for each in zip(weights, colours / total[..., None], depths / total, strict=True))
    return front, back


def _around() -> Iterator[tuple[int, int, np.float32]]:
    """Steps down and right within a circle, and how much what lies there counts."""
    steps = range(-AROUND_PX, AROUND_PX + 1)
    for down in steps:
        for right in steps:
            square = down * down + right * right
            if square <= AROUND_PX * AROUND_PX:
                yield down, right, np.float32(np.exp(-square / (2.0 * SIGMA_PX**2)))


def _apart(a: Colours, b: Colours) -> Values:
    between = a - b
    return np.asarray(np.sqrt((between * between).sum(axis=1)), np.float32)
