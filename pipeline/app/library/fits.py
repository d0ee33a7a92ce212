"""A similarity between two sets of points, with outliers and its uncertainty, for models of one's own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.geometry.alignment import Correspondences, SimilarityFit, robust_similarity

MIN_POINTS = 3
Points = NDArray[Any] | Sequence[Sequence[float]]
Sigmas = float | Sequence[float] | NDArray[Any]


def fit_similarity(source: Points, target: Points, sigmas: Sigmas, *, max_error: float | None = None) -> SimilarityFit:
    """Fit scale, rotation and translation to points that are known in two frames, some of which may be wrong.

    Args:
        source: (n, 3) coordinates in the source frame, e.g. of a model, in any unit; at least 3 points.
        target: (n, 3) coordinates of the same points in the target frame, e.g. a projected CRS in metres.
        sigmas: Standard deviations of the target's coordinates: one number, or one per axis, or (n, 3).
        max_error: Points that are further off, in the target's units, are left out; None to leave out those that are
            off by far more than the others.

    Returns:
        The fit: ``similarity``, which points were used (``inliers``), residuals and covariance; ``sigmas_at(points)``
        tells how well it places others.

    Raises:
        SplatpipeError: if the points are fewer than 3 or not finite, lie on a line, or contradict each other.
    """
    a, b = _points(source, "source"), _points(target, "target")
    if a.shape != b.shape or len(a) < MIN_POINTS:
        raise UsageError(
            f"{len(a)} points of the source and {len(b)} of the target do not determine a similarity.",
            hint="Give at least 3 points, the same in both frames, in the same order.",
        )
    known = _sigmas(sigmas, b.shape)
    if not np.ptp(a, axis=0).any():
        raise SplatpipeError("All points of the source lie in one place.", hint="Give points that lie apart.")
    fit = robust_similarity(Correspondences(a, b, known), max_error)
    if int(fit.inliers.sum()) < MIN_POINTS:
        raise SplatpipeError(
            "No 3 points agree on a similarity.",
            hint="Check their order, that both frames are right-handed, and the sigmas.",
        )
    if not (math.isfinite(fit.sigma_scale) and math.isfinite(fit.sigma_rotation_rad)):
        raise SplatpipeError(
            "The points lie on a line, which leaves a rotation about it open.", hint="Add a point beside the line."
        )
    return fit


def _points(points: Points, name: str) -> Float64[np.ndarray, "n 3"]:
    try:
        found = np.array(points, dtype=np.float64)
    except (ValueError, TypeError):
        found = np.full(1, np.nan)
    if found.ndim != 2 or found.shape[1] != 3 or not np.isfinite(found).all():
        raise UsageError(f"The {name} points are not (n, 3) finite numbers.", hint="Give x, y, z of each point.")
    return found


def _sigmas(sigmas: Sigmas, shape: tuple[int, ...]) -> Float64[np.ndarray, "n 3"]:
    try:
        known = np.array(np.broadcast_to(np.asarray(sigmas, dtype=np.float64), shape))
    except (ValueError, TypeError) as error:
        raise UsageError("The sigmas do not fit the points.", hint="Give one number, or 3, or (n, 3).") from error
    if not (np.isfinite(known).all() and (known > 0.0).all()):
        raise UsageError("A sigma is not positive.", hint="Give standard deviations in the target's units.")
    return known
