"""Square cells on a plane, in metres, and the tiles in which they are processed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.surface.rasters.tiles import Tile, tiled


@dataclass(frozen=True)
class Lattice:
    """Cells of one size, rows from north to south.

    Attributes:
        east_m: East of the outer corner of the first row's first cell, metres along the rows.
        north_m: North of that corner, metres against the columns.
        cell_m: Cell size, metres.
        width: Columns.
        height: Rows.
    """

    east_m: float
    north_m: float
    cell_m: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if not (self.cell_m > 0.0 and math.isfinite(self.cell_m)) or min(self.width, self.height) < 1:
            raise ValueError(f"a lattice of {self.width}×{self.height} cells of {self.cell_m} m")

    def tiles(self, side: int) -> Iterator[Tile]:
        """All cells in tiles of at most ``side`` cells per side, row by row."""
        return tiled(self.height, self.width, side)

    def centres(self, tile: Tile) -> Float64[np.ndarray, "h w 2"]:
        """East and north of the cells' centres, bit-identical for any tile."""
        columns = (np.arange(tile.column, tile.column + tile.width) + 0.5) * self.cell_m
        rows = (np.arange(tile.row, tile.row + tile.height) + 0.5)[:, None] * self.cell_m
        return np.stack(np.broadcast_arrays(self.east_m + columns, self.north_m - rows), axis=-1)

    def places(
        self, east: Float64[np.ndarray, " *n"], north: Float64[np.ndarray, " *n"]
    ) -> tuple[Float64[np.ndarray, " *n"], Float64[np.ndarray, " *n"]]:
        """Columns and rows of points, with fractions; the first cell's outer corner is (0, 0)."""
        return (east - self.east_m) / self.cell_m, (self.north_m - north) / self.cell_m

    def cells(
        self, tile: Tile, east: Float64[np.ndarray, " n"], north: Float64[np.ndarray, " n"]
    ) -> Int64[np.ndarray, " n"]:
        """Index of the tile's cell that each point lies in, row by row; -1 outside."""
        across, down = self.places(east, north)
        column = np.floor(across).astype(np.int64) - tile.column
        row = np.floor(down).astype(np.int64) - tile.row
        inside = (column >= 0) & (column < tile.width) & (row >= 0) & (row < tile.height)
        return np.where(inside, row * tile.width + column, -1)
