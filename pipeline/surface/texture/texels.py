"""The texels of triangles in a page, and where they are on the triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

REACH = 1.5  # texels around a triangle that bilinear filters read
BATCH = 1 << 15  # triangles at a time


@dataclass(frozen=True, eq=False)
class Texels:
    """Texels of some triangles.

    Attributes:
        place: Index in the page, row by row; each is there once.
        face: Row of the triangle.
        weight: Barycentric coordinates of the texel's centre in it, which may lie a little outside.
    """

    place: Int64[np.ndarray, " t"]
    face: Int64[np.ndarray, " t"]
    weight: Float32[np.ndarray, "t 3"]


def texels_of(corners: Float64[np.ndarray, "n 3 2"], width: int, height: int) -> Texels:
    """Find the texels in and right beside triangles; one beside several belongs to that which it is deepest in.

    Args:
        corners: Column and row of the triangles' corners in a page.
        width: Width of the page, texels.
        height: Height of the page, texels.
    """
    parts = [_covered(corners[start : start + BATCH], start, width, height) for start in range(0, len(corners), BATCH)]
    empty = Texels(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3), np.float32))
    every = [empty, *parts]
    place, face, weight = (np.concatenate([getattr(each, name) for each in every]) for name in vars(empty))
    order = np.lexsort((face, -weight.min(axis=1), place))
    first = np.ones(len(order), np.bool_)
    first[1:] = place[order][1:] != place[order][:-1]
    kept = order[first]
    return Texels(place[kept], face[kept], weight[kept])


def _covered(corners: Float64[np.ndarray, "n 3 2"], start: int, width: int, height: int) -> Texels:
    low = np.clip(np.floor(corners.min(axis=1) - REACH), 0, [width - 1, height - 1]).astype(np.int64)
    high = np.clip(np.floor(corners.max(axis=1) + REACH), 0, [width - 1, height - 1]).astype(np.int64)
    across, down = (high - low + 1).T
    count = across * down
    face = np.repeat(np.arange(len(corners)), count)
    number = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    column, row = low[face, 0] + number % across[face], low[face, 1] + number // across[face]
    a, b, c = (corners[:, k] for k in range(3))
    first, second = b - a, c - a
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    area = np.where(np.abs(area) > 1e-9, area, np.inf)  # edge on: at its first corner
    x, y = column + 0.5 - a[face, 0], row + 0.5 - a[face, 1]
    second_weight = (x * second[face, 1] - y * second[face, 0]) / area[face]
    third_weight = (first[face, 0] * y - first[face, 1] * x) / area[face]
    weight = np.stack([1.0 - second_weight - third_weight, second_weight, third_weight], axis=1)
    longest = np.sqrt(np.maximum(np.square(first).sum(axis=1), np.square(second).sum(axis=1)))
    least_height = np.minimum(np.abs(area) / np.maximum(longest, 1e-9), 1e9)  # texels in a unit of weight, or fewer
    near = weight.min(axis=1) >= -REACH / np.maximum(least_height[face], REACH)
    return Texels((row * width + column)[near], (face + start)[near], weight[near].astype(np.float32))
