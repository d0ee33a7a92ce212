"""Estimate the noise of a receiver's positions from the residuals of the fitted model, and the fit's accuracy.

A receiver's error changes slowly, so residuals say little about how far the whole model is off: 75 positions from one
minute are not 75 independent observations. The error is therefore modelled as a first-order autoregressive process
along the positions, with its own size and correlation horizontally and in height. These four numbers are estimated by
restricted maximum likelihood (Patterson and Thompson 1971), which accounts for the degrees of freedom that the fit
itself uses; the fit is generalised least squares with them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.geometry.alignment import MEDIAN_OF_CHI3
from splatpipe.pipeline.geometry.correspondences import (
    MIN_NOISE_FACTOR,
    MIN_REDUNDANT_POINTS,
    Correspondences,
    DirectionPrior,
)
from splatpipe.pipeline.geometry.robust import cauchy_weights
from splatpipe.pipeline.geometry.similarity import (
    SIMILARITY,
    Similarity,
    cross_matrix,
    moved_similarity,
    similarity_jacobian,
    solve_step,
)

CORRELATIONS = np.array([*np.arange(0.0, 0.9, 0.05), 0.9, 0.925, 0.95, 0.97, 0.98, 0.99])
MIN_LIKELIHOOD_GAIN = 2.0  # least gain in minus twice the log-likelihood for a correlation to be accepted (Akaike 1974)
GROUP_OF_AXIS = np.array([0, 0, 1])  # east, north; up
TRANSLATION = np.arange(4, SIMILARITY)  # translation among the unknowns of the similarity
MAX_ROUNDS = 40
STEP_TOLERANCE = 1e-9  # size of a step at which iterations end: radians, and relative to the extent
SEARCHED_ROUNDS = 3  # in which every correlation is tried; later ones try only the neighbours of the best
FACTOR_ROUNDS = 2  # each; the rounds of the fit do the rest
MIN_FACTOR = 1e-6  # least noise over the stated sigmas: exact positions have no noise to estimate


@dataclass(frozen=True)
class ReceiverNoise:
    """The error of one position.

    Attributes:
        factors: Its standard deviation horizontally and in height, over the stated one.
        correlations: With the error of the position before, likewise.
        degrees: Degrees of freedom behind the factors; fewer where errors are correlated.
    """

    factors: Float64[np.ndarray, " 2"]
    correlations: Float64[np.ndarray, " 2"]
    degrees: Float64[np.ndarray, " 2"]


@dataclass(frozen=True)
class NoisyFit:
    """A similarity through noisy positions.

    Attributes:
        similarity: Source to target.
        noise: Of the positions.
        covariance: Of a rotation vector (radians, about the target's axes), the scale's logarithm, and the position of
            the points' mean (target's units).
        centre: That mean, in the target.
        offsets: The error that each group shares (target less truth).
    """

    similarity: Similarity
    noise: ReceiverNoise
    covariance: Float64[np.ndarray, "7 7"]
    centre: Float64[np.ndarray, " 3"]
    offsets: Float64[np.ndarray, "g 3"]


def fit_with_noise(
    points: Correspondences,
    before: Int64[np.ndarray, " n"],
    start: Similarity,
    prior: DirectionPrior | None = None,
    *,
    correlated: bool = True,
    held: bool = False,
) -> NoisyFit:
    """Fit a similarity and the noise of its points together, from a similarity near it.

    Gross outliers must be removed beforehand; remaining ones are down-weighted by Cauchy's weights. The position is
    where the residuals' mean is zero: for a drifting error, the likelihood would assume a return to a mean that lies
    outside all positions.

    Args:
        points: At least 3; fewer than 8 keep their stated sigmas, unless they show that these are too small.
        before: For each point, its predecessor in the error process, -1 for none.
        start: Initial similarity, near the solution.
        prior: Directions to include in the fit.
        correlated: Whether errors may be correlated.
        held: Keep the similarity fixed, and estimate only the noise.
    """
    similarity = start
    offsets = np.zeros((0 if points.shared is None else len(points.shared.sigmas), 3))
    noise = ReceiverNoise(np.ones(2), np.zeros(2), np.full(2, float(len(points))))
    for done in range(MAX_ROUNDS):
        rows = _rows(points, before, similarity, offsets)
        extra, pull = _held(points, similarity, prior), _pull(points, similarity, offsets, prior)
        noise = _reml(rows, extra, noise, _tried(noise, len(points) if correlated else 0, done))
        if held and done < SEARCHED_ROUNDS:
            continue
        if held:
            break
        whitened = _whitened(rows, noise)
        weighted = whitened * np.sqrt(_cauchy(whitened))[:, None]
        normal = weighted.T @ weighted
        step = np.zeros(len(pull))
        turning = np.delete(np.arange(len(pull)), TRANSLATION)
        step[turning] = -solve_step(
            (normal[:-1, :-1] + extra)[np.ix_(turning, turning)], (normal[:-1, -1] + pull)[turning]
        )
        similarity = moved_similarity(similarity, points.source, step[:SIMILARITY])
        offsets = offsets + step[SIMILARITY:].reshape(-1, 3)
        step[TRANSLATION] = -_mean_residual(points, similarity, offsets)
        similarity = replace(similarity, translation=similarity.translation + step[TRANSLATION])
        extent = float(np.ptp(points.target, axis=0).max())
        if np.abs(step[:4]).max() < STEP_TOLERANCE and np.abs(step[4:]).max() < STEP_TOLERANCE * extent:
            break
    return _with_covariance(points, before, similarity, offsets, noise, prior)


def _mean_residual(
    points: Correspondences, similarity: Similarity, offsets: Float64[np.ndarray, "g 3"]
) -> Float64[np.ndarray, " 3"]:
    """Mean residual of the three coordinates, weighted by the stated sigmas and Cauchy's weights."""
    residuals = similarity.apply(points.source) - points.without(offsets).target
    weights = _cauchy((residuals / points.sigmas).reshape(-1, 1)).reshape(-1, 3) / points.sigmas**2
    return np.asarray((weights * residuals).sum(axis=0) / weights.sum(axis=0))


