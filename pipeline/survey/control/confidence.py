"""Confidence intervals of an RMSE from few residuals, by the chi-squared distribution."""

from __future__ import annotations

import math

from scipy.special import gammaincinv

CONFIDENCE = 0.95


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
