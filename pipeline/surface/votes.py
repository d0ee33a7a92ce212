"""Photos' say about the heights in a tile's cells, and which of them is the top surface: by native kernels.

A photo's pixels are small planes. Where they cover a cell each of its surfaces is one vote, with an expected deviation;
surfaces that votes of several photos agree on are layers, and a layer's height is their robust mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32

from splatpipe.pipeline.raster import _native
from splatpipe.pipeline.raster.native_camera import native_camera
from splatpipe.pipeline.surface.lattice import Lattice
from splatpipe.pipeline.surface.sources import HeightRange, PhotoWindow, PosedDepthMap
from splatpipe.pipeline.surface.tiles import Tile

HALF = 0.5  # of a cell that its surface covers, where there is another one below: else edges would grow outwards
LAYERS = 3  # surfaces above each other in a cell that are looked at


@dataclass(frozen=True)
class Layer:
    """A surface that some cells may have, one row a cell.

    Attributes:
        height: Of its middle vote, local metres; nan where a cell has none.
        count: How many votes: photos.
        cover: How much of the cell it covers, by the mean of its votes.
    """

    height: Float64[np.ndarray, " c"]
    count: Int32[np.ndarray, " c"]
    cover: Float64[np.ndarray, " c"]


@dataclass(frozen=True)
class Fit:
    """Heights of cells from all votes near them.

    Attributes:
        height: Local metres; nan where there is none.
        sigma: Its expected deviation, metres.
        photos: How many agree: votes, or photos that confirm one where those are more.
    """

    height: Float64[np.ndarray, " c"]
    sigma: Float64[np.ndarray, " c"]
    photos: Int32[np.ndarray, " c"]


class HeightVotes:
    """What photos found in a tile's cells; photos are to be added in one order.

    Args:
        lattice: Whose cells.
        tile: Which of them.
        relief: Between which heights.

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
        """A photo's votes: the same bits in any window, and in any tile.

        Args:
            found: Its depths.
            window: Where the tile may lie in it.
        """
        corners = (window.left, window.top, window.right, window.bottom)
        self._held.add(found.depth, found.confidence, native_camera(found.camera), corners)

    def layers(self) -> list[Layer]:
        """The surfaces that enough photos agree on in each cell, from the top."""
        shape = (LAYERS, self._cells)
        height, count, cover = np.empty(shape), np.empty(shape, np.int32), np.empty(shape)
        self._held.layers(height, count, cover)
        return [Layer(height[k], count[k], cover[k]) for k in range(LAYERS) if count[k].any()]

    def fitted(self, start: Float64[np.ndarray, " c"]) -> Fit:
        """The robust mean of each cell's votes about a height (Tukey's biweight; Beaton and Tukey 1974).

        Args:
            start: A height that most votes of the surface lie near; nan where there is none.
        """
        fit = Fit(np.empty(self._cells), np.empty(self._cells), np.empty(self._cells, np.int32))
        self._held.fit(start, fit.height, fit.sigma, fit.photos)
        return fit


def undecided(found: Sequence[Layer], least: int) -> Bool[np.ndarray, " c"]:
    """Cells with several surfaces, or with one that few photos saw: photos that look through it are to be asked."""
    first = found[0]
    few = (first.count < least) & np.isfinite(first.height)
    several = np.isfinite(found[1].height) if len(found) > 1 else np.zeros(len(few), np.bool_)
    return np.asarray(few | several)
