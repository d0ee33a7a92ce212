"""The grid of a raster product in local metres, and the tiles that it is made in."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.surface.tiles import Tile, tiled


@dataclass(frozen=True)
class Lattice:
    """Cells of one size, rows from north to south; turned against north where the map's grid is.

    Attributes:
        east_m: Of the outer corner of the first row's first cell, local metres.
        north_m: Likewise.
        cell_m: Side of a cell.
        width: Columns.
        height: Rows.
        turn_rad: By how much its rows' direction is turned from east towards north.
    """

    east_m: float
    north_m: float
    cell_m: float
    width: int
    height: int
    turn_rad: float = 0.0

    def __post_init__(self) -> None:
        if not (self.cell_m > 0.0 and math.isfinite(self.cell_m)) or min(self.width, self.height) < 1:
            raise ValueError(f"a lattice of {self.width}×{self.height} cells of {self.cell_m} m")

    def tiles(self, side: int) -> Iterator[Tile]:
        """All of it in tiles of so many cells a side at most, row by row."""
        return tiled(self.height, self.width, side)

    def centres(self, tile: Tile) -> Float64[np.ndarray, "h w 2"]:
        """East and north of the cells' centres, the same bits whatever the tile is."""
        columns = (np.arange(tile.column, tile.column + tile.width) + 0.5) * self.cell_m
        rows = (np.arange(tile.row, tile.row + tile.height) + 0.5)[:, None] * self.cell_m
        cosine, sine = math.cos(self.turn_rad), math.sin(self.turn_rad)
        east = self.east_m + (columns * cosine + rows * sine)
        north = self.north_m + (columns * sine - rows * cosine)
        return np.stack([east, north], axis=-1)

    def places(
        self, east: Float64[np.ndarray, " *n"], north: Float64[np.ndarray, " *n"]
    ) -> tuple[Float64[np.ndarray, " *n"], Float64[np.ndarray, " *n"]]:
        """Columns and rows of points, with fractions; the first cell's outer corner is (0, 0)."""
        cosine, sine = math.cos(self.turn_rad), math.sin(self.turn_rad)
        x, y = east - self.east_m, north - self.north_m
        return (x * cosine + y * sine) / self.cell_m, (x * sine - y * cosine) / self.cell_m

    def cells(
        self, tile: Tile, east: Float64[np.ndarray, " n"], north: Float64[np.ndarray, " n"]
    ) -> Int64[np.ndarray, " n"]:
        """Number of the tile's cell that each point lies in, row by row; -1 outside."""
        across, down = self.places(east, north)
        column = np.floor(across).astype(np.int64) - tile.column
        row = np.floor(down).astype(np.int64) - tile.row
        inside = (column >= 0) & (column < tile.width) & (row >= 0) & (row < tile.height)
        return np.where(inside, row * tile.width + column, -1)
