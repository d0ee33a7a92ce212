"""Holes in a height model, filled from their surroundings."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

MIN_DIRECTIONS = 3  # fewest of the four directions with a height within reach
STEP_CELLS = 3.0  # heights this many cells above the lowest one nearby are another surface: a hole at a wall is ground


def fill_holes(
    height: Float64[np.ndarray, "h w"], cell_m: float, reach: int, upright: bool = False
) -> tuple[Float64[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Fill cells that have heights nearby on at least three sides.

    Args:
        height: Metres, NaN in holes.
        cell_m: Cell size, metres.
        reach: Cells searched on each side: wider holes stay.
        upright: Whether they are depths of a wall.

    Returns:
        The heights, and which are new. At an edge, the lower surface is more likely to be hidden, so a hole between two
        surfaces gets the lower height; on a wall, where photos look from all sides, the nearer one.
    """
    rows, columns = np.nonzero(np.isnan(height))
    wide = np.pad(height, reach, constant_values=np.nan)
    values, nearness = [], []
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        value, distance = np.full(len(rows), np.nan), np.full(len(rows), np.inf)
        for step in range(reach, 0, -1):
            there = wide[rows + reach + step * down, columns + reach + step * right]
            known = np.isfinite(there)
            value[known], distance[known] = there[known], step
        values.append(value)
        nearness.append(1.0 / distance)
    value, weight = np.stack(values), np.stack(nearness)
    known = weight > 0.0
    enough = known.sum(axis=0) >= MIN_DIRECTIONS
    like = (
        _best_supported(value, weight, STEP_CELLS * cell_m)
        if upright
        else np.min(np.where(known, value, np.inf), axis=0)
    )
    used = np.where(known & (np.abs(value - like) <= STEP_CELLS * cell_m), weight, 0.0)
    total = used[0] + used[1] + used[2] + used[3]
    parts = used * np.where(known, value, 0.0)
    mean = (parts[0] + parts[1] + parts[2] + parts[3]) / np.where(total > 0.0, total, 1.0)
    result, new = height.copy(), np.zeros(height.shape, np.bool_)
    result[rows[enough], columns[enough]] = mean[enough]
    new[rows[enough], columns[enough]] = True
    return result, new


def _best_supported(
    value: Float64[np.ndarray, "4 n"], weight: Float64[np.ndarray, "4 n"], step_m: float
) -> Float64[np.ndarray, " n"]:
    """Of the heights around each hole, the one with most support from the others, weighted by nearness."""
    like = np.abs(value[:, None] - value[None]) <= step_m  # False for nan
    support = np.where(weight > 0.0, (like * weight[None]).sum(axis=1), -1.0)
    return np.asarray(np.take_along_axis(value, np.argmax(support, axis=0)[None], 0)[0])
