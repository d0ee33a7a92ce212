"""Rectangles of a raster's cells: what is made, written and held in memory at a time."""

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
        """The same with so many more cells on every side."""
        return Tile(self.row - cells, self.column - cells, self.height + 2 * cells, self.width + 2 * cells)

    @property
    def cells(self) -> int:
        """How many."""
        return self.height * self.width

    def halves(self) -> tuple[Tile, Tile]:
        """Two parts, one after the other along the longer side: rows if they are as many as columns."""
        if self.height >= self.width:
            upper = self.height // 2
            return replace(self, height=upper), replace(self, row=self.row + upper, height=self.height - upper)
        left = self.width // 2
        return replace(self, width=left), replace(self, column=self.column + left, width=self.width - left)


def tiled(height: int, width: int, side: int) -> Iterator[Tile]:
    """All cells of a raster in tiles of so many a side at most, row by row.

    Args:
        height: Rows of the raster.
        width: Its columns.
        side: Of a tile.
    """
    for row in range(0, height, side):
        for column in range(0, width, side):
            yield Tile(row, column, min(side, height - row), min(side, width - column))
