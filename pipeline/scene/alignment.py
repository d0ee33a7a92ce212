"""The robust similarity between two sets of points of which some may be wrong, and how well they determine it."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.scene.similarity import Similarity, cross_matrix, fit_similarity, rotation_from_vector

MAX_HYPOTHESES = 1000  # with half the points wrong, one triple in eight is right: missing it has odds of 1e-58
REFINED_HYPOTHESES = 5
LOCAL_ROUNDS = 5
WEAK_ROTATION_RAD = math.radians(5.0)  # a rotation known less well takes a prior, where there is one
IRLS_ROUNDS = 50
IRLS_TOLERANCE = 1e-13  # of a step, in radians and relative to the extent
FREE = 1e-12  # an eigenvalue below this, relative to the largest, is rounding: its direction is not determined
CAUCHY = 2.385  # 95 % efficiency on Gaussian noise (Huber, Robust Statistics, 1981)
MEDIAN_OF_CHI3 = math.sqrt(2.365974 / 3.0)  # median of sqrt(chi²_3 / 3)
OUTLIER_NOISES = 8.0  # times the noise; Gaussian errors never are so large
OUTLIER_SIGMAS = 3.0  # and an error within what the position states is none
LEAST_NOISE = 1e-9  # of the stated sigmas: exact data have no spread to measure
REDUNDANT = 8  # points from which on the residuals tell the noise better than the stated sigmas do
LEAST_NOISE_FACTOR = 0.3  # GNSS errors change slowly: residuals of one flight look better than the positions are


@dataclass(frozen=True)
class Correspondences:
    """The same points in two frames.

    Attributes:
        source: In the source frame, any units.
        target: In the target frame.
        sigmas: Standard deviations of the target's coordinates.
    """

    source: Float64[np.ndarray, "n 3"]
    target: Float64[np.ndarray, "n 3"]
    sigmas: Float64[np.ndarray, "n 3"]

    def __len__(self) -> int:
        return len(self.source)

    def only(self, chosen: Bool[np.ndarray, " n"]) -> Correspondences:
        """Some of them."""
        return Correspondences(self.source[chosen], self.target[chosen], self.sigmas[chosen])


@dataclass(frozen=True)
class DirectionPrior:
    """Directions known in both frames, which hold a rotation that points leave free.

    Attributes:
        source: (k, 3) unit vectors.
        target: (k, 3) unit vectors.
        sigma_rad: Standard deviation of each.
    """

    source: Float64[np.ndarray, "k 3"]
    target: Float64[np.ndarray, "k 3"]
    sigma_rad: float


@dataclass(frozen=True)
class SimilarityFit:
    """A robust similarity and how well it is determined.

    Attributes:
        similarity: Source to target.
        inliers: Which points agree with the fit. These took part in it, unless they are fewer than 3: then all did, and
            there is no fit to speak of.
        residuals: Transformed source less target, in the target's units.
        noise: Robust spread of the residuals over the stated sigmas: 1 where these are right.
        sigma_scale: Standard deviation of the scale, relative; infinite where it is not determined.
        sigma_rotation_rad: Standard deviation of the rotation about its weakest axis; infinite likewise.
        used_prior: Whether the points left a rotation to the prior.
    """

    similarity: Similarity
    inliers: Bool[np.ndarray, " n"]
    residuals: Float64[np.ndarray, "n 3"]
    noise: float
    sigma_scale: float
    sigma_rotation_rad: float
    used_prior: bool


def robust_similarity(points: Correspondences, max_error: float, prior: DirectionPrior | None = None) -> SimilarityFit:
    """Fit a similarity to points of which some may be wrong.

    Triples give hypotheses (every triple of a small set, else 1000 from a fixed seed), scored by squared residuals cut
    off at ``max_error`` and refined locally (MSAC: Torr and Zisserman 2000; LO-RANSAC: Chum, Matas and Kittler 2003).
    From the best, reweighted least squares with the points' own sigmas and Cauchy's weights. Never a reflection, and
    the same bits for the same input.

    Args:
        points: At least 3, not all in one place.
        max_error: Points further than this from the fit, in the target's units, are left out of it.
        prior: Directions that take part where the points leave a rotation free by more than 5° (points on a line).

    Raises:
        ValueError: if there are fewer than 3 points or their source positions coincide.
    """
    if len(points) < 3:
        raise ValueError("a similarity needs at least 3 points")
    if not np.ptp(points.source, axis=0).any():
        raise ValueError("all points of the source coincide")
    start = _consensus(points, max_error)
    fit = _refine(start, points, max_error, None)
    if prior is None or fit.sigma_rotation_rad <= WEAK_ROTATION_RAD:
        return fit
    chosen = points.only(fit.inliers) if fit.inliers.sum() >= 3 else points
    _, axis = _weakest_rotation(_information(_Problem(chosen, fit.similarity), _sigma_weights(chosen), None))
    start = turn_about_axis(fit.similarity, axis, chosen.target.mean(axis=0), prior)
    return _refine(start, points, max_error, prior)


def turn_about_axis(
    similarity: Similarity, axis: Float64[np.ndarray, " 3"], pivot: Float64[np.ndarray, " 3"], prior: DirectionPrior
) -> Similarity:
    """Turn the target side about an axis through a pivot so that the prior's directions agree best."""
    across = np.eye(3) - np.outer(axis, axis)
    have, want = prior.source @ similarity.rotation.T @ across, prior.target @ across
    angle = math.atan2(float((np.cross(have, want) @ axis).sum()), float((have * want).sum()))
    turn = rotation_from_vector(axis * angle)
    return Similarity(similarity.scale, turn @ similarity.rotation, turn @ (similarity.translation - pivot) + pivot)


