"""A finished surface model with interpolation of heights between its cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from splatpipe.pipeline.surface.rasters.lattice import Lattice

MAX_SLOPE = 2.0  # rise over run between neighbouring cells; anything steeper is a step and not interpolated


@dataclass(frozen=True, eq=False)
class HeightField:
    """Heights of all cells, possibly memory-mapped.

    Attributes:
        lattice: The cells' positions.
        height: Local metres at the cells' centres, NaN where there is none.
    """

    lattice: Lattice
    height: Float32[np.ndarray, "h w"]

    def at(self, east: Float64[np.ndarray, " *n"], north: Float64[np.ndarray, " *n"]) -> Float64[np.ndarray, " *n"]:
        """Heights of places: bilinear between smooth cells, the nearest cell's at a step; NaN outside."""
        across, down = self.lattice.places(east, north)
        nearest = self._cell(np.floor(down).astype(np.int64), np.floor(across).astype(np.int64))
        left, top = np.floor(across - 0.5), np.floor(down - 0.5)
        column, row = left.astype(np.int64), top.astype(np.int64)
        x, y = across - 0.5 - left, down - 0.5 - top
        corners = [self._cell(row + i, column + j) for i in (0, 1) for j in (0, 1)]
        low = np.minimum(np.minimum(corners[0], corners[1]), np.minimum(corners[2], corners[3]))
        high = np.maximum(np.maximum(corners[0], corners[1]), np.maximum(corners[2], corners[3]))
        smooth = high - low <= 2.0 * MAX_SLOPE * self.lattice.cell_m  # nan: not smooth
        upper = corners[0] * (1.0 - x) + corners[1] * x
        lower = corners[2] * (1.0 - x) + corners[3] * x
        return np.where(smooth, upper * (1.0 - y) + lower * y, nearest)

    def _cell(self, row: np.ndarray, column: np.ndarray) -> Float64[np.ndarray, " *n"]:
        inside = (row >= 0) & (row < self.lattice.height) & (column >= 0) & (column < self.lattice.width)
        found = self.height[np.where(inside, row, 0), np.where(inside, column, 0)].astype(np.float64)
        return np.where(inside, found, np.nan)
