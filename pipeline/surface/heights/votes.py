"""Height votes of photos in a tile's cells, and the surface layers that follow from them, by native kernels.

A photo's pixels are small planes. Each surface of a photo that covers a cell is one vote, with an expected deviation;
surfaces on which votes of several photos agree are layers, and a layer's height is their robust mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32

from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.native_camera import native_camera
from splatpipe.pipeline.surface.depths.sources import HeightRange, PhotoWindow, PosedDepthMap
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile

MIN_COVER_SHARE = 0.5  # share of a cell that a surface covers above another one: otherwise edges would grow
LAYERS = 3  # surfaces above each other in a cell that are considered


@dataclass(frozen=True)
class Layer:
    """A candidate surface, one entry per cell.

    Attributes:
        height: Height of its median vote, local metres; NaN where a cell has none.
        count: Number of votes, i.e. photos.
        cover: Share of the cell that it covers, the mean over its votes.
    """

    height: Float64[np.ndarray, " c"]
    count: Int32[np.ndarray, " c"]
    cover: Float64[np.ndarray, " c"]


@dataclass(frozen=True)
class Fit:
    """Heights of cells from all votes near them.

    Attributes:
        height: Local metres; NaN where there is none.
        sigma: Its expected deviation, metres.
        photos: How many photos agree: the votes, or the photos that confirm one of them if these are more.
    """

    height: Float64[np.ndarray, " c"]
    sigma: Float64[np.ndarray, " c"]
    photos: Int32[np.ndarray, " c"]


class HeightVotes:
    """Height votes of photos in a tile's cells; photos must always be added in the same order.

    Args:
        lattice: The lattice of the tile.
        tile: The tile.
        relief: Height range of the votes.

    Raises:
        ValueError: if the relief is higher than 13 km.
    """

    def __init__(self, lattice: Lattice, tile: Tile, relief: HeightRange) -> None:
        self._cells = tile.height * tile.width
        self._held = _native.CellVotes(
            (lattice.east_m, lattice.north_m, lattice.cell_m),
            (tile.row, tile.column, tile.height, tile.width),
            (relief.low_m, relief.high_m),
        )

    def add(self, found: PosedDepthMap, window: PhotoWindow) -> None:
        """Add a photo's votes; bit-identical for any window and any tile.

        Args:
            found: The photo's depths.
            window: The window of the photo that may show the tile.
        """
        corners = (window.left, window.top, window.right, window.bottom)
        self._held.add(found.depth, found.confidence, native_camera(found.camera), corners)

    def layers(self) -> list[Layer]:
        """The surfaces that enough photos agree on in each cell, from the top."""
        shape = (LAYERS, self._cells)
        height, count, cover = np.empty(shape), np.empty(shape, np.int32), np.empty(shape)
        self._held.layers(height, count, cover)
        return [Layer(height[k], count[k], cover[k]) for k in range(LAYERS) if count[k].any()]

    def fit(self, start: Float64[np.ndarray, " c"]) -> Fit:
        """The robust mean of each cell's votes about a height (Tukey's biweight; Beaton and Tukey 1974).

        Args:
            start: A height near most of the surface's votes; NaN where there is none.
        """
        fit = Fit(np.empty(self._cells), np.empty(self._cells), np.empty(self._cells, np.int32))
        self._held.fit(start, fit.height, fit.sigma, fit.photos)
        return fit


def needs_check(found: Sequence[Layer], least: int) -> Bool[np.ndarray, " c"]:
    """Cells with several surfaces, or with one that few photos saw, which need a check for photos that see through."""
    first = found[0]
    few = (first.count < least) & np.isfinite(first.height)
    several = np.isfinite(found[1].height) if len(found) > 1 else np.zeros(len(few), np.bool_)
    return np.asarray(few | several)