def _variance_of_mean(
    points: Correspondences, before: Int64[np.ndarray, " n"], noise: ReceiverNoise
) -> Float64[np.ndarray, " 3"]:
    """Variance of the mean of the positions' own errors, which are correlated along a chain."""
    weights = 1.0 / points.sigmas**2
    shares = noise.factors[GROUP_OF_AXIS] * points.sigmas * weights / weights.sum(axis=0)
    carried, total = np.zeros_like(shares), np.zeros(3)
    for k, last in enumerate(before.tolist()):
        if last >= 0:
            carried[k] = noise.correlations[GROUP_OF_AXIS] * (carried[last] + shares[last])
        total += shares[k] ** 2 + 2.0 * shares[k] * carried[k]
    return total


def _with_covariance(
    points: Correspondences,
    before: Int64[np.ndarray, " n"],
    similarity: Similarity,
    offsets: Float64[np.ndarray, "g 3"],
    noise: ReceiverNoise,
    prior: DirectionPrior | None,
) -> NoisyFit:
    """The fit with its covariance, computed with a lower limit on the noise, since slow errors hide part of it."""
    least = MIN_NOISE_FACTOR if len(points) >= MIN_REDUNDANT_POINTS else 1.0
    cautious = ReceiverNoise(np.maximum(noise.factors, least), noise.correlations, noise.degrees)
    whitened = _whitened(_rows(points, before, similarity, offsets), cautious)[:, :-1]
    information = whitened.T @ whitened + _held(points, similarity, prior)
    covariance = _inverse(information)[:SIMILARITY, :SIMILARITY]
    known = np.diag(covariance)[TRANSLATION]
    own = _variance_of_mean(points, before, cautious)
    covariance[TRANSLATION, TRANSLATION] = np.maximum(known, own)
    centre = similarity.apply(points.source.mean(axis=0)[None])[0]
    return NoisyFit(similarity, noise, covariance, centre, offsets)


