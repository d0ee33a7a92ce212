"""Blocks of a raster's cells, as the coarse cells on which ground is searched for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.surface.rasters.tiles import Tile, tiled

BLOCK_M = 0.25  # side of a block: half the width of a hedge
MIN_BLOCK, MAX_BLOCK = 3, 32  # cells: a quantile of fewer is noise
SIDE = 2048  # cells per side of a part that is computed at a time
LOW_SHARE = 0.25  # quantile of a block's heights: below leaves, above single low values
MIN_KNOWN_SHARE = 0.2  # of a block's cells that need a height
STEP = 8  # blocks: parts begin at multiples, as levels of detail do


@dataclass(frozen=True)
class BlockGrid:
    """A raster's cells in square blocks, those at the right and at the bottom partly beyond it.

    Attributes:
        side: Cells per side of a block.
        height: Rows of blocks.
        width: Columns of blocks.
    """

    side: int
    height: int
    width: int

    @staticmethod
    def of(height: int, width: int, cell_m: float) -> BlockGrid:
        """The blocks of a raster.

        Args:
            height: Its rows.
            width: Its columns.
            cell_m: Its cell size, metres.
        """
        side = min(max(math.ceil(BLOCK_M / cell_m), MIN_BLOCK), MAX_BLOCK)
        return BlockGrid(side, math.ceil(height / side), math.ceil(width / side))

    def parts(self) -> list[Tile]:
        """Tiles of blocks that are computed at a time."""
        return list(tiled(self.height, self.width, max(STEP, SIDE // self.side // STEP * STEP)))

    def window(self, part: Tile, margin: int) -> Tile:
        """A part with a margin of blocks, where there are any; it begins at a multiple of ``STEP``."""
        margin = -(-margin // STEP) * STEP
        top, left = max(0, part.row - margin), max(0, part.column - margin)
        bottom = min(self.height, part.row + part.height + margin)
        right = min(self.width, part.column + part.width + margin)
        return Tile(top, left, bottom - top, right - left)

    def cells(self, blocks: Tile) -> Tile:
        """The cells of some blocks."""
        row, column, height, width = (
            self.side * each for each in (blocks.row, blocks.column, blocks.height, blocks.width)
        )
        return Tile(row, column, height, width)


def inner(part: Tile, window: Tile) -> tuple[slice, slice]:
    """Rows and columns of a window that a part of it has."""
    return Tile(part.row - window.row, part.column - window.column, part.height, part.width).slices


def blocked(values: np.ndarray, side: int) -> np.ndarray:
    """Cells by block: (rows, columns, cells of a block)."""
    rows, columns = values.shape[0] // side, values.shape[1] // side
    return values.reshape(rows, side, columns, side).swapaxes(1, 2).reshape(rows, columns, side * side)


def unblocked(values: np.ndarray, side: int) -> np.ndarray:
    """Values of blocks for each of their cells."""
    return np.repeat(np.repeat(values, side, axis=0), side, axis=1)


def quantiles(
    heights: Float64[np.ndarray, "h w"], side: int, shares: tuple[float, ...]
) -> list[Float64[np.ndarray, "r c"]]:
    """Quantiles of the heights in each block; NaN where too few are known."""
    ordered = np.sort(blocked(heights, side), axis=2)
    count = np.isfinite(ordered).sum(axis=2)
    found = []
    for share in shares:
        rank = np.floor(share * np.maximum(count - 1, 0)).astype(np.int64)
        value = np.take_along_axis(ordered, rank[..., None], 2)[..., 0]
        found.append(np.where(count >= MIN_KNOWN_SHARE * side * side, value, np.nan))
    return found


def mean_heights(heights: Float64[np.ndarray, "h w"], side: int) -> Float64[np.ndarray, "r c"]:
    """Means of the heights in each block; NaN where too few are known."""
    cells = blocked(heights, side)
    known = np.isfinite(cells)
    count = known.sum(axis=2)
    mean = np.where(known, cells, 0.0).sum(axis=2) / np.maximum(count, 1)
    return np.where(count >= MIN_KNOWN_SHARE * side * side, mean, np.nan)
