"""Where a depth map makes what is near too wide, told by the photo itself.

Photos are compared by windows, so a wall in front has its depth some pixels beyond its edge as well. There the photo shows
what lies behind, and looks like it.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

REACH_PX = 3  # beyond its edge a thing is too wide by so much at most
AROUND_PX = 2 * REACH_PX + 1  # so far both sides are looked at,
SIGMA_PX = REACH_PX + 1.0  # what is near counting for more
BEHIND = 0.02  # of the depth: so much further is another thing,
SAME = 0.01  # and within so much the same
LEAST_APART = 30.0  # of 441, between the colours of both sides: where they look alike, a pixel tells nothing

Values = Float32[np.ndarray, " n"]
Colours = Float32[np.ndarray, "n 3"]


def too_wide(depth: Float32[np.ndarray, "h w"], colour: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Pixels just before an edge that look like what is behind it rather than like what they belong to.

    Args:
        depth: Along the camera's z; 0 where there is none.
        colour: What the photo shows, RGB.
    """
    reach = np.ones((2 * REACH_PX + 1, 2 * REACH_PX + 1), np.uint8)
    at_edge = (depth > 0.0) & (cv2.dilate(depth, reach) > depth * (1.0 + BEHIND))
    rows, columns = np.nonzero(at_edge)
    sides = _sides(depth, at_edge, colour, (rows, columns))
    (own, own_weight), (other, other_weight) = sides
    seen = colour[rows, columns].astype(np.float32)
    told = (own_weight > 0.0) & (other_weight > 0.0) & (_apart(own, other) > LEAST_APART)
    result = np.zeros(depth.shape, np.bool_)
    result[rows, columns] = told & (_apart(seen, other) < _apart(seen, own))
    return result


def _sides(
    depth: Float32[np.ndarray, "h w"],
    at_edge: Bool[np.ndarray, "h w"],
    colour: UInt8[np.ndarray, "h w 3"],
    pixels: tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]],
) -> tuple[tuple[Colours, Values], tuple[Colours, Values]]:
    """Mean colours of what each pixel belongs to, away from its edge, and of what is behind; with their weights."""
    wide = [(AROUND_PX, AROUND_PX)] * 2
    depths, edges = np.pad(depth, wide), np.pad(at_edge, wide)
    colours = np.pad(colour, [*wide, (0, 0)])
    own = depth[pixels]
    rows, columns = pixels[0] + AROUND_PX, pixels[1] + AROUND_PX
    sums = np.zeros((2, len(own), 3), np.float32)
    weights = np.zeros((2, len(own)), np.float32)
    for down, right, nearness in _around():
        there = rows + down, columns + right
        found, seen = depths[there], colours[there].astype(np.float32)
        same = (np.abs(found - own) < SAME * own) & ~edges[there]
        for side, belongs in enumerate((same, found > own * (1.0 + BEHIND))):
            weight = np.where(belongs, nearness, np.float32(0.0))
            sums[side] += seen * weight[:, None]
            weights[side] += weight
    means = sums / np.maximum(weights, np.float32(1e-6))[..., None]
    return (means[0], weights[0]), (means[1], weights[1])


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
