"""Fit the model to photo positions: inliers, noise, what constrains the rotation, and the uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.alignment import (
    Correspondences,
    DirectionPrior,
    SimilarityFit,
    turn_about_axis,
)
from splatpipe.pipeline.geometry.similarity import Similarity, turn_between
from splatpipe.pipeline.survey.placing.receiver_noise import NoisyFit, ReceiverNoise, fit_with_noise
from splatpipe.pipeline.survey.placing.uncertainty import Uncertainty, uncertainty_of

MIN_POSITIONS = 3
MAX_SIGMA_SCALE = 0.2  # a less certain scale is unusable
MAX_SIGMA_ROTATION_RAD = math.radians(15.0)  # a direction known no better is unusable
DOUBTFUL_UP_RAD = math.radians(2.5)  # where errors drift, an up direction less certain than this may be wrong
CONTRADICTION_SIGMAS = 2.0  # joint sigmas between the positions' directions and those of the cameras
SLOW_CORRELATION = 0.5  # correlation above which the stated accuracy depends on how errors drift
OUTLIER_NOISES = 6.0  # error of an outlier over the noise of all positions
OUTLIER_SIGMAS = 3.0  # error over the stated sigma up to which it is not an outlier
ROUNDS = 4
MAX_LOG_SCALE_CHANGE = math.log(1.5)  # from the robust fit: noise of half of that cannot change it by more


class FrameUndeterminedError(Exception):
    """The positions do not determine the frame; the text is the reason, a sentence without its full stop."""


@dataclass(frozen=True)
class Directions:
    """Information on the model's rotation other than positions.

    Attributes:
        prior: The directions.
        source: Their name, for messages.
        of_gimbal: Whether a gimbal measured them; else they are assumed from how cameras are usually held.
    """

    prior: DirectionPrior
    source: str
    of_gimbal: bool


@dataclass(frozen=True)
class PositionFit:
    """The model's placement by its positions.

    Attributes:
        noisy: The similarity and the noise.
        inliers: Which positions were used.
        residuals: Transformed less stated, with the flights' own errors removed.
        uncertainty: Of the frame.
        held_by: Source of directions used besides the positions; empty where none were used.
        alone_rad: Standard deviation of the rotation about its weakest axis from the positions alone.
        contradicted_rad: Rotation by which the positions alone deviate from the directions, where that is more than the
            errors of both explain; else 0.
    """

    noisy: NoisyFit
    inliers: Bool[np.ndarray, " n"]
    residuals: Float64[np.ndarray, "n 3"]
    uncertainty: Uncertainty
    held_by: str
    alone_rad: float
    contradicted_rad: float


def fit_positions(
    points: Correspondences,
    flights: Int64[np.ndarray, " n"],
    robust: SimilarityFit,
    max_error_m: float | None,
    directions: Directions,
    places: Float64[np.ndarray, "m 3"],
) -> PositionFit:
    """Fit similarity and noise from a robust start.

    Args:
        points: The cameras and their positions, in the order in which they were taken.
        flights: Flight number of each.
        robust: The inliers and an initial similarity.
        max_error_m: Positions further off are excluded; None excludes those that are off by far more than the noise.
        directions: Used where they are better than the positions.
        places: Positions of the model's points.

    Raises:
        FrameUndeterminedError: if scale or rotation is too poorly determined.
    """
    inliers = robust.inliers if robust.inliers.sum() >= MIN_POSITIONS else np.ones(len(points), dtype=bool)
    fit = _fitted(points, flights, inliers, robust.similarity, directions, places)
    for _ in range(ROUNDS):
        near = _near(fit, points, max_error_m)
        if near.sum() < MIN_POSITIONS or (near == fit.inliers).all():
            break
        fit = _fitted(points, flights, near, fit.noisy.similarity, directions, places)
    return fit


def require_determined(fit: PositionFit, points: Correspondences) -> None:
    """Reject a frame whose scale or directions are practically unknown.

    Raises:
        FrameUndeterminedError: with the reason.
    """
    uncertainty = fit.uncertainty
    stated = np.median(points.sigmas, axis=0)[[0, 2]]
    noise_m = float(np.sqrt(((uncertainty.noise.factors * stated)[[0, 0, 1]] ** 2).mean()))
    span_m = float(np.linalg.norm(np.ptp(fit.noisy.similarity.apply(points.source), axis=0)))
    if uncertainty.scale > MAX_SIGMA_SCALE:
        if noise_m > 2.0 * float(stated.max()):
            raise FrameUndeterminedError(
                f"the photo positions do not agree with the model: they are off by {noise_m:,.0f} m or so, and it "
                f"spans {span_m:,.0f} m, so its scale is known only to {100.0 * min(uncertainty.scale, 9.99):.0f} %"
            )
        raise FrameUndeterminedError("the photos were taken too close together for the accuracy of their positions")
    if uncertainty.weakest_rad > MAX_SIGMA_ROTATION_RAD:
        if uncertainty.weakest_rad > 4.0 * MAX_SIGMA_ROTATION_RAD or noise_m <= 2.0 * float(stated.max()):
            raise FrameUndeterminedError(
                "the photos were taken along a line, and the model's rotation about that line is unknown"
            )
        raise FrameUndeterminedError(
            f"the photo positions, off by {noise_m:,.0f} m or so, determine the model's rotation only to"
            f" {math.degrees(uncertainty.weakest_rad):.0f}°"
        )


def capture_order(
    names: Sequence[str], records: Mapping[str, Mapping[str, Any]], times: Mapping[str, str | None]
) -> list[str]:
    """Photos in the order in which they were taken, flight by flight; those with equal or no times by name."""
    return sorted(names, key=lambda name: (int(records[name].get("flight", 0)), times[name] or "", name))


def _fitted(
    points: Correspondences,
    flights: Int64[np.ndarray, " n"],
    inliers: Bool[np.ndarray, " n"],
    start: Similarity,
    directions: Directions,
    places: Float64[np.ndarray, "m 3"],
) -> PositionFit:
    """Fit the inliers: by positions alone if they suffice, else with the directions."""
    chosen = points.only(inliers)
    before = _before(flights[inliers])
    correlated, alone = True, fit_with_noise(chosen, before, start)
    if abs(math.log(alone.similarity.scale / start.scale)) > MAX_LOG_SCALE_CHANGE:
        # A walk is as smooth as slow errors: with a scale near zero, all of it could be explained as error.
        correlated, alone = False, fit_with_noise(chosen, before, start, correlated=False)
    covariance = alone.covariance[:3, :3]
    weakest = math.sqrt(float(np.linalg.eigvalsh(covariance)[-1]))
    off, ratio = _contradiction(alone, directions)
    doubtful = math.sqrt(float(np.trace(covariance[:2, :2]))) > DOUBTFUL_UP_RAD
    drifting = doubtful and float(alone.noise.correlations.max()) > SLOW_CORRELATION
    contradicted = drifting and ratio > CONTRADICTION_SIGMAS
    wanted = directions.prior.sigma_rad if directions.of_gimbal else MAX_SIGMA_ROTATION_RAD
    with_prior = drifting or weakest > wanted
    noisy = alone
    if with_prior:
        # A contradiction of so many sigmas shows that the noise model is wrong: the positions' weight is reduced
        # accordingly, and so is the stated accuracy (Birge, Phys. Rev. 40, 1932).
        doubt = max(1.0, ratio) if drifting else 1.0
        prior = replace(directions.prior, sigma_rad=directions.prior.sigma_rad / doubt)
        _, axes = np.linalg.eigh(covariance)
        turned = turn_about_axis(alone.similarity, axes[:, -1], alone.centre, prior)
        noisy = fit_with_noise(chosen, before, turned, prior, correlated=correlated)
        noisy = replace(noisy, covariance=doubt**2 * noisy.covariance)
    if abs(math.log(noisy.similarity.scale / start.scale)) > MAX_LOG_SCALE_CHANGE:
        noisy = fit_with_noise(chosen, before, start, correlated=False, held=True)
        with_prior = contradicted = False
    stated = np.median(chosen.sigmas, axis=0)[[0, 2]] if points.shared is None else np.zeros(2)
    residuals = noisy.similarity.apply(points.source) - points.without(noisy.offsets).target
    uncertainty = uncertainty_of(noisy, chosen.source, places, stated)
    held_by = directions.source if with_prior else ""
    return PositionFit(noisy, inliers, residuals, uncertainty, held_by, weakest, off if contradicted else 0.0)


def _contradiction(alone: NoisyFit, directions: Directions) -> tuple[float, float]:
    """The angle (radians) between the positions' rotation and the directions, and the same in joint sigmas."""
    prior = directions.prior
    across = turn_between(prior.source @ alone.similarity.rotation.T, prior.target)
    axes = slice(0, 3) if len(prior.source) > 1 else slice(0, 2)  # one direction says nothing about turns around it
    known = np.eye(3) * prior.sigma_rad**2 / max(1.0, len(prior.source) - 1.0)
    joint = (alone.covariance[:3, :3] + known)[axes, axes]
    off = across[axes]
    return float(np.linalg.norm(off)), math.sqrt(float(off @ np.linalg.solve(joint, off)) / len(off))


def _before(flights: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Index of each position's predecessor in its flight; -1 for none."""
    before = np.arange(len(flights), dtype=np.int64) - 1
    before[np.flatnonzero(np.diff(flights, prepend=-1))] = -1
    return before


def _near(fit: PositionFit, points: Correspondences, max_error_m: float | None) -> Bool[np.ndarray, " n"]:
    """Which positions agree with a fit."""
    factors: ReceiverNoise = fit.noisy.noise
    noise = np.sqrt(((fit.residuals / (points.sigmas * factors.factors[[0, 0, 1]])) ** 2).mean(axis=1))
    stated = np.sqrt(((fit.residuals / points.sigmas) ** 2).mean(axis=1))
    near = (noise <= OUTLIER_NOISES) | (stated <= OUTLIER_SIGMAS)
    if max_error_m is not None:
        near = np.linalg.norm(fit.residuals, axis=1) <= max_error_m
    return np.asarray(near)
