"""Weights of robust fits: how much a residual counts, so that outliers count little.

P. J. Huber, "Robust Statistics" (1981).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

CAUCHY = 2.385  # spreads at which a Cauchy weight is 1/2: 95 % efficiency on Gaussian noise
MAD_TO_SIGMA = 1.4826  # standard deviation of Gaussian noise over its median absolute deviation
_LEAST = 1e-9  # residual below which its weight is surely 1


def cauchy_weights(
    residuals: Float64[np.ndarray, " n"], spread: float | Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Cauchy's weights, which never become 0.

    Args:
        residuals: Of any sign.
        spread: Their standard deviation without outliers, in the same unit.
    """
    return np.asarray(1.0 / (1.0 + (residuals / (CAUCHY * spread)) ** 2))


def huber_weights(residuals: Float64[np.ndarray, " n"], limit: float) -> Float64[np.ndarray, " n"]:
    """Huber's weights: 1 up to a limit, then falling with the residual.

    Args:
        residuals: Of any sign.
        limit: In the same unit.
    """
    return np.asarray(np.minimum(1.0, limit / np.maximum(np.abs(residuals), _LEAST)))
