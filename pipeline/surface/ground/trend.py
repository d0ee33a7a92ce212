"""The trend of a site: a smooth surface that follows its slopes and hills, not its buildings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.surface.ground.membrane import fill_membrane

SQUARE_M = 15.0  # side of the squares for which it is determined
LOW_SHARE = 0.1  # quantile of a square's heights that stands for its ground
MIN_KNOWN_SHARE = 0.1  # of a square, that needs heights

Cells = Float64[np.ndarray, "h w"]


def site_trend(height: Cells, cell_m: float) -> Cells:
    """Low heights of squares, without those that stand out of the squares around, over a plane through all.

    Args:
        height: Metres; NaN where there are none.
        cell_m: Cell size, metres.
    """
    side = max(1, round(SQUARE_M / cell_m))
    low = _low_heights(height, side)
    known = np.isfinite(low)
    if not known.any():
        return np.full(height.shape, float(np.nanmedian(height)))
    plane = _fit_plane(low, known)
    rows, columns = (np.arange(count, dtype=np.float64) for count in low.shape)
    off = fill_membrane(_without_peaks(low - plane.at(rows, columns)))
    if min(off.shape) > 1:
        off = cv2.GaussianBlur(off, (0, 0), 1.0, borderType=cv2.BORDER_REFLECT)
    down, right = ((np.arange(count) + 0.5) / side - 0.5 for count in height.shape)
    at = np.meshgrid(right.astype(np.float32), down.astype(np.float32))
    smooth = cv2.remap(off, *at, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(smooth + plane.at(down, right))


@dataclass(frozen=True)
class _Plane:
    """Height in the first cell, and its increase per row and column."""

    start: float
    down: float
    right: float

    def at(self, rows: Float64[np.ndarray, " r"], columns: Float64[np.ndarray, " c"]) -> Float64[np.ndarray, "r c"]:
        return np.asarray(self.start + self.down * rows[:, None] + self.right * columns)


def _low_heights(height: Cells, side: int) -> Float64[np.ndarray, "r c"]:
    rows, columns = (math.ceil(length / side) for length in height.shape)
    wide = np.full((rows * side, columns * side), np.nan)
    wide[: height.shape[0], : height.shape[1]] = height
    squares = np.sort(wide.reshape(rows, side, columns, side).swapaxes(1, 2).reshape(rows, columns, -1), axis=2)
    count = np.isfinite(squares).sum(axis=2)
    rank = np.floor(LOW_SHARE * np.maximum(count - 1, 0)).astype(np.int64)
    low = np.take_along_axis(squares, rank[..., None], 2)[..., 0]
    return np.where(count >= MIN_KNOWN_SHARE * side * side, low, np.nan)


def _fit_plane(height: Cells, known: Bool[np.ndarray, "h w"]) -> _Plane:
    """The least-squares plane; level in a direction in which there are too few squares."""
    row, column = np.nonzero(known)
    terms = np.column_stack([np.ones(len(row)), row, column])
    start, down, right = np.linalg.lstsq(terms, height[known], rcond=1e-6)[0].tolist()
    return _Plane(start, down, right)


def _without_peaks(height: Cells) -> Cells:
    """Opening with three squares a side."""
    around, known = np.ones((3, 3), np.uint8), np.isfinite(height)
    low = cv2.erode(np.where(known, height, np.inf), around, borderValue=np.inf)
    high = cv2.dilate(np.where(np.isfinite(low), low, -np.inf), around, borderValue=-np.inf)
    return np.where(known, high, np.nan)
