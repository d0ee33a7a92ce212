"""Mosaicking: chooses the best photo for each cell, with seamlines where photos look alike.

The best photo has the least cost, averaged around each cell (Hosni et al., "Fast Cost-Volume Filtering", 2013); the
cost is higher where it differs from most others, e.g. for cars that drove on or objects missing from the depths. Then
seams move, one chessboard colour after the other, to where both photos look alike, by the seam cost of Kwatra et al.
("Graphcut Textures", 2003), and colours are blended over a few cells at seams.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Int16, UInt8, UInt16

from splatpipe.pipeline.native import _native

MAX_CANDIDATES = 8  # candidate photos per cell: enough to detect outliers
MARGIN: int = _native.MOSAIC_MARGIN  # cells around a tile that its colours depend on


@dataclass(frozen=True, eq=False)
class Mosaic:
    """Cells coloured by photos.

    Attributes:
        label: Index of the photo that colours each cell; -1 where none sees it.
        colour: That photo's colour, blended at seams; black where there is none.
    """

    label: Int16[np.ndarray, "h w"]
    colour: UInt8[np.ndarray, "h w 3"]


def keep_best(seen: Bool[np.ndarray, "n h w"], cost: UInt16[np.ndarray, "n h w"]) -> UInt8[np.ndarray, "h w"]:
    """Keep for each cell only the few cheapest photos that see it; the others need not be read.

    Args:
        seen: Whether a photo sees a cell; changed in place.
        cost: Cost of colouring the cell from the photo.

    Returns:
        How many photos saw each cell, at most 255.
    """
    seen_by = np.empty(seen.shape[1:], np.uint8)
    _native.keep_best(seen.view(np.uint8), cost, MAX_CANDIDATES, seen_by)
    return seen_by


def compose_mosaic(
    seen: Bool[np.ndarray, "n h w"],
    cost: UInt16[np.ndarray, "n h w"],
    colour: UInt8[np.ndarray, "n h w 3"],
    parity: int,
) -> Mosaic:
    """Colour cells from photos; bit-identical for any tiling, except within ``MARGIN`` of the rim.

    Args:
        seen: Whether a photo sees a cell.
        cost: Cost of colouring the cell from the photo; also given where it does not see the cell, because a cell's
            surroundings count. Changed in place.
        colour: Levelled colours; black where the photo does not see the cell.
        parity: 0 or 1: colour of the first cell on the whole image's chessboard.
    """
    shape = seen.shape[1:]
    made = Mosaic(np.empty(shape, np.int16), np.empty((*shape, 3), np.uint8))
    _native.compose_mosaic(seen.view(np.uint8), cost, colour, parity, made.label, made.colour)
    return made


def extend_colours(
    colour: UInt8[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"], wanted: Bool[np.ndarray, "h w"], cells: int
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Extend colours from known into wanted cells, cell by cell outwards, up to a number of cells.

    Returns:
        The colours, and which cells have one now.
    """
    colour, known = colour.copy(), known.copy()
    for _ in range(cells):
        count = np.asarray(
            cv2.boxFilter(known.astype(np.uint8), cv2.CV_32S, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        )
        new = wanted & ~known & (count > 0)
        if not new.any():
            break
        rows, columns = np.nonzero(new)
        total = np.zeros((len(rows), 3), np.int64)
        wide, there = np.pad(colour, ((1, 1), (1, 1), (0, 0))), np.pad(known, 1)
        for down in (0, 1, 2):
            for right in (0, 1, 2):
                at = (rows + down, columns + right)
                total += np.where(there[at][:, None], wide[at], 0)
        number = count[rows, columns][:, None]
        colour[rows, columns] = (total + number // 2) // number
        known |= new
    return colour, known
