"""What residuals at surveyed points say: root mean squares, means, and the interval that so few of them allow."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.scene.confidence import rmse_interval

DIGITS = 5  # of lengths in metres: a hundredth of a millimetre


def accuracy_table(residuals: Float64[np.ndarray, "n 3"]) -> dict[str, Any] | None:
    """A group's table in `accuracy.json` and `metrics.json`.

    Args:
        residuals: East, north, up (metres), estimated less surveyed; up is NaN where nobody measured it.

    Returns:
        Root mean squares (``horizontal`` and ``3d``: of the vectors' lengths), means, and 95 % intervals of the
        horizontal and vertical ones; None without points. What is not known is None.
    """
    if not len(residuals):
        return None
    heights = residuals[:, 2][np.isfinite(residuals[:, 2])]
    squares = residuals**2
    both = squares[np.isfinite(residuals[:, 2])].sum(axis=1)
    horizontal, vertical = _root(squares[:, :2].sum(axis=1)), _root(heights**2)
    return {
        "count": len(residuals),
        "rmse_east_m": _root(squares[:, 0]),
        "rmse_north_m": _root(squares[:, 1]),
        "rmse_up_m": vertical,
        "rmse_horizontal_m": horizontal,
        "rmse_3d_m": _root(both),
        "interval_95_horizontal_m": _interval(horizontal, 2 * len(residuals)),
        "interval_95_vertical_m": _interval(vertical, len(heights)),
        "mean_m": [_mean(residuals[:, 0]), _mean(residuals[:, 1]), _mean(heights)],
    }


def _root(squares: Float64[np.ndarray, " n"]) -> float | None:
    return round(float(np.sqrt(squares.mean())), DIGITS) if len(squares) else None


def _mean(values: Float64[np.ndarray, " n"]) -> float | None:
    return round(float(values.mean()), DIGITS) if len(values) else None


def _interval(rmse: float | None, values: int) -> list[float] | None:
    return None if rmse is None else [round(bound, DIGITS) for bound in rmse_interval(rmse, values)]
