"""What a few residuals tell: confidence intervals of a root mean square error, from the chi-squared distribution."""

from __future__ import annotations

import math

from scipy.special import gammaincinv

CONFIDENCE = 0.95


def rmse_interval(rmse: float, values: int) -> tuple[float, float]:
    """Where the true standard deviation lies, of which so many normal residuals showed this RMSE, with 95 %.

    Args:
        rmse: Root mean square of ``values`` independent residuals of mean zero.
        values: How many; at least one.
    """
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = chi_squared_quantile(1.0 - tail, values), chi_squared_quantile(tail, values)
    return rmse * math.sqrt(values / low), rmse * math.sqrt(values / high)


def chi_squared_quantile(probability: float, degrees: int) -> float:
    """The value that a chi-squared variable stays below with this probability: its half is a gamma variable."""
    return 2.0 * float(gammaincinv(degrees / 2.0, probability))
