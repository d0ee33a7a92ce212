"""A coarse mask of where a surface model has heights, to which products on it are limited."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from rasterio.windows import Window

from splatpipe.pipeline.surface.rasters.geotiff import gdal, open_raster
from splatpipe.pipeline.surface.rasters.tiles import Tile

BLOCK = 64  # cells a side that are known together: a plan of 16 million cells is 4,000 blocks


@dataclass(frozen=True, eq=False)
class KnownCells:
    """Blocks of a raster's cells.

    Attributes:
        blocks: Whether any cell of each block has a height.
    """

    blocks: Bool[np.ndarray, "rows columns"]

    def any_in(self, part: Tile) -> bool:
        """Whether any block that overlaps a part has heights; there are none outside of the raster."""
        rows = slice(max(part.row, 0) // BLOCK, max(part.row + part.height - 1, -1) // BLOCK + 1)
        columns = slice(max(part.column, 0) // BLOCK, max(part.column + part.width - 1, -1) // BLOCK + 1)
        return bool(self.blocks[rows, columns].any())


def known_cells(dsm: Path) -> KnownCells:
    """Read where a surface model has heights.

    Args:
        dsm: A tiled GeoTIFF of heights; it is read once, one row of blocks at a time.
    """
    with gdal(dsm.parent), open_raster(dsm) as raster:
        rows = []
        for top in range(0, raster.height, BLOCK):
            window = Window(0, top, raster.width, min(BLOCK, raster.height - top))
            known = raster.read_masks(1, window=window).any(axis=0)
            rows.append(np.logical_or.reduceat(known, np.arange(0, raster.width, BLOCK)))
    return KnownCells(np.stack(rows))
