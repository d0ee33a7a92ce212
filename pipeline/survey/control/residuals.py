"""Statistics of residuals at surveyed points: RMSE, means, and confidence intervals for small samples."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.special import gammaincinv

DIGITS = 6  # decimals of lengths in metres
CONFIDENCE = 0.95


def accuracy_table(residuals: Float64[np.ndarray, "n 3"]) -> dict[str, Any] | None:
    """A group's table in `accuracy.json` and `metrics.json`.

    Args:
        residuals: East, north, up (metres), estimated less surveyed; NaN where not measured.

    Returns:
        Root mean squares (``horizontal`` and ``3d``: of the vectors' lengths), means, and the 95 % intervals of the
        horizontal and the vertical one, assuming independent and normal residuals; None without points. Unknown values
        are None.
    """
    if not len(residuals):
        return None
    east, north, up = (residuals[:, axis][np.isfinite(residuals[:, axis])] for axis in range(3))
    flat, whole = (rows[np.isfinite(rows).all(axis=1)] for rows in (residuals[:, :2], residuals))
    horizontal, vertical = _rms(np.linalg.norm(flat, axis=1)), _rms(up)
    return {
        "count": len(residuals),
        "rmse_east_m": _rms(east),
        "rmse_north_m": _rms(north),
        "rmse_up_m": vertical,
        "rmse_horizontal_m": horizontal,
        "rmse_3d_m": _rms(np.linalg.norm(whole, axis=1)),
        "interval_95_horizontal_m": _interval(horizontal, 2 * len(flat)),
        "interval_95_vertical_m": _interval(vertical, len(up)),
        "mean_m": [round(float(each.mean()), DIGITS) if len(each) else None for each in (east, north, up)],
        "flights": [],
    }


def rmse_interval(rmse: float, values: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of the standard deviation behind an RMSE of normal residuals.

    Args:
        rmse: Root mean square of ``values`` independent residuals of mean zero.
        values: Number of residuals; at least one.
    """
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = chi_squared_quantile(1.0 - tail, values), chi_squared_quantile(tail, values)
    return rmse * math.sqrt(values / low), rmse * math.sqrt(values / high)


def chi_squared_quantile(probability: float, degrees: int) -> float:
    """Return the quantile of the chi-squared distribution, of which half is gamma-distributed."""
    return 2.0 * float(gammaincinv(degrees / 2.0, probability))


def _rms(values: Float64[np.ndarray, " n"]) -> float | None:
    return round(float(np.sqrt((values**2).mean())), DIGITS) if len(values) else None


def _interval(rmse: float | None, values: int) -> list[float] | None:
    return None if rmse is None else [round(bound, DIGITS) for bound in rmse_interval(rmse, values)]
