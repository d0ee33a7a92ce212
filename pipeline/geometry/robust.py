"""Robust fits: weights by which outliers count little, and the similarity that repeated fits with them lead to.

P. J. Huber, "Robust Statistics" (1981).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.geometry.similarity import Similarity, fit_similarity

CAUCHY = 2.385  # spreads at which a Cauchy weight is 1/2: 95 % efficiency on Gaussian noise
MAD_TO_SIGMA = 1.4826  # standard deviation of Gaussian noise over its median absolute deviation
FLOOR_MEDIANS = 0.1  # of the lengths: a weight that grew on would hold a fit to a single point
_LEAST = 1e-9  # least residual that is told from 0


def cauchy_weights(
    residuals: Float64[np.ndarray, " n"], spread: float | Float64[np.ndarray, " n"], half_at: float = CAUCHY
) -> Float64[np.ndarray, " n"]:
    """Cauchy's weights, which never become 0.

    Args:
        residuals: Of any sign.
        spread: Their standard deviation without outliers, in the same unit.
        half_at: Spreads at which a weight is 1/2.
    """
    return np.asarray(1.0 / (1.0 + (residuals / (half_at * spread)) ** 2))


def huber_weights(residuals: Float64[np.ndarray, " n"], limit: float) -> Float64[np.ndarray, " n"]:
    """Huber's weights: 1 up to a limit, then falling with the residual.

    Args:
        residuals: Of any sign.
        limit: In the same unit.
    """
    return np.asarray(np.minimum(1.0, limit / np.maximum(np.abs(residuals), _LEAST)))


def absolute_weights(lengths: Float64[np.ndarray, " n"], floor: float | None = None) -> Float64[np.ndarray, " n"]:
    """Weights with which repeated least squares finds the least sum of lengths instead of their squares.

    Args:
        lengths: Lengths of the residuals.
        floor: Length below which the weight no longer grows; None for a tenth of the median.
    """
    least = FLOOR_MEDIANS * max(float(np.median(lengths)), _LEAST) if floor is None else floor
    return np.asarray(1.0 / np.maximum(lengths, least))


def robust_similarity(
    source: Float64[np.ndarray, "n 3"],
    target: Float64[np.ndarray, "n 3"],
    weigh: Callable[[Float64[np.ndarray, " n"]], Float64[np.ndarray, " n"]],
    rounds: int,
) -> tuple[Similarity, Float64[np.ndarray, "n 3"]]:
    """Fit a similarity by least squares again and again, each time with weights by the distances that it left.

    Args:
        source: Points in one frame.
        target: The same points in the other.
        weigh: The weights by the distances.
        rounds: How often.

    Returns:
        The similarity, and what it leaves of the sources at the targets.
    """
    weights = np.ones(len(source))
    for _ in range(rounds):
        scale, rotation, translation = fit_similarity(source, target, weights)
        similarity = Similarity(float(scale), rotation, translation)
        residuals = similarity.apply(source) - target
        weights = weigh(np.linalg.norm(residuals, axis=1))
    return similarity, residuals
