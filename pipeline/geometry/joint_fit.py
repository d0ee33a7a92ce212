"""Weighted similarity from model to world, from control and photo positions together; finds blunders in control.

Positions of one flight share an error that control reveals, so each flight has its own offset.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.alignment import DirectionPrior
from splatpipe.pipeline.geometry.similarity import Similarity, cross_matrix, rotation_from_vector

MAX_ROUNDS = 50
STEP_TOLERANCE = 1e-12  # size of a step at which iterations end: radians, and relative to the extent
RANK_TOLERANCE = 1e-13  # an eigenvalue below this, relative to the largest, is rounding
SIMILARITY = 7
MAX_QUIET_SIGMAS = 2.5  # residual over the stated sigmas up to which control is not searched for blunders
CRITICAL_RESIDUAL, CRITICAL_RESIDUAL_FEW = 4.0, 24.0  # studentised, of a blunder: just over Student's t at 1 in 1000
MAX_PAIRED = 40  # points up to which pairs are tried, too
MIN_LEFT = 3
MAX_SUSPECTS = 100  # points tried, those with the largest residuals; a blunder is among them
MAX_FOUND = 50  # blunders: a file with more has some other fault


@dataclass(frozen=True)
class JointObservations:
    """The same points in the model and, as stated, in the world.

    Attributes:
        source: Model coordinates.
        target: World coordinates, metres; any finite value where the sigma is infinite.
        sigmas: Standard deviations of the target's coordinates; infinite where a coordinate is unknown.
        group: Index of the offset that the target has; -1 for none.
        is_control: Which points are control and searched for blunders.
    """

    source: Float64[np.ndarray, "n 3"]
    target: Float64[np.ndarray, "n 3"]
    sigmas: Float64[np.ndarray, "n 3"]
    group: Int64[np.ndarray, " n"]
    is_control: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.source)

    def only(self, chosen: Bool[np.ndarray, " n"]) -> JointObservations:
        """The chosen points."""
        return JointObservations(
            self.source[chosen], self.target[chosen], self.sigmas[chosen], self.group[chosen], self.is_control[chosen]
        )

    @property
    def weights(self) -> Float64[np.ndarray, "n 3"]:
        """Inverse variances of the target's coordinates."""
        return np.asarray(1.0 / self.sigmas**2)


@dataclass(frozen=True)
class Priors:
    """Further constraints on the fit.

    Attributes:
        offset_sigmas: Standard deviations of each group's offset about zero, metres.
        direction: For a rotation that the points leave free.
    """

    offset_sigmas: Float64[np.ndarray, "k 3"]
    direction: DirectionPrior | None = None


