"""The weighted similarity between a model and the world, from control and positions together; and which control is off.

Positions of one flight share an error that control can tell: each flight has an offset of its own.
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

ROUNDS = 50
TOLERANCE = 1e-12  # of a step, in radians and relative to the extent
FREE = 1e-13  # an eigenvalue below this, relative to the largest, is rounding
SIMILARITY = 7
QUIET = 2.5  # times the stated sigmas: control that agrees so well has nothing to be searched for
CRITICAL, CRITICAL_FEW = 4.0, 24.0  # of a studentised residual; a little over Student's t at 1 in 1000, by its degrees
MOST_PAIRED = 40  # points of which pairs are tried, too
LEAST_LEFT = 3
MOST_SUSPECTS = 100  # points that are tried, those with the largest residuals; one that is off is among them
MOST_FOUND = 50  # blunders: a file with more has another fault


@dataclass(frozen=True)
class JointObservations:
    """The same points in the model and, as stated, in the world.

    Attributes:
        source: In the model.
        target: In the world, metres; what has an infinite sigma may be anything finite.
        sigmas: Standard deviations of the target's coordinates; infinite where it has none.
        group: Index of the offset that the target has; -1 for none.
        is_control: Points that are searched for blunders.
    """

    source: Float64[np.ndarray, "n 3"]
    target: Float64[np.ndarray, "n 3"]
    sigmas: Float64[np.ndarray, "n 3"]
    group: Int64[np.ndarray, " n"]
    is_control: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.source)

    def only(self, chosen: Bool[np.ndarray, " n"]) -> JointObservations:
        """Some of them."""
        return JointObservations(
            self.source[chosen], self.target[chosen], self.sigmas[chosen], self.group[chosen], self.is_control[chosen]
        )

    @property
    def weights(self) -> Float64[np.ndarray, "n 3"]:
        """Of the coordinates."""
        return np.asarray(1.0 / self.sigmas**2)


@dataclass(frozen=True)
class Priors:
    """What else holds the fit.

    Attributes:
        offset_sigmas: Of each group's offset about zero, metres.
        direction: Where the points leave a rotation free.
    """

    offset_sigmas: Float64[np.ndarray, "k 3"]
    direction: DirectionPrior | None = None


@dataclass(frozen=True)
class JointFit:
    """A weighted similarity.

    Attributes:
        similarity: World from model.
        offsets: Of the groups: stated less true.
        covariance: Of rotation vector, logarithm of the scale, translation at ``mean``, offsets; for right sigmas.
        mean: In the model, the point that translations are taken at.
        residuals: Transformed, with the offset, less the stated target; metres.
        noise: Of the control's residuals over their sigmas; 1 where these are right, 0 without redundancy.
        degrees: Of freedom of that.
    """

    similarity: Similarity
    offsets: Float64[np.ndarray, "k 3"]
    covariance: Float64[np.ndarray, "p p"]
    mean: Float64[np.ndarray, " 3"]
    residuals: Float64[np.ndarray, "n 3"]
    noise: float
    degrees: int

    def sigmas_at(self, source: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m 3"]:
        """Standard deviations of points that the fit takes into the world."""
        jacobian = _jacobian(self.similarity, source, self.mean)
        variances = np.einsum("nkp,pq,nkq->nk", jacobian, self.covariance[:SIMILARITY, :SIMILARITY], jacobian)
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def fit_jointly(start: Similarity, observed: JointObservations, priors: Priors) -> JointFit:
    """Weighted least squares of a similarity and the groups' offsets (Gauss-Newton).

    Args:
        start: World from model, near.
        observed: Control and positions.
        priors: Of the offsets, and perhaps of directions.
    """
    weights = observed.weights
    share = weights.mean(axis=1)
    mean = np.asarray((share[:, None] * observed.source).sum(axis=0) / share.sum())
    similarity, offsets = start, np.zeros_like(priors.offset_sigmas)
    groups = len(offsets)
    member = (observed.group[:, None] == np.arange(groups)).astype(np.float64)
    for _ in range(ROUNDS):
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
        if np.abs(step[:4]).max() < TOLERANCE and np.abs(step[4:]).max() < TOLERANCE * extent:
            break
    residuals = np.asarray(similarity.apply(observed.source) + member @ offsets - observed.target)
    noise, degrees = _noise(residuals, observed)
    return JointFit(similarity, offsets, inverse, mean, residuals, noise, degrees)


def find_blunders(start: Similarity, observed: JointObservations, priors: Priors, least_m: float) -> tuple[int, ...]:
    """Control points that contradict the others (data snooping: Baarda 1968, with the others' own noise).

    A point is off where the fit without it misses it by more than the others' noise and number allow. Two at a time
    are tried as well: a swapped pair hides itself from the search for one.

    Args:
        start: As in ``fit_jointly``.
        observed: Likewise.
        priors: Likewise.
        least_m: Points that are off by less are not.

    Returns:
        Indices into ``observed``, sorted.
    """
    found: list[int] = []
    candidates = np.flatnonzero(observed.is_control).tolist()
    while len(candidates) - len(found) > LEAST_LEFT and 2 * len(found) < min(len(candidates), 2 * MOST_FOUND):
        kept = _without(len(observed), found)
        if fit_jointly(start, observed.only(kept), priors).noise <= QUIET:
            break
        more = _worst(start, observed, priors, found, least_m)
        if not more:
            break
        found += more
    return tuple(sorted(found))


def misfit(
    fit: JointFit, observed: JointObservations, index: int
) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """Residual of a point that took no part in a fit, and its standard deviations by the fit's own noise.

    A coordinate that is not known has residual 0.
    """
    known = np.isfinite(observed.sigmas[index])
    residual = fit.similarity.apply(observed.source[index][None])[0] - observed.target[index]
    sigmas = np.hypot(np.where(known, observed.sigmas[index], 0.0), fit.sigmas_at(observed.source[index][None])[0])
    return np.where(known, residual, 0.0), sigmas * max(fit.noise, 1.0)


def studentised(residual: Float64[np.ndarray, " 3"], sigmas: Float64[np.ndarray, " 3"], known: int) -> float:
    """Root mean square of a residual's known coordinates over their standard deviations."""
    return float(np.sqrt(((residual / sigmas) ** 2).sum() / max(known, 1)))


def critical(degrees: int) -> float:
    """What a studentised residual has to exceed, by the degrees of freedom of its standard deviation."""
    return CRITICAL + CRITICAL_FEW / max(degrees, 1)


def _worst(
    start: Similarity, observed: JointObservations, priors: Priors, found: Sequence[int], least_m: float
) -> list[int]:
    """The point, or else the two, without which the others agree best, if they are off."""
    left = [int(i) for i in np.flatnonzero(observed.is_control) if i not in found]
    for size in (1, 2):
        if len(left) - size < LEAST_LEFT or (size == 2 and len(left) > MOST_PAIRED):
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
    """The points of the largest residuals, all of them where they are few."""
    if len(left) <= MOST_SUSPECTS:
        return list(left)
    others = np.flatnonzero(observed.is_control & ~np.isin(np.arange(len(observed)), left))
    kept = _without(len(observed), others.tolist())
    residuals = fit_jointly(start, observed.only(kept), priors).residuals / observed.sigmas[kept]
    size = np.zeros(len(observed))
    size[kept] = (residuals**2).sum(axis=1)
    return sorted(np.array(left)[np.argsort(-size[left], kind="stable")[:MOST_SUSPECTS]].tolist())


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
    """Of transformed points by rotation vector, logarithm of the scale, translation."""
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
    """Nothing along a direction that nothing determines; unknowns are brought to one size first."""
    sizes = np.sqrt(np.maximum(np.diag(information), 1e-300))
    return np.asarray(
        np.linalg.pinv(information / np.outer(sizes, sizes), rcond=FREE, hermitian=True) / np.outer(sizes, sizes)
    )


def _moved(similarity: Similarity, mean: Float64[np.ndarray, " 3"], step: Float64[np.ndarray, " p"]) -> Similarity:
    centre = similarity.apply(mean[None])[0] + step[4:SIMILARITY]
    rotation = rotation_from_vector(step[:3]) @ similarity.rotation
    scale = similarity.scale * math.exp(float(np.clip(step[3], -1.0, 1.0)))
    return Similarity(scale, rotation, centre - scale * (rotation @ mean))
