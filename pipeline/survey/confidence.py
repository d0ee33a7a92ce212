"""What a few residuals tell: confidence intervals of a root mean square error, from the chi-squared distribution."""

from __future__ import annotations

import math

TERMS = 500  # of the series and the continued fraction; some tens suffice below a thousand degrees of freedom
BISECTIONS = 200
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
    """The value that a chi-squared variable stays below with this probability (bisection of its distribution)."""
    low, high = 0.0, degrees + 20.0 * math.sqrt(2.0 * degrees) + 50.0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2.0
        low, high = (middle, high) if chi_squared_cdf(middle, degrees) < probability else (low, middle)
    return (low + high) / 2.0


def chi_squared_cdf(value: float, degrees: int) -> float:
    """Distribution function: the regularised lower incomplete gamma function P(k/2, x/2).

    Below its mean by its power series, above it by Legendre's continued fraction (Abramowitz and Stegun, Handbook of
    Mathematical Functions, 1964, 6.5.29 and 6.5.31, the latter by Lentz's method).
    """
    a, x = degrees / 2.0, value / 2.0
    if x <= 0.0:
        return 0.0
    scale = math.exp(a * math.log(x) - x - math.lgamma(a))
    if x < a + 1.0:
        term = total = 1.0 / a
        for n in range(1, TERMS):
            term *= x / (a + n)
            total += term
            if term < 1e-17 * total:
                break
        return min(1.0, scale * total)
    b = x + 1.0 - a
    c, d = 1e300, 1.0 / b
    fraction = d
    for n in range(1, TERMS):
        numerator = -n * (n - a)
        b += 2.0
        d = 1.0 / (numerator * d + b)
        c = b + numerator / c
        fraction *= c * d
        if abs(c * d - 1.0) < 1e-16:
            break
    return max(0.0, 1.0 - scale * fraction)