@dataclass(frozen=True)
class _Problem:
    """Least squares about a similarity: unknowns are a rotation vector, the scale's logarithm, the translation.

    Coordinates are taken from the points' mean, which keeps the unknowns apart.
    """

    points: Correspondences
    similarity: Similarity

    @property
    def arms(self) -> Float64[np.ndarray, "n 3"]:
        """From the mean to each transformed point."""
        source = self.points.source
        return np.asarray(self.similarity.scale * ((source - source.mean(axis=0)) @ self.similarity.rotation.T))

    def jacobian(self) -> Float64[np.ndarray, "n 3 7"]:
        """Of the transformed points."""
        arms = self.arms
        jacobian = np.zeros((len(arms), 3, 7))
        jacobian[:, :, :3] = -cross_matrix(arms)
        jacobian[:, :, 3] = arms
        jacobian[:, :, 4:] = np.eye(3)
        return jacobian

    def moved(self, step: Float64[np.ndarray, " 7"]) -> Similarity:
        """The similarity after a step of the unknowns."""
        mean = self.points.source.mean(axis=0)
        centre = self.similarity.apply(mean[None])[0] + step[4:]
        rotation = rotation_from_vector(step[:3]) @ self.similarity.rotation
        scale = self.similarity.scale * math.exp(float(np.clip(step[3], -1.0, 1.0)))
        return Similarity(scale, rotation, centre - scale * (rotation @ mean))


def _consensus(points: Correspondences, max_error: float) -> Similarity:
    """The best hypothesis from triples; accurate points count more."""
    importance = np.median(points.sigmas) / points.sigmas
    weights = importance.mean(axis=1) ** 2
    triples = _triples(len(points))
    found = fit_similarity(points.source[triples], points.target[triples], weights[triples])
    hypotheses = [Similarity(float(scale), r, t) for scale, r, t in zip(*found, strict=True) if scale > 0.0]
    hypotheses.append(_closed_form(points, weights))

    def cost(hypothesis: Similarity) -> float:
        squares = ((_residuals(hypothesis, points) * importance) ** 2).sum(axis=1)
        return float(np.minimum(squares, max_error**2).sum())

    costs = [cost(hypothesis) for hypothesis in hypotheses]
    best_cost, best = math.inf, hypotheses[-1]
    for index in np.argsort(costs, kind="stable")[:REFINED_HYPOTHESES]:
        candidate = hypotheses[int(index)]
        for _ in range(LOCAL_ROUNDS):
            if cost(candidate) < best_cost:
                best_cost, best = cost(candidate), candidate
            near = np.linalg.norm(_residuals(candidate, points), axis=1) <= max_error
            if near.sum() < 3:
                break
            candidate = _closed_form(points.only(near), weights[near])
    return best


def _refine(
    start: Similarity, points: Correspondences, max_error: float, prior: DirectionPrior | None
) -> SimilarityFit:
    """Reweighted least squares on the points near the fit, until these stay the same."""
    similarity = start
    inliers = np.linalg.norm(_residuals(start, points), axis=1) <= max_error
    if inliers.sum() < 3:
        inliers = np.ones(len(points), dtype=bool)
    near, noise = inliers, 1.0
    for _ in range(LOCAL_ROUNDS):
        similarity, noise = _reweighted(similarity, points.only(inliers), prior)
        residuals = _residuals(similarity, points)
        normed = _normed(residuals, points)
        near = np.linalg.norm(residuals, axis=1) <= max_error
        near &= normed <= max(OUTLIER_SIGMAS, OUTLIER_NOISES * noise)
        if near.sum() < 3 or (near == inliers).all():
            break
        inliers = near
    chosen = points.only(inliers)
    information = _information(_Problem(chosen, similarity), _sigma_weights(chosen), prior)
    factor = max(noise, LEAST_NOISE_FACTOR) if len(chosen) >= REDUNDANT else max(noise, 1.0)
    sigma_rotation, _ = _weakest_rotation(information)
    return SimilarityFit(
        similarity=similarity,
        inliers=near,
        residuals=_residuals(similarity, points),
        noise=noise,
        sigma_scale=factor * _sigma_scale(information),
        sigma_rotation_rad=factor * sigma_rotation,
        used_prior=prior is not None,
    )


