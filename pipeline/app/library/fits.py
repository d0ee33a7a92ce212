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
MIN_AGREEING = 4  # of more than 3 points: 3 lie in a plane, and fit their own mirror image
MAX_NOISE = 10.0  # times the sigmas: some state theirs too small, but contradicting points are off by far more
Points = NDArray[Any] | Sequence[Sequence[float]]
Sigmas = float | Sequence[float] | NDArray[Any]


def fit_similarity(source: Points, target: Points, sigmas: Sigmas, *, max_error: float | None = None) -> SimilarityFit:
    """Fit scale, rotation and translation to points that are known in two frames, some of which may be wrong.

    Args:
        source: (n, 3) coordinates in the source frame, e.g. of a model, in any unit; at least 3 points.
        target: (n, 3) coordinates of the same points in the target frame, e.g. a projected CRS in metres.
        sigmas: Standard deviations of the target's coordinates: one number, or one per axis, or (n, 3).
        max_error: Points that are further off, in the target's units, are left out, and nearer ones are used whatever
            their sigmas; None to leave out those that are off by far more than the others.

    Returns:
        The fit: ``similarity``, which points were used (``inliers``), residuals and covariance; ``sigmas_at(points)``
        tells how well it places others.

    Raises:
        SplatpipeError: if the points are fewer than 3 or not finite, lie on a line, or contradict each other: of
            more than 3, most and at least 4 must agree, which those of a mirrored frame do only in a plane.
    """
    a, b = _points(source, "source"), _points(target, "target")
    if a.shape != b.shape or len(a) < MIN_POINTS:
        raise UsageError(
            f"{len(a)} points of the source and {len(b)} of the target do not determine a similarity.",
            hint="Give at least 3 points, the same in both frames, in the same order.",
        )
    known, limit = _sigmas(sigmas, b.shape), _limit(max_error)
    if not np.ptp(a, axis=0).any():
        raise SplatpipeError("All points of the source lie in one place.", hint="Give points that lie apart.")
    fit = robust_similarity(Correspondences(a, b, known), limit)
    agreeing, least = int(fit.inliers.sum()), min(len(a), max(MIN_AGREEING, len(a) // 2 + 1))
    if agreeing < least:
        raise SplatpipeError(
            f"The points contradict each other: {agreeing} of {len(a)} agree on a similarity, and {least} have to.",
            hint="Check their order, that both frames are right-handed, and the sigmas.",
        )
    if limit is None and fit.noise > MAX_NOISE:
        raise SplatpipeError(
            f"The points contradict each other: they are off by {fit.noise:.0f} times their sigmas.",
            hint="Check their order, that both frames are right-handed, and the sigmas; or give max_error.",
        )
    if not (math.isfinite(fit.sigma_scale) and math.isfinite(fit.sigma_rotation_rad)):
        raise SplatpipeError(
            "The points lie on a line, which leaves a rotation about it open.", hint="Add a point beside the line."
        )
    return fit


def _limit(max_error: float | None) -> float | None:
    if max_error is None:
        return None
    try:
        limit = float(max_error)
    except (ValueError, TypeError):
        limit = math.nan
    if not limit > 0.0:
        raise UsageError("max_error is not a positive number.", hint="Give a distance in the target's units, or None.")
    return limit


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