@dataclass(frozen=True)
class _ResidualRows:
    """The linear problem: one row per coordinate, over its stated sigma; the last column is the residual.

    Attributes:
        own: Row of each coordinate.
        past: Row of its predecessor; zeros where there is none.
        follows: Whether there is a predecessor.
        group: 0 horizontally, 1 in height.
    """

    own: Float64[np.ndarray, "m p"]
    past: Float64[np.ndarray, "m p"]
    follows: np.ndarray
    group: Int64[np.ndarray, " m"]


def _rows(
    points: Correspondences,
    before: Int64[np.ndarray, " n"],
    similarity: Similarity,
    offsets: Float64[np.ndarray, "g 3"],
) -> _ResidualRows:
    jacobian = similarity_jacobian(similarity, points.source)
    residuals = similarity.apply(points.source) - points.without(offsets).target
    columns = [jacobian]
    if points.shared is not None:
        membership = points.shared.membership().T
        columns.append(np.einsum("ng,kl->nkgl", membership, np.eye(3)).reshape(len(points), 3, -1))
    own = np.concatenate([*columns, residuals[:, :, None]], axis=2) / points.sigmas[:, :, None]
    follows = before >= 0
    past = np.where(follows[:, None, None], own[before], 0.0)
    width = own.shape[2]
    return _ResidualRows(
        own.reshape(-1, width), past.reshape(-1, width), np.repeat(follows, 3), np.tile(GROUP_OF_AXIS, len(points))
    )


def _whitened(rows: _ResidualRows, noise: ReceiverNoise) -> Float64[np.ndarray, "m p"]:
    """Rows whose errors are independent and of size 1."""
    correlation = np.where(rows.follows, noise.correlations[rows.group], 0.0)
    size = noise.factors[rows.group] * np.sqrt(1.0 - correlation**2)
    return np.asarray((rows.own - correlation[:, None] * rows.past) / size[:, None])


def _cauchy(whitened: Float64[np.ndarray, "m p"]) -> Float64[np.ndarray, " m"]:
    """Cauchy weights by the joint residual of each point's three coordinates."""
    normed = np.sqrt((whitened[:, -1].reshape(-1, 3) ** 2).mean(axis=1))
    typical = max(float(np.median(normed)) / MEDIAN_OF_CHI3, 1e-12)
    return np.repeat(cauchy_weights(normed, typical), 3)


def _held(points: Correspondences, similarity: Similarity, prior: DirectionPrior | None) -> Float64[np.ndarray, "p p"]:
    """The information matrix of prior knowledge besides the positions: shared errors and directions."""
    shared = np.zeros(0) if points.shared is None else 1.0 / points.shared.sigmas.ravel() ** 2
    held = np.diag(np.concatenate([np.zeros(SIMILARITY), shared]))
    if prior is not None:
        turned = cross_matrix(prior.source @ similarity.rotation.T)
        held[:3, :3] += (np.swapaxes(turned, 1, 2) @ turned).sum(axis=0) / prior.sigma_rad**2
    return held


def _pull(
    points: Correspondences, similarity: Similarity, offsets: Float64[np.ndarray, "g 3"], prior: DirectionPrior | None
) -> Float64[np.ndarray, " p"]:
    """The gradient of the same prior terms."""
    pull = np.zeros(SIMILARITY + offsets.size)
    if points.shared is not None:
        pull[SIMILARITY:] = (offsets / points.shared.sigmas**2).ravel()
    if prior is not None:
        turned = prior.source @ similarity.rotation.T
        pull[:3] = np.cross(turned, turned - prior.target).sum(axis=0) / prior.sigma_rad**2
    return pull


@dataclass(frozen=True)
class _Group:
    """Products of a group's rows, from which those for any correlation are computed."""

    first: Float64[np.ndarray, "p p"]
    own: Float64[np.ndarray, "p p"]
    mixed: Float64[np.ndarray, "p p"]
    past: Float64[np.ndarray, "p p"]
    count: int
    following: int

    def products(self, correlations: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, "k p p"]:
        """Products of its whitened rows, with factor 1, for the given correlations."""
        by = correlations[:, None, None]
        carried = self.own - by * (self.mixed + self.mixed.T) + by**2 * self.past
        return np.asarray(self.first + carried / (1.0 - by**2))