def _reweighted(
    similarity: Similarity, points: Correspondences, prior: DirectionPrior | None
) -> tuple[Similarity, float]:
    """Gauss-Newton with Cauchy's weights at the residuals' own spread; returns the noise, too."""
    noise = 1.0
    for _ in range(IRLS_ROUNDS):
        problem = _Problem(points, similarity)
        residuals = _residuals(similarity, points)
        normed = _normed(residuals, points)
        noise = max(float(np.median(normed)) / MEDIAN_OF_CHI3, LEAST_NOISE)
        weights = _sigma_weights(points) / (1.0 + (normed / (CAUCHY * noise)) ** 2)[:, None]
        gradient = np.einsum("nk,nkp->p", weights * residuals, problem.jacobian())
        if prior is not None:
            turned = prior.source @ similarity.rotation.T
            gradient[:3] += np.cross(turned, turned - prior.target).sum(axis=0) / prior.sigma_rad**2
        step = -_solve(_information(problem, weights, prior), gradient)
        similarity = problem.moved(step)
        extent = float(np.abs(problem.arms).max())
        if np.abs(step[:4]).max() < IRLS_TOLERANCE and np.abs(step[4:]).max() < IRLS_TOLERANCE * extent:
            break
    return similarity, noise


def _information(
    problem: _Problem, weights: Float64[np.ndarray, "n 3"], prior: DirectionPrior | None
) -> Float64[np.ndarray, "7 7"]:
    """The normal matrix: points by their weights, the prior by its sigma."""
    jacobian = problem.jacobian()
    information = np.einsum("nkp,nk,nkq->pq", jacobian, weights, jacobian)
    if prior is not None:
        turned = cross_matrix(prior.source @ problem.similarity.rotation.T)
        information[:3, :3] += (np.swapaxes(turned, 1, 2) @ turned).sum(axis=0) / prior.sigma_rad**2
    return np.asarray(information)


def _solve(information: Float64[np.ndarray, "7 7"], gradient: Float64[np.ndarray, " 7"]) -> Float64[np.ndarray, " 7"]:
    """The step; none along a direction that nothing determines. Unknowns are brought to one size first."""
    sizes = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(sizes, sizes)
    return np.asarray(np.linalg.pinv(scaled, rcond=FREE, hermitian=True) @ (gradient / sizes) / sizes)


def _weakest_rotation(information: Float64[np.ndarray, "7 7"]) -> tuple[float, Float64[np.ndarray, " 3"]]:
    """Standard deviation and axis of the least determined rotation, whatever scale and translation are."""
    others = np.linalg.pinv(information[3:, 3:], hermitian=True)
    left = information[:3, :3] - information[:3, 3:] @ others @ information[3:, :3]
    values, vectors = np.linalg.eigh((left + left.T) / 2.0)
    weakest = float(values[0])
    return (1.0 / math.sqrt(weakest) if weakest > FREE * values[2] else math.inf), vectors[:, 0]


def _sigma_scale(information: Float64[np.ndarray, "7 7"]) -> float:
    rest = [0, 1, 2, 4, 5, 6]
    others = np.linalg.pinv(information[np.ix_(rest, rest)], rcond=FREE, hermitian=True)
    left = float(information[3, 3] - information[3, rest] @ others @ information[rest, 3])
    return 1.0 / math.sqrt(left) if left > FREE * information[3, 3] else math.inf


def _triples(count: int) -> np.ndarray:
    if math.comb(count, 3) <= MAX_HYPOTHESES:
        return np.array(list(itertools.combinations(range(count), 3)))
    generator = np.random.Generator(np.random.PCG64(0))
    return np.stack([generator.choice(count, 3, replace=False, shuffle=False) for _ in range(MAX_HYPOTHESES)])


def _closed_form(points: Correspondences, weights: Float64[np.ndarray, " n"]) -> Similarity:
    scale, rotation, translation = fit_similarity(points.source, points.target, weights)
    return Similarity(max(float(scale), 1e-300), rotation, translation)


def _residuals(similarity: Similarity, points: Correspondences) -> Float64[np.ndarray, "n 3"]:
    return np.asarray(similarity.apply(points.source) - points.target)


def _normed(residuals: Float64[np.ndarray, "n 3"], points: Correspondences) -> Float64[np.ndarray, " n"]:
    """Residuals over their sigmas, root mean square of the three coordinates."""
    return np.asarray(np.sqrt(((residuals / points.sigmas) ** 2).mean(axis=1)))


def _sigma_weights(points: Correspondences) -> Float64[np.ndarray, "n 3"]:
    return 1.0 / points.sigmas**2
