"""Unknown cells of a raster, filled by a membrane that is spanned between the known ones (Laplace's equation).

A plane's membrane is the plane, so under a house on a slope it continues the slope. It is solved from coarse to fine,
each level from that of twice its cells. The fine levels reach a limited number of cells, so that a large raster is
filled window by window, without a seam, once its coarse level is: `shrink` all of it, fill that as a whole, and hand
each window its part.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float64

Cells = Float64[np.ndarray, "h w"]

ROUNDS = 24  # relaxations a level: the coarser levels leave only short waves
OVER = 1.6  # over-relaxation of the two colours of a chessboard
MIN_SIDE = 4  # cells of the coarsest level
LEVELS = 3  # that are filled window by window
SHRUNK = 1 << LEVELS  # cells a side in a cell of the coarse level
# Cells beyond a window on which it depends: two a round and level, and those between which the next level interpolates.
REACH = -(-sum((2 * ROUNDS + 4) << level for level in range(LEVELS)) // SHRUNK) * SHRUNK + SHRUNK


def fill_membrane(height: Cells) -> Cells:
    """Fill cells without a height; all stay NaN if there is none.

    Args:
        height: NaN where unknown.
    """
    known = np.isfinite(height)
    if known.all() or not known.any():
        return height.copy()
    if min(height.shape) <= MIN_SIDE:
        return _relaxed(np.where(known, height, height[known].mean()), ~known)
    return _from_coarse(height, fill_membrane(_halved(height)))


def shrink(height: Cells) -> Float64[np.ndarray, "r c"]:
    """Means of the known cells, on the coarse level; NaN where there is none."""
    for _ in range(LEVELS):
        height = _halved(height)
    return height


def fill_window(height: Cells, coarse: Float64[np.ndarray, "r c"]) -> Cells:
    """Fill a window of a raster; further than ``REACH`` from its borders as if the raster was filled as a whole.

    Args:
        height: NaN where unknown; the window begins at a multiple of ``SHRUNK`` cells.
        coarse: The window's part of the filled coarse level.
    """
    levels = [height]
    for _ in range(LEVELS - 1):
        levels.append(_halved(levels[-1]))
    filled = coarse
    for level in reversed(levels):
        filled = _from_coarse(level, filled)
    return filled


def _from_coarse(height: Cells, coarse: Float64[np.ndarray, "r c"]) -> Cells:
    known = np.isfinite(height)
    return _relaxed(np.where(known, height, _enlarged(coarse, height.shape)), ~known)


def _halved(height: Cells) -> Float64[np.ndarray, "r c"]:
    """Means of the known cells in blocks of two by two."""
    rows, columns = (side + side % 2 for side in height.shape)
    wide = np.full((rows, columns), np.nan)
    wide[: height.shape[0], : height.shape[1]] = height
    blocks = wide.reshape(rows // 2, 2, columns // 2, 2)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0.0).sum(axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _enlarged(coarse: Cells, shape: tuple[int, ...]) -> Float64[np.ndarray, "r c"]:
    """Cells of half the size, interpolated linearly."""
    rows, columns = coarse.shape
    fine = cv2.resize(coarse, (2 * columns, 2 * rows), interpolation=cv2.INTER_LINEAR)
    return np.asarray(fine[: shape[0], : shape[1]])


def _relaxed(height: Cells, free: Bool[np.ndarray, "h w"]) -> Cells:
    """Successive over-relaxation of the free cells, by colours of a chessboard; nothing flows across the border."""
    wide = np.pad(height, 1, mode="edge").ravel()
    row, column = np.nonzero(free)
    stride = height.shape[1] + 2
    colours = [((row + 1) * stride + column + 1)[(row + column) % 2 == k] for k in (0, 1)]
    framed = wide.reshape(-1, stride)
    for _ in range(ROUNDS):
        for cell in colours:
            around = wide[cell - stride] + wide[cell + stride] + wide[cell - 1] + wide[cell + 1]
            wide[cell] += OVER * (around / 4.0 - wide[cell])
        framed[0], framed[-1] = framed[1], framed[-2]
        framed[:, 0], framed[:, -1] = framed[:, 1], framed[:, -2]
    return framed[1:-1, 1:-1].copy()
