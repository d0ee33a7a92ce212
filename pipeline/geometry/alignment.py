"""Robust similarity between two point sets with outliers, and how well the points determine it."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.geometry.correspondences import (
    MIN_NOISE_FACTOR,
    MIN_REDUNDANT_POINTS,
    Correspondences,
    DirectionPrior,
    InlierLimit,
    SharedErrors,
    normed,
)
from splatpipe.pipeline.geometry.robust import CAUCHY
from splatpipe.pipeline.geometry.similarity import (
    RANK_TOLERANCE,
    SIMILARITY,
    Similarity,
    cross_matrix,
    fit_similarity,
    moved_similarity,
    rotation_from_vector,
    similarity_jacobian,
    solve_step,
)

__all__ = [
    "Correspondences",
    "DirectionPrior",
    "SharedErrors",
    "SimilarityFit",
    "offset_step_sigmas",
    "robust_similarity",
    "turn_about_axis",
]

MAX_HYPOTHESES = 1000  # with half the points wrong, one triple in eight is right: odds of missing all are 1e-58
REFINED_HYPOTHESES = 5
LOCAL_ROUNDS = 5
WEAK_ROTATION_RAD = math.radians(5.0)  # a rotation known less well than this uses the prior, if there is one
IRLS_ROUNDS = 50
IRLS_TOLERANCE = 1e-13  # size of a step at which iterations end: radians, and relative to the extent
MEDIAN_OF_CHI3 = math.sqrt(2.365974 / 3.0)  # median of sqrt(chi²_3 / 3)
OUTLIER_NOISES = 8.0  # times the noise; Gaussian errors are never this large
LIMIT_GROWTH = 1.5  # from one limit to the next where the noise has to be estimated
CRITICAL_NOISES, CRITICAL_NOISES_FEW = 4.0, 24.0  # times the noise, by freedom: Student's t at about 1 in 10,000
OUTLIER_SIGMAS = 3.0  # an error within the position's stated accuracy is not an outlier
MIN_NOISE_RATIO = 1e-9  # least noise as a multiple of the stated sigmas: exact data have no spread to measure
MAX_GROUPS = 20  # groups whose own triples are tried: one good group is enough


@dataclass(frozen=True)
class SimilarityFit:
    """A robust similarity and how well it is determined.

    Attributes:
        similarity: Source to target.
        inliers: Which points agree with the fit. Only these took part in it, unless they are fewer than 3: then all
            points did, and the fit is meaningless.
        residuals: Transformed source minus target, in the target's units, with the groups' shared errors removed.
        noise: Robust spread of the residuals over the stated sigmas: 1 where these are right.
        sigma_scale: Relative standard deviation of the scale; infinite where it is not determined.
        sigma_rotation_rad: Standard deviation of the rotation about its weakest axis; infinite where undetermined.
        used_prior: Whether the prior was needed for a rotation that the points leave free.
        offsets: The error that each group shares (target minus truth), in the target's units; empty without groups.
        centre: The mean of the points that took part, in the source frame.
        covariance: Of a rotation vector (radians), the log scale and a translation (target's units), about ``centre``;
            zero for what is not determined.
    """

    similarity: Similarity
    inliers: Bool[np.ndarray, " n"]
    residuals: Float64[np.ndarray, "n 3"]
    noise: float
    sigma_scale: float
    sigma_rotation_rad: float
    used_prior: bool
    offsets: Float64[np.ndarray, "g 3"]
    centre: Float64[np.ndarray, " 3"]
    covariance: Float64[np.ndarray, "7 7"]

    def sigmas_at(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Standard deviations of transformed points (target's units) from the fit's uncertainty, by its covariance.

        Args:
            points: In the source frame.
        """
        jacobian = similarity_jacobian(self.similarity, points, self.centre)
        return np.asarray(np.sqrt(np.einsum("nkp,pq,nkq->nk", jacobian, self.covariance, jacobian)))


def robust_similarity(
    points: Correspondences, max_error: float | None, prior: DirectionPrior | None = None
) -> SimilarityFit:
    """Fit a similarity to points that may include outliers.

    Hypotheses come from triples (every triple of a small set, else 1000 from a fixed seed). They are scored by squared
    residuals truncated at ``max_error`` and refined locally (MSAC: Torr and Zisserman 2000; LO-RANSAC: Chum, Matas and
    Kittler 2003). The best one starts iteratively reweighted least squares with the points' own sigmas and Cauchy
    weights. The result is never a reflection, and bit-identical for the same input. Errors shared by groups are
    estimated as well, each with its sigma as its prior; they are eliminated from the normal equations, so the reported
    accuracies account for them.

    Args:
        points: At least 3, not all in one place.
        max_error: Points further than this from the fit, in the target's units, are left out of it. If None, the noise
            of at least half of the points is estimated, and points that are off by far more are left out.
        prior: Directions used where the points leave a rotation uncertain by more than 5° (points on a line).

    Raises:
        ValueError: if there are fewer than 3 points or their source positions coincide.
    """
    if len(points) < 3:
        raise ValueError("a similarity needs at least 3 points")
    if not np.ptp(points.source, axis=0).any():
        raise ValueError("all points of the source coincide")
    hypotheses = _hypotheses(points)
    if max_error is None:
        fit, limit = _at_own_noise(points, hypotheses)
    else:
        limit = InlierLimit(max_error)
        fit = _refine(_consensus(points, limit, hypotheses), points, limit, None)
    if prior is None or fit.sigma_rotation_rad <= WEAK_ROTATION_RAD:
        return fit
    chosen = points.only(fit.inliers) if fit.inliers.sum() >= 3 else points
    _, axis = _weakest_rotation(_information(_Problem(chosen, fit.similarity), _sigma_weights(chosen), None))
    start = turn_about_axis(fit.similarity, axis, chosen.target.mean(axis=0), prior)
    return _refine(start, points, limit, prior)


def offset_step_sigmas(fit: SimilarityFit, points: Correspondences, reference: int) -> Float64[np.ndarray, "g 3"]:
    """Standard deviations of the differences between each group's offset and the reference group's.

    Args:
        fit: The fit of these points.
        points: Points with shared errors.
        reference: Index of the group that the others are compared with.
    """
    assert points.shared is not None
    chosen = points.only(fit.inliers).at_noise(fit.noise)
    assert chosen.shared is not None
    problem, weights = _Problem(chosen, fit.similarity), _sigma_weights(chosen)
    membership = chosen.shared.membership()
    own = membership @ weights + 1.0 / chosen.shared.sigmas**2
    # An offset is the mean residual of its points, so it moves with the similarity by their mean Jacobian.
    mean = np.einsum("gn,nk,nkp->gkp", membership, weights, problem.jacobian()) / own[:, :, None]
    steps = mean - mean[reference]
    covariance = np.linalg.pinv(_information(problem, weights, None), rcond=RANK_TOLERANCE, hermitian=True)
    variances = np.einsum("gkp,pq,gkq->gk", steps, covariance, steps) + 1.0 / own + 1.0 / own[reference]
    return np.asarray(max(fit.noise, MIN_NOISE_FACTOR) * np.sqrt(np.maximum(variances, 0.0)))


def turn_about_axis(
    similarity: Similarity, axis: Float64[np.ndarray, " 3"], pivot: Float64[np.ndarray, " 3"], prior: DirectionPrior
) -> Similarity:
    """Rotate a similarity's target side about an axis through a pivot to agree best with the prior's directions."""
    across = np.eye(3) - np.outer(axis, axis)
    have, want = prior.source @ similarity.rotation.T @ across, prior.target @ across
    angle = math.atan2(float((np.cross(have, want) @ axis).sum()), float((have * want).sum()))
    turn = rotation_from_vector(axis * angle)
    return Similarity(similarity.scale, turn @ similarity.rotation, turn @ (similarity.translation - pivot) + pivot)


@dataclass(frozen=True)
class _Problem:
    """Least squares linearized at a similarity: unknowns are a rotation vector, the log scale and the translation.

    Coordinates are relative to the points' mean, which decorrelates the unknowns.
    """

    points: Correspondences
    similarity: Similarity

    @property
    def arms(self) -> Float64[np.ndarray, "n 3"]:
        """Vectors from the mean to each transformed point."""
        source = self.points.source
        return np.asarray(self.similarity.scale * ((source - source.mean(axis=0)) @ self.similarity.rotation.T))

    def jacobian(self) -> Float64[np.ndarray, "n 3 7"]:
        """The Jacobian of the transformed points with respect to the unknowns."""
        return similarity_jacobian(self.similarity, self.points.source)

    def moved(self, step: Float64[np.ndarray, " 7"]) -> Similarity:
        """The similarity after a step in the unknowns."""
        return moved_similarity(self.similarity, self.points.source, step)


def _at_own_noise(points: Correspondences, hypotheses: list[Similarity]) -> tuple[SimilarityFit, InlierLimit]:
    """The fit with the smallest inlier limit that does not cut into the noise and keeps at least half of the points.

    If the limit is below the noise, the inliers spread right up to it, which shows in their spread over the fit's
    degrees of freedom. Beyond several times the noise, what lies outside the limit is not noise.

    Returns:
        The fit, and its limit in stated sigmas.
    """
    limit = InlierLimit(OUTLIER_SIGMAS, of_sigmas=True)
    # Errors of all sizes share no common noise level; a limit as wide as the target says nothing.
    widest = float(normed(points.target - points.target.mean(axis=0), points).max())
    while True:
        fit = _refine(_consensus(points, limit, hypotheses), points, limit, None)
        used = int(fit.inliers.sum())
        degrees = max(1, 3 * used - SIMILARITY)
        spread = math.sqrt(3.0 * float((normed(fit.residuals, points)[fit.inliers] ** 2).sum()) / degrees)
        is_consistent = (
            2 * used >= len(points) and limit.most >= (CRITICAL_NOISES + CRITICAL_NOISES_FEW / degrees) * spread
        )
        if is_consistent or used == len(points) or limit.most > widest:
            return fit, limit
        limit = InlierLimit(LIMIT_GROWTH * limit.most, of_sigmas=True)


def _hypotheses(points: Correspondences) -> list[Similarity]:
    """Similarities fitted to triples and, last, to all points; accurate points count more."""
    weights = (np.median(points.sigmas) / points.sigmas).mean(axis=1) ** 2
    triples = _triples(points)
    found = fit_similarity(points.source[triples], points.target[triples], weights[triples])
    hypotheses = [Similarity(float(scale), r, t) for scale, r, t in zip(*found, strict=True) if scale > 0.0]
    return [*hypotheses, _closed_form(points, weights)]


def _consensus(points: Correspondences, limit: InlierLimit, hypotheses: list[Similarity]) -> Similarity:
    """The best hypothesis, refined."""
    weights = (np.median(points.sigmas) / points.sigmas).mean(axis=1) ** 2
    costs = _costs(points, limit, hypotheses)
    best_cost, best = math.inf, hypotheses[-1]
    for index in np.argsort(costs, kind="stable")[:REFINED_HYPOTHESES]:
        candidate, cost = hypotheses[int(index)], float(costs[index])
        for _ in range(LOCAL_ROUNDS):
            if cost < best_cost:
                best_cost, best = cost, candidate
            without_offsets = points.without(_median_offsets(candidate, points))
            near = limit.near(_residuals(candidate, without_offsets), points)
            if near.sum() < 3:
                break
            candidate = _closed_form(without_offsets.only(near), weights[near])
            cost = float(_costs(points, limit, [candidate])[0])
    return best


def _costs(points: Correspondences, limit: InlierLimit, hypotheses: list[Similarity]) -> Float64[np.ndarray, " h"]:
    """Sums of squared residuals truncated at the limit; groups' shared errors are removed as medians."""
    turned = np.stack([hypothesis.scale * hypothesis.rotation for hypothesis in hypotheses])
    residuals = np.einsum("hij,nj->hni", turned, points.source) - points.target
    residuals += np.stack([hypothesis.translation for hypothesis in hypotheses])[:, None]
    for group in range(0 if points.shared is None else len(points.shared.sigmas)):
        assert points.shared is not None
        members = points.shared.group == group
        if members.any():
            residuals[:, members] -= np.median(residuals[:, members], axis=1, keepdims=True)
    return np.asarray(np.minimum(limit.squares(residuals, points), limit.most**2).sum(axis=1))


def _refine(
    start: Similarity, points: Correspondences, limit: InlierLimit, prior: DirectionPrior | None
) -> SimilarityFit:
    """Reweighted least squares on the points near the fit, until the inliers no longer change."""
    similarity = start
    without_offsets = points.without(_median_offsets(start, points))
    inliers = limit.near(_residuals(start, without_offsets), points)
    if inliers.sum() < 3:
        inliers = np.ones(len(points), dtype=bool)
    near, noise, offsets = inliers, 1.0, np.zeros((0, 3))
    for _ in range(LOCAL_ROUNDS):
        similarity, noise, offsets = _reweighted(similarity, points.only(inliers), prior)
        residuals = _residuals(similarity, points.without(offsets))
        off = normed(residuals, points)
        near = limit.near(residuals, points)
        near &= off <= max(OUTLIER_SIGMAS, OUTLIER_NOISES * noise)
        if near.sum() < 3 or (near == inliers).all():
            break
        inliers = near
    chosen = points.only(inliers).at_noise(noise)
    information = _information(_Problem(chosen, similarity), _sigma_weights(chosen), prior)
    factor = max(noise, MIN_NOISE_FACTOR) if len(chosen) >= MIN_REDUNDANT_POINTS else max(noise, 1.0)
    sigma_rotation, _ = _weakest_rotation(information)
    return SimilarityFit(
        similarity=similarity,
        inliers=near,
        residuals=_residuals(similarity, points.without(offsets)),
        noise=noise,
        sigma_scale=factor * _sigma_scale(information),
        sigma_rotation_rad=factor * sigma_rotation,
        used_prior=prior is not None,
        offsets=offsets,
        centre=chosen.source.mean(axis=0),
        covariance=factor**2 * _inverse(information),
    )


def _reweighted(
    similarity: Similarity, points: Correspondences, prior: DirectionPrior | None
) -> tuple[Similarity, float, Float64[np.ndarray, "g 3"]]:
    """Gauss-Newton with Cauchy weights scaled by the residuals' spread; also returns the noise and the offsets."""
    noise = 1.0
    offsets = _median_offsets(similarity, points)
    stated = points
    for _ in range(IRLS_ROUNDS):
        off = normed(_residuals(similarity, points.without(offsets)), points)
        noise = max(float(np.median(off)) / MEDIAN_OF_CHI3, MIN_NOISE_RATIO)
        weights = _sigma_weights(points) / (1.0 + (off / (CAUCHY * noise)) ** 2)[:, None]
        points = stated.at_noise(noise)
        problem = _Problem(points, similarity)
        offsets = _offsets(similarity, points, weights)
        residuals = _residuals(similarity, points.without(offsets))
        gradient = np.einsum("nk,nkp->p", weights * residuals, problem.jacobian())
        if prior is not None:
            turned = prior.source @ similarity.rotation.T
            gradient[:3] += np.cross(turned, turned - prior.target).sum(axis=0) / prior.sigma_rad**2
        step = -solve_step(_information(problem, weights, prior), gradient)
        similarity = problem.moved(step)
        extent = float(np.abs(problem.arms).max())
        if np.abs(step[:4]).max() < IRLS_TOLERANCE and np.abs(step[4:]).max() < IRLS_TOLERANCE * extent:
            break
    return similarity, noise, _offsets(similarity, points, weights)


def _information(
    problem: _Problem, weights: Float64[np.ndarray, "n 3"], prior: DirectionPrior | None
) -> Float64[np.ndarray, "7 7"]:
    """The normal matrix: points weighted, the prior added with its sigma, shared errors eliminated."""
    jacobian = problem.jacobian()
    information = np.einsum("nkp,nk,nkq->pq", jacobian, weights, jacobian)
    shared = problem.points.shared
    if shared is not None:
        coupled = np.einsum("gn,nk,nkp->gkp", shared.membership(), weights, jacobian)
        own = shared.membership() @ weights + 1.0 / shared.sigmas**2
        information -= np.einsum("gkp,gk,gkq->pq", coupled, 1.0 / own, coupled)
    if prior is not None:
        turned = cross_matrix(prior.source @ problem.similarity.rotation.T)
        information[:3, :3] += (np.swapaxes(turned, 1, 2) @ turned).sum(axis=0) / prior.sigma_rad**2
    return np.asarray(information)


def _inverse(information: Float64[np.ndarray, "7 7"]) -> Float64[np.ndarray, "7 7"]:
    """The covariance of a normal matrix, zero where undetermined; unknowns are scaled to equal size first."""
    sizes = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(sizes, sizes)
    return np.asarray(np.linalg.pinv(scaled, rcond=RANK_TOLERANCE, hermitian=True) / np.outer(sizes, sizes))


def _weakest_rotation(information: Float64[np.ndarray, "7 7"]) -> tuple[float, Float64[np.ndarray, " 3"]]:
    """Standard deviation and axis of the least determined rotation, with scale and translation marginalized."""
    others = np.linalg.pinv(information[3:, 3:], hermitian=True)
    left = information[:3, :3] - information[:3, 3:] @ others @ information[3:, :3]
    values, vectors = np.linalg.eigh((left + left.T) / 2.0)
    weakest = float(values[0])
    return (1.0 / math.sqrt(weakest) if weakest > RANK_TOLERANCE * values[2] else math.inf), vectors[:, 0]


def _sigma_scale(information: Float64[np.ndarray, "7 7"]) -> float:
    rest = [0, 1, 2, 4, 5, 6]
    others = np.linalg.pinv(information[np.ix_(rest, rest)], rcond=RANK_TOLERANCE, hermitian=True)
    left = float(information[3, 3] - information[3, rest] @ others @ information[rest, 3])
    return 1.0 / math.sqrt(left) if left > RANK_TOLERANCE * information[3, 3] else math.inf


def _triples(points: Correspondences) -> np.ndarray:
    """Triples of all points; with shared errors, half are drawn within groups, where these errors cancel."""
    everyone = np.arange(len(points))
    if points.shared is None:
        return _triples_of(everyone, MAX_HYPOTHESES)
    groups = [np.flatnonzero(members) for members in points.shared.membership()]
    large = sorted((group for group in groups if len(group) >= 3), key=len, reverse=True)[:MAX_GROUPS]
    share = MAX_HYPOTHESES // (2 * max(1, len(large)))
    within = [_triples_of(group, share) for group in large]
    return np.concatenate([*within, _triples_of(everyone, MAX_HYPOTHESES // 2)])


def _triples_of(indices: np.ndarray, most: int) -> np.ndarray:
    if math.comb(len(indices), 3) <= most:
        return np.asarray(indices[np.array(list(itertools.combinations(range(len(indices)), 3)))])
    generator = np.random.Generator(np.random.PCG64(0))
    draws = [generator.choice(len(indices), 3, replace=False, shuffle=False) for _ in range(most)]
    return np.asarray(indices[np.stack(draws)])


def _closed_form(points: Correspondences, weights: Float64[np.ndarray, " n"]) -> Similarity:
    scale, rotation, translation = fit_similarity(points.source, points.target, weights)
    return Similarity(max(float(scale), 1e-300), rotation, translation)


def _residuals(similarity: Similarity, points: Correspondences) -> Float64[np.ndarray, "n 3"]:
    return np.asarray(similarity.apply(points.source) - points.target)


def _median_offsets(similarity: Similarity, points: Correspondences) -> Float64[np.ndarray, "g 3"]:
    """The error that each group shares, as the median over its points of target minus transformed source."""
    if points.shared is None:
        return np.zeros((0, 3))
    errors = -_residuals(similarity, points)
    offsets = np.zeros_like(points.shared.sigmas)
    for group in range(len(offsets)):
        members = points.shared.group == group
        if members.any():
            offsets[group] = np.median(errors[members], axis=0)
    return offsets


def _offsets(
    similarity: Similarity, points: Correspondences, weights: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "g 3"]:
    """The same by least squares, pulled towards zero by the groups' sigmas."""
    if points.shared is None:
        return np.zeros((0, 3))
    membership = points.shared.membership()
    sums = membership @ (-weights * _residuals(similarity, points))
    return np.asarray(sums / (membership @ weights + 1.0 / points.shared.sigmas**2))


def _sigma_weights(points: Correspondences) -> Float64[np.ndarray, "n 3"]:
    return 1.0 / points.sigmas**2
