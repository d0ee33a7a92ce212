"""Linear interpolation, between exact nodes on a lattice, of a smooth coordinate transformation that is costly.

From local metres to a CRS and back, PROJ takes microseconds per point, and a surface model has a billion points. Over
short distances, the transformation is linear up to the earth's curvature, s² / 8R between nodes s apart: 0.05 mm for
50 m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

SPACING_M = 50.0  # between nodes: interpolation is off by 0.05 mm a direction
MAX_STEPS = 400  # along a side: beyond 20 km nodes are further apart, and what is between them is off by more
CHUNK = 1 << 16  # points at a time: their products stay in the cache

Points = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """A transformation as polynomials over squares: bilinear in plan, linear in height.

    Attributes:
        low: Corner of the first square, and the reference height of the terms.
        step: Sides of a square; 1 for heights.
        squares: For each square, the eight coefficients of (1, x, y, xy, z, zx, zy, zxy) for the three coordinates.
    """

    low: Float64[np.ndarray, " 3"]
    step: Float64[np.ndarray, " 3"]
    squares: Float64[np.ndarray, "rows columns 8 3"]

    def __call__(self, points: Points) -> Points:
        """Transform points; NaN stays NaN, and squares at the rim are extrapolated beyond the lattice."""
        found = np.empty_like(points)
        for start in range(0, len(points), CHUNK):
            found[start : start + CHUNK] = self._map(points[start : start + CHUNK])
        return found

    def _map(self, points: Points) -> Points:
        x, y, z = ((points - self.low) / self.step).T
        rows, columns = self.squares.shape[:2]
        column = np.clip(np.nan_to_num(x), 0, columns - 1).astype(np.int64)
        row = np.clip(np.nan_to_num(y), 0, rows - 1).astype(np.int64)
        x, y = x - column, y - row
        terms = np.stack([np.ones_like(x), x, y, x * y, z, z * x, z * y, z * x * y], axis=1)
        squares = self.squares.reshape(-1, 8, 3)
        index = row * columns + column
        if len(index) and (index == index[0]).all():  # a tile's cells: one square
            return np.asarray(terms @ squares[index[0]])
        return np.asarray(np.einsum("nt,ntc->nc", terms, squares[index]))


def sample_map(
    exact: Callable[[Points], Points], low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"], spacing: float
) -> SmoothMap:
    """Sample a map over a box.

    Args:
        exact: The exact transformation.
        low: Lowest corner of the box.
        high: Highest corner of the box.
        spacing: Spacing of the nodes, ``SPACING_M`` in the coordinates' unit.
    """
    counts = np.clip(np.ceil((high - low)[:2] / spacing), 1, MAX_STEPS).astype(np.int64)
    xs, ys = (np.linspace(low[axis], high[axis], counts[axis] + 1) for axis in (0, 1))
    nodes = np.stack(np.meshgrid(xs, ys, [low[2], high[2]], indexing="xy"), axis=-1)
    values = exact(nodes.reshape(-1, 3)).reshape(nodes.shape)  # rows, columns, two heights, three coordinates
    base = values[:, :, 0]
    rise = (values[:, :, 1] - base) / (high[2] - low[2])
    squares = np.concatenate([_bilinear(base), _bilinear(rise)], axis=2)
    step = np.append((high - low)[:2] / counts, 1.0)
    return SmoothMap(np.asarray(low, np.float64), step, squares)


def _bilinear(nodes: Float64[np.ndarray, "m n 3"]) -> Float64[np.ndarray, "rows columns 4 3"]:
    """Terms of (1, x, y, xy) of each square from its corners."""
    a, b, c, d = nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]
    return np.stack([a, b - a, c - a, a - b - c + d], axis=2)