@dataclass(frozen=True)
class JointFit:
    """A weighted similarity.

    Attributes:
        similarity: World from model.
        offsets: Offset of each group, stated minus true, metres.
        covariance: Of rotation vector, log scale, translation at ``mean`` and offsets, assuming the sigmas are right.
        mean: Model point at which the translation is taken.
        residuals: Transformed points plus offsets minus the stated target, metres.
        noise: Spread of the control's residuals over their sigmas; 1 where these are right, 0 without redundancy.
        degrees: Degrees of freedom of the noise.
    """

    similarity: Similarity
    offsets: Float64[np.ndarray, "k 3"]
    covariance: Float64[np.ndarray, "p p"]
    mean: Float64[np.ndarray, " 3"]
    residuals: Float64[np.ndarray, "n 3"]
    noise: float
    degrees: int

    def sigmas_at(self, source: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m 3"]:
        """Standard deviations of model points transformed to the world by this fit, metres."""
        jacobian = _jacobian(self.similarity, source, self.mean)
        variances = np.einsum("nkp,pq,nkq->nk", jacobian, self.covariance[:SIMILARITY, :SIMILARITY], jacobian)
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def fit_jointly(start: Similarity, observed: JointObservations, priors: Priors) -> JointFit:
    """Fit a similarity and the groups' offsets by weighted least squares (Gauss-Newton).

    Args:
        start: World from model, close to the solution.
        observed: Control and positions.
        priors: Priors of the offsets and, optionally, of directions.
    """
    weights = observed.weights
    share = weights.mean(axis=1)
    mean = np.asarray((share[:, None] * observed.source).sum(axis=0) / share.sum())
    similarity, offsets = start, np.zeros_like(priors.offset_sigmas)
    groups = len(offsets)
    member = (observed.group[:, None] == np.arange(groups)).astype(np.float64)
    for _ in range(MAX_ROUNDS):
        residuals = similarity.apply(observed.source) + member @ offsets - observed.target
        jacobian = _full_jacobian(similarity, observed, mean, member)
        information = np.einsum("nkp,nk,nkq->pq", jacobian, weights, jacobian)
        gradient = np.einsum("nk,nkp->p", weights * residuals, jacobian)
        diagonal = np.arange(SIMILARITY, SIMILARITY + 3 * groups)
        information[diagonal, diagonal] += (1.0 / priors.offset_sigmas**2).ravel()
        gradient[SIMILARITY:] += (offsets / priors.offset_sigmas**2).ravel()
        if priors.direction is not None:
            _add_direction(similarity, priors.direction, information, gradient)
        inverse = _inverse(information)
        step = -inverse @ gradient
        similarity = _moved(similarity, mean, step)
        offsets = offsets + step[SIMILARITY:].reshape(-1, 3)
        extent = max(float(np.ptp(observed.target, axis=0).max()), 1e-9)
        if np.abs(step[:4]).max() < STEP_TOLERANCE and np.abs(step[4:]).max() < STEP_TOLERANCE * extent:
            break
    residuals = np.asarray(similarity.apply(observed.source) + member @ offsets - observed.target)
    noise, degrees = _noise(residuals, observed)
    return JointFit(similarity, offsets, inverse, mean, residuals, noise, degrees)


def find_blunders(start: Similarity, observed: JointObservations, priors: Priors, least_m: float) -> tuple[int, ...]:
    """Find control points that contradict the others (data snooping: Baarda 1968, with the others' own noise).

    A point is a blunder if the fit without it misses it by more than the others' noise and number allow. Pairs are
    tried as well: two swapped points cannot be found one at a time.

    Args:
        start: As in ``fit_jointly``.
        observed: As in ``fit_jointly``.
        priors: As in ``fit_jointly``.
        least_m: Smallest residual of a blunder, metres.

    Returns:
        Indices into ``observed``, sorted.
    """
    found: list[int] = []
    candidates = np.flatnonzero(observed.is_control).tolist()
    while len(candidates) - len(found) > MIN_LEFT and 2 * len(found) < min(len(candidates), 2 * MAX_FOUND):
        kept = _without(len(observed), found)
        if fit_jointly(start, observed.only(kept), priors).noise <= MAX_QUIET_SIGMAS:
            break
        more = _worst(start, observed, priors, found, least_m)
        if not more:
            break
        found += more
    return tuple(sorted(found))


def misfit(
    fit: JointFit, observed: JointObservations, index: int
) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """Residual of a point that took no part in a fit, and its standard deviations scaled by the fit's noise, metres.

    An unknown coordinate has residual 0.
    """
    known = np.isfinite(observed.sigmas[index])
    residual = fit.similarity.apply(observed.source[index][None])[0] - observed.target[index]
    sigmas = np.hypot(np.where(known, observed.sigmas[index], 0.0), fit.sigmas_at(observed.source[index][None])[0])
    return np.where(known, residual, 0.0), sigmas * max(fit.noise, 1.0)


def studentised(residual: Float64[np.ndarray, " 3"], sigmas: Float64[np.ndarray, " 3"], known: int) -> float:
    """Root mean square of a residual's known coordinates over their standard deviations."""
    return float(np.sqrt(((residual / sigmas) ** 2).sum() / max(known, 1)))


def critical(degrees: int) -> float:
    """Critical value of a studentised residual, by the degrees of freedom of its standard deviation."""
    return CRITICAL_RESIDUAL + CRITICAL_RESIDUAL_FEW / max(degrees, 1)


def _worst(
    start: Similarity, observed: JointObservations, priors: Priors, found: Sequence[int], least_m: float
) -> list[int]:
    """The point, or else the pair, without which the others agree best; empty if these are not blunders."""
    left = [int(i) for i in np.flatnonzero(observed.is_control) if i not in found]
    for size in (1, 2):
        if len(left) - size < MIN_LEFT or (size == 2 and len(left) > MAX_PAIRED):
            break
        best: tuple[float, tuple[int, ...], JointFit] | None = None
        for subset in itertools.combinations(_suspects(start, observed, priors, left), size):
            fit = fit_jointly(start, observed.only(_without(len(observed), [*found, *subset])), priors)
            if best is None or fit.noise < best[0]:
                best = (fit.noise, subset, fit)
        if best is not None and best[2].degrees > 0 and all(_is_off(best[2], observed, i, least_m) for i in best[1]):
            return list(best[1])
    return []


def _suspects(start: Similarity, observed: JointObservations, priors: Priors, left: Sequence[int]) -> list[int]:
    """The points with the largest residuals, or all points where they are few."""
    if len(left) <= MAX_SUSPECTS:
        return list(left)
    others = np.flatnonzero(observed.is_control & ~np.isin(np.arange(len(observed)), left))
    kept = _without(len(observed), others.tolist())
    residuals = fit_jointly(start, observed.only(kept), priors).residuals / observed.sigmas[kept]
    size = np.zeros(len(observed))
    size[kept] = (residuals**2).sum(axis=1)
    return sorted(np.array(left)[np.argsort(-size[left], kind="stable")[:MAX_SUSPECTS]].tolist())


def _is_off(fit: JointFit, observed: JointObservations, index: int, least_m: float) -> bool:
    residual, sigmas = misfit(fit, observed, index)
    known = int(np.isfinite(observed.sigmas[index]).sum())
    return studentised(residual, sigmas, known) > critical(fit.degrees) and float(np.linalg.norm(residual)) > least_m


def _without(count: int, left_out: Sequence[int]) -> Bool[np.ndarray, " n"]:
    kept = np.ones(count, dtype=bool)
    kept[list(left_out)] = False
    return kept


def _noise(residuals: Float64[np.ndarray, "n 3"], observed: JointObservations) -> tuple[float, int]:
    used = np.isfinite(observed.sigmas) & observed.is_control[:, None]
    degrees = int(used.sum()) - SIMILARITY
    if degrees <= 0:
        return 0.0, 0
    normed = residuals[used] / observed.sigmas[used]
    return math.sqrt(float((normed**2).sum()) / degrees), degrees


def _jacobian(
    similarity: Similarity, source: Float64[np.ndarray, "n 3"], mean: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, "n 3 7"]:
    """Jacobian of transformed points with respect to rotation vector, log scale and translation."""
    arms = similarity.scale * ((source - mean) @ similarity.rotation.T)
    jacobian = np.zeros((len(arms), 3, SIMILARITY))
    jacobian[:, :, :3] = -cross_matrix(arms)
    jacobian[:, :, 3] = arms
    jacobian[:, :, 4:] = np.eye(3)
    return jacobian


def _full_jacobian(
    similarity: Similarity,
    observed: JointObservations,
    mean: Float64[np.ndarray, " 3"],
    member: Float64[np.ndarray, "n k"],
) -> Float64[np.ndarray, "n 3 p"]:
    offsets = (member[:, None, :, None] * np.eye(3)[None, :, None, :]).reshape(len(observed), 3, -1)
    return np.concatenate([_jacobian(similarity, observed.source, mean), offsets], axis=2)


def _add_direction(
    similarity: Similarity,
    prior: DirectionPrior,
    information: Float64[np.ndarray, "p p"],
    gradient: Float64[np.ndarray, " p"],
) -> None:
    turned = prior.source @ similarity.rotation.T
    crossed = cross_matrix(turned)
    information[:3, :3] += (np.swapaxes(crossed, 1, 2) @ crossed).sum(axis=0) / prior.sigma_rad**2
    gradient[:3] += np.cross(turned, turned - prior.target).sum(axis=0) / prior.sigma_rad**2


def _inverse(information: Float64[np.ndarray, "p p"]) -> Float64[np.ndarray, "p p"]:
    """Pseudo-inverse, zero along undetermined directions; unknowns are scaled to equal size first."""
    sizes = np.sqrt(np.maximum(np.diag(information), 1e-300))
    return np.asarray(
        np.linalg.pinv(information / np.outer(sizes, sizes), rcond=RANK_TOLERANCE, hermitian=True)
        / np.outer(sizes, sizes)
    )


def _moved(similarity: Similarity, mean: Float64[np.ndarray, " 3"], step: Float64[np.ndarray, " p"]) -> Similarity:
    centre = similarity.apply(mean[None])[0] + step[4:SIMILARITY]
    rotation = rotation_from_vector(step[:3]) @ similarity.rotation
    scale = similarity.scale * math.exp(float(np.clip(step[3], -1.0, 1.0)))
    return Similarity(scale, rotation, centre - scale * (rotation @ mean))