def _grouped(rows: _ResidualRows, group: int) -> _Group:
    mine, follows = rows.group == group, rows.follows
    first, own, past = rows.own[mine & ~follows], rows.own[mine & follows], rows.past[mine & follows]
    return _Group(first.T @ first, own.T @ own, own.T @ past, past.T @ past, int(mine.sum()), len(own))


def _tried(noise: ReceiverNoise, count: int, done: int) -> list[Float64[np.ndarray, " _"]]:
    """The correlations to try in a round, for each group; a few points do not determine them."""
    if count < MIN_REDUNDANT_POINTS:
        return [CORRELATIONS[:1]] * 2
    if done < SEARCHED_ROUNDS:
        return [CORRELATIONS] * 2
    at = np.searchsorted(CORRELATIONS, noise.correlations).tolist()
    return [CORRELATIONS[max(0, k - 1) : k + 2] for k in at]


def _reml(
    rows: _ResidualRows, held: Float64[np.ndarray, "p p"], noise: ReceiverNoise, tried: list[Float64[np.ndarray, " _"]]
) -> ReceiverNoise:
    """Restricted maximum likelihood at the residuals as they are, one group after the other."""
    groups = [_grouped(rows, group) for group in range(2)]
    factors, correlations, degrees = noise.factors.copy(), noise.correlations.copy(), noise.degrees.copy()
    for group in range(2):
        other = 1 - group
        rest = held + groups[other].products(correlations[other : other + 1])[0, :-1, :-1] / factors[other] ** 2
        found, free, costs = _profile(groups[group], tried[group], rest, float(factors[group]))
        best = int(np.argmin(costs + np.where(tried[group] > 0.0, MIN_LIKELIHOOD_GAIN, 0.0)))
        factors[group], correlations[group] = found[best], tried[group][best]
        squared = float(correlations[group]) ** 2
        degrees[group] = max(1.0, float(free[best]) * (1.0 - squared) / (1.0 + squared))
    return ReceiverNoise(factors, correlations, degrees)


def _profile(
    group: _Group, correlations: Float64[np.ndarray, " k"], rest: Float64[np.ndarray, "q q"], factor: float
) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """For each correlation: the group's factor, the degrees of freedom that the fit leaves it, and minus twice the
    restricted log-likelihood (without what is the same for all)."""
    products = group.products(correlations)
    design, squares = products[:, :-1, :-1], np.maximum(products[:, -1, -1], 0.0)
    factors, free = np.full(len(correlations), factor), np.ones(len(correlations))
    for _ in range(FACTOR_ROUNDS):
        scaled = design / factors[:, None, None] ** 2
        taken = np.einsum("kpq,kqp->k", _inverse(rest + scaled), scaled)
        free = np.maximum(1.0, group.count - taken)
        factors = np.maximum(np.sqrt(squares / free), MIN_FACTOR)
    information = rest + design / factors[:, None, None] ** 2
    sizes = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), 1e-300))
    values = np.linalg.eigvalsh(information / (sizes[:, :, None] * sizes[:, None, :]))
    known = np.log(np.maximum(values, 1e-12)).sum(axis=1) + 2.0 * np.log(sizes).sum(axis=1)
    spread = 2.0 * group.count * np.log(factors) + group.following * np.log(1.0 - correlations**2)
    return factors, free, np.asarray(spread + known + squares / factors**2)


def _inverse(information: Float64[np.ndarray, "*k p p"]) -> Float64[np.ndarray, "*k p p"]:
    """Invert matrices with unknowns of different sizes; an undetermined direction becomes huge, not zero."""
    sizes = np.sqrt(np.maximum(np.diagonal(information, axis1=-2, axis2=-1), 1e-300))
    outer = sizes[..., :, None] * sizes[..., None, :]
    values, vectors = np.linalg.eigh(information / outer)
    least = 1e-14 * np.maximum(values[..., -1:], 1e-300)
    return np.asarray((vectors / np.maximum(values, least)[..., None, :]) @ np.swapaxes(vectors, -1, -2) / outer)
