"""Tiles: rectangles of a raster's cells that are computed, written and held in memory at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Tile:
    """A rectangle of cells; a grown one may reach beyond its raster.

    Attributes:
        row: Its first row.
        column: Its first column.
        height: Rows.
        width: Columns.
    """

    row: int
    column: int
    height: int
    width: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Its rows and columns, to cut it out of a raster that it lies in."""
        return slice(self.row, self.row + self.height), slice(self.column, self.column + self.width)

    def grown(self, cells: int) -> Tile:
        """The tile extended by a number of cells on every side."""
        return Tile(self.row - cells, self.column - cells, self.height + 2 * cells, self.width + 2 * cells)

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.height * self.width

    def halves(self) -> tuple[Tile, Tile]:
        """Split into two parts along the longer side; a square tile is split by rows."""
        if self.height >= self.width:
            upper = self.height // 2
            return replace(self, height=upper), replace(self, row=self.row + upper, height=self.height - upper)
        left = self.width // 2
        return replace(self, width=left), replace(self, column=self.column + left, width=self.width - left)


def tiled(height: int, width: int, side: int) -> Iterator[Tile]:
    """Divide a raster into tiles of at most ``side`` cells per side, row by row.

    Args:
        height: Rows of the raster.
        width: Columns of the raster.
        side: Cells per side of a tile.
    """
    for row in range(0, height, side):
        for column in range(0, width, side):
            yield Tile(row, column, min(side, height - row), min(side, width - column))
