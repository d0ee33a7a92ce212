"""The errors of camera positions in a block: their size by flight and receiver state, their drift, and blunders.

Positions are stated with a standard deviation, which may be wrong by a factor, and their errors are partly independent
and partly drift along the flight. Factor, share of the drift and its correlation from photo to photo are estimated by
restricted maximum likelihood (Patterson and Thompson 1971), horizontally and in height, from the block without the
positions: what the tie points say of the cameras' shape is weighed exactly, and what the positions themselves bent is
not counted as agreement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.robust import cauchy_weights
from splatpipe.pipeline.survey.adjustment.block import Block, ReducedBlock
from splatpipe.pipeline.survey.adjustment.block_adjustment import PositionObservations, factorised, solve

AXES = ((0, 1), (2,))  # east and north; up
USUAL = (
    0.5,
    0.9,
)  # share of the variance that drifts, and its correlation from photo to photo: 50 photos prove neither
DRIFTS = (USUAL, (0.0, 0.0), *((share, r) for share in (0.5, 0.8) for r in (0.5, 0.7, 0.8, 0.95)), (0.8, 0.9))
MIN_LIKELIHOOD_GAIN = 4.0  # least gain in minus twice the log-likelihood for another drift than usual (Akaike 1974)
MAX_CHAIN = 200  # neighbours along a flight whose drift is modelled together
MIN_CLASS = 10  # positions with a factor of their own
PRIOR_DEGREES = 2.0  # weight of the stated standard deviation, for few positions
PRIOR_DEGREES_MANY = 0.2  # weight of the stated standard deviation, for many positions
FEW_DEGREES = 10.0  # degrees of freedom below which a direction's factor is uncertain, and the other direction's counts
FACTOR_ROUNDS = 12
MIN_RELATIVE_CHANGE = 0.01  # relative, of a factor
MIN_FACTOR = 0.05
ROBUST_ROUNDS = 30
MEDIAN_NORM = 1.538  # median norm of three standard normal coordinates
BLUNDER_NOISES = 6.0  # times the noise of its class, as its root mean square along the axes
BLUNDER_STATED = 3.0  # times the stated standard deviation: a smaller error is not a blunder
SHARED_PART = 0.7  # part of a stated standard deviation common to a flight (base, troposphere, antenna)


@dataclass(frozen=True)
class StatedPositions:
    """Positions of a block's photos, in the order in which they were taken.

    Attributes:
        photo: Index of each one's photo.
        stated: World metres.
        sigmas: Stated standard deviations, metres.
        group: Index of each one's flight.
        state: Of the receiver, for each.
        apart: (g, 3) which coordinates of a flight have an unknown offset to the reference flight's.
    """

    photo: Int64[np.ndarray, " k"]
    stated: Float64[np.ndarray, "k 3"]
    sigmas: Float64[np.ndarray, "k 3"]
    group: Int64[np.ndarray, " k"]
    state: tuple[str, ...]
    apart: Bool[np.ndarray, "g 3"]

    def __len__(self) -> int:
        return len(self.photo)

    def only(self, kept: Bool[np.ndarray, " k"]) -> StatedPositions:
        """Some of the positions."""
        states = tuple(state for state, keep in zip(self.state, kept.tolist(), strict=True) if keep)
        return replace(
            self,
            photo=self.photo[kept],
            stated=self.stated[kept],
            sigmas=self.sigmas[kept],
            group=self.group[kept],
            state=states,
        )


@dataclass(frozen=True)
class PositionNoise:
    """The noise of positions.

    Attributes:
        classes: Flight and receiver state of each class; the last may be of all that are few.
        of: Class of each position.
        factors: (c, 2) standard deviations over the stated ones, horizontally and in height.
        degrees: (c, 2) degrees of freedom behind them.
        shares: (c, 2) of the variance that drifts.
        correlations: (c, 2) of the drift from one photo of a class to its next.
    """

    classes: tuple[str, ...]
    of: Int64[np.ndarray, " k"]
    factors: Float64[np.ndarray, "c 2"]
    degrees: Float64[np.ndarray, "c 2"]
    shares: Float64[np.ndarray, "c 2"]
    correlations: Float64[np.ndarray, "c 2"]

    @property
    def main(self) -> int:
        """The class with the most positions."""
        return int(np.argmax(np.bincount(self.of, minlength=len(self.classes))))

    def sizes(self, positions: StatedPositions) -> Float64[np.ndarray, "k 3"]:
        """Standard deviation of each coordinate, metres."""
        return np.asarray(positions.sigmas * self.factors[self.of][:, [0, 0, 1]])

    def white_correlations(self) -> Float64[np.ndarray, " 2"]:
        """Correlations of first-order processes whose mean over many photos is as uncertain, horizontally and in
        height."""
        share, correlation = self.shares[self.main], self.correlations[self.main]
        times = 1.0 - share + share * (1.0 + correlation) / (1.0 - correlation)
        return np.asarray((times - 1.0) / (times + 1.0))

    def precision(self, positions: StatedPositions) -> Float64[np.ndarray, "3 k k"]:
        """Inverse covariance along each axis."""
        sizes = self.sizes(positions)
        result = []
        for half, axes in enumerate(AXES):
            inverse = _inverse_pattern(positions, self.of, self.shares[:, half], self.correlations[:, half])
            result += [inverse / np.outer(sizes[:, axis], sizes[:, axis]) for axis in axes]
        return np.stack(result)

    def offset_sigmas(self, positions: StatedPositions, unbound: float) -> Float64[np.ndarray, "g 3"]:
        """Standard deviation of each flight's common error, metres.

        The receiver's standard deviation covers the whole error, also what all positions share and no residual shows.
        """
        groups = len(positions.apart)
        typical = np.array([np.median(positions.sigmas[positions.group == g], axis=0) for g in range(groups)])
        mean = np.array([self.factors[self.of[positions.group == g]].mean(axis=0)[[0, 0, 1]] for g in range(groups)])
        hidden = typical * np.sqrt(np.maximum(1.0 - mean**2, SHARED_PART**2))
        return np.where(positions.apart, unbound, np.maximum(hidden, SHARED_PART * typical * np.maximum(mean, 1.0)))

    def observations(self, positions: StatedPositions, unbound: float = 1e4) -> PositionObservations:
        """The positions as an adjustment takes them."""
        return PositionObservations(
            positions.photo,
            positions.stated,
            self.precision(positions),
            positions.group,
            self.offset_sigmas(positions, unbound),
        )


def as_stated(positions: StatedPositions) -> PositionNoise:
    """Independent errors of the stated size, in classes by flight and state."""
    names = [
        f"flight {group + 1}, {state}" for group, state in zip(positions.group.tolist(), positions.state, strict=True)
    ]
    counts = {name: names.count(name) for name in names}
    large = sorted(name for name, count in counts.items() if count >= MIN_CLASS)
    classes = (*large, *(["others"] if len(large) < len(counts) else []))
    of = np.array([classes.index(name) if name in large else len(classes) - 1 for name in names], dtype=np.int64)
    ones = np.ones((len(classes), 2))
    return PositionNoise(classes, of, ones, ones, np.zeros_like(ones), np.zeros_like(ones))


@dataclass(frozen=True)
class CentreSystem:
    """What the photos alone say of the projection centres: information and gradient at a block's state.

    Attributes:
        normal: (3n, 3n), the seven unknowns of the datum undetermined.
        gradient: (3n,).
    """

    normal: Float64[np.ndarray, "c c"]
    gradient: Float64[np.ndarray, " c"]


def centre_system(reduced: ReducedBlock, photos: int) -> CentreSystem:
    """Eliminate rotations and lenses."""
    centres = np.arange(3 * photos, 6 * photos)
    others = np.concatenate([np.arange(3 * photos), np.arange(6 * photos, len(reduced.gradient))])
    crossed = reduced.normal[np.ix_(others, centres)]
    carried = solve(reduced.normal[np.ix_(others, others)], np.column_stack([crossed, reduced.gradient[others]]))
    normal = reduced.normal[np.ix_(centres, centres)] - crossed.T @ carried[:, :-1]
    return CentreSystem(0.5 * (normal + normal.T), reduced.gradient[centres] - crossed.T @ carried[:, -1])


@dataclass(frozen=True)
class _Fit:
    """The linear fit of centres and offsets for one noise.

    Attributes:
        errors: (k, 3) of the positions after the fit.
        spread: (3, k, k) covariance of the fitted positions along each axis.
        cost: Minus twice the restricted log-likelihood.
    """

    errors: Float64[np.ndarray, "k 3"]
    spread: Float64[np.ndarray, "3 k k"]
    cost: float


def noise_with_drift(
    system: CentreSystem, block: Block, positions: StatedPositions, drift: PositionNoise
) -> PositionNoise:
    """Estimate the factors of positions whose drift is known from others."""
    errors = block.centres[positions.photo] - positions.stated
    start = with_drift_of(as_stated(positions), drift)
    return _iterate_factors(system, errors, positions, start)


def estimate_noise(system: CentreSystem, block: Block, positions: StatedPositions) -> PositionNoise:
    """Estimate the noise from what the photos say of the centres."""
    errors = block.centres[positions.photo] - positions.stated
    noise = as_stated(positions)
    noise = replace(
        noise, shares=np.full_like(noise.shares, USUAL[0]), correlations=np.full_like(noise.shares, USUAL[1])
    )
    noise = _iterate_factors(system, errors, positions, noise)
    if len(positions) < MIN_CLASS:
        return noise
    best = _fit(system, errors, positions, noise).cost
    for half in (1, 0):  # heights tell more
        usual = noise
        for drift in DRIFTS[1:]:
            tried = _iterate_factors(system, errors, positions, _with_drift(usual, half, *drift), rounds=3)
            cost = _fit(system, errors, positions, tried).cost
            if cost < best - (MIN_LIKELIHOOD_GAIN if noise is usual else 0.0):
                best, noise = cost, tried
    return _iterate_factors(system, errors, positions, noise)


def find_blunders(
    system: CentreSystem, block: Block, positions: StatedPositions, noise: PositionNoise
) -> Bool[np.ndarray, " k"]:
    """Which positions are off by far more than the others of their class: Cauchy weights, then a test."""
    errors = block.centres[positions.photo] - positions.stated
    weights = np.ones(len(positions))
    typical = np.ones(len(noise.classes))
    none = np.zeros_like(noise.shares)
    plain = replace(noise, shares=none, correlations=none, factors=np.ones_like(noise.factors))
    normed = np.ones(len(positions))
    for _ in range(ROBUST_ROUNDS):
        scaled = replace(positions, sigmas=positions.sigmas * typical[noise.of][:, None] / np.sqrt(weights)[:, None])
        left = _fit(system, errors, scaled, plain).errors
        normed = np.sqrt(((left / positions.sigmas) ** 2).sum(axis=1))
        typical = np.array(
            [max(float(np.median(normed[noise.of == c])) / MEDIAN_NORM, MIN_FACTOR) for c in range(len(typical))]
        )
        after = cauchy_weights(normed, 3.0**0.5 * typical[noise.of])
        if np.abs(after - weights).max() < MIN_RELATIVE_CHANGE:
            break
        weights = after
    root_mean = normed / 3.0**0.5
    return np.asarray((root_mean > BLUNDER_NOISES * typical[noise.of]) & (root_mean > BLUNDER_STATED))


def predicted_errors(
    system: CentreSystem,
    block: Block,
    positions: StatedPositions,
    noise: PositionNoise,
    pieces: Sequence[Bool[np.ndarray, " k"]],
) -> Float64[np.ndarray, "k 3"]:
    """Errors of positions predicted by a fit that leaves them out, for each of several sets of them.

    Args:
        system: What the photos say of the centres.
        block: The block at that state.
        positions: All positions.
        noise: Of them.
        pieces: The sets; each position is in at most one.

    Returns:
        Predicted less stated, metres; NaN for positions in no set.
    """
    result = np.full((len(positions), 3), np.nan)
    for piece in pieces:
        kept = positions.only(~piece)
        used = replace(noise, of=noise.of[~piece])
        moved, offsets = _moved(system, block.centres[kept.photo] - kept.stated, kept, used)
        where = 3 * positions.photo[piece][:, None] + np.arange(3)
        fitted = block.centres[positions.photo[piece]] + moved[where]
        result[piece] = fitted + offsets[positions.group[piece]] - positions.stated[piece]
    return result


def strip_pieces(positions: StatedPositions, length: int = 4, sets: int = 3) -> list[Bool[np.ndarray, " k"]]:
    """Cut the flights into pieces of neighbouring photos, and deal them out to sets."""
    place = np.zeros(len(positions), dtype=np.int64)
    count = 0
    for group in np.unique(positions.group).tolist():
        members = np.flatnonzero(positions.group == group)
        place[members] = count + np.arange(len(members)) // length
        count = int(place[members].max()) + 1
    return [np.asarray(place % sets == k) for k in range(sets)]


def _inverse_pattern(
    positions: StatedPositions,
    of: Int64[np.ndarray, " k"],
    shares: Float64[np.ndarray, " c"],
    correlations: Float64[np.ndarray, " c"],
) -> Float64[np.ndarray, "k k"]:
    """Inverse of the errors' correlations: along a flight for positions of one class, none otherwise."""
    inverse = np.eye(len(positions))
    for group in np.unique(positions.group).tolist():
        for kind in np.unique(of).tolist():
            members = np.flatnonzero((positions.group == group) & (of == kind))
            if shares[kind] == 0.0 or len(members) == 0:
                continue
            for piece in np.array_split(members, -(-len(members) // MAX_CHAIN)):
                inverse[np.ix_(piece, piece)] = _inverse_chain(
                    len(piece), float(shares[kind]), float(correlations[kind])
                )
    return inverse


@lru_cache(maxsize=256)
def _inverse_chain(length: int, share: float, correlation: float) -> Float64[np.ndarray, "k k"]:
    """Inverse correlations of neighbours whose errors drift by a share."""
    order = np.arange(length)
    drift = correlation ** np.abs(order[:, None] - order[None, :])
    return np.asarray(np.linalg.inv((1.0 - share) * np.eye(length) + share * drift))


def with_drift_of(noise: PositionNoise, other: PositionNoise) -> PositionNoise:
    """A noise whose classes drift as those of the same name do in another one, or as usual."""
    shares, correlations = np.full_like(noise.shares, USUAL[0]), np.full_like(noise.shares, USUAL[1])
    for place, name in enumerate(noise.classes):
        if name in other.classes:
            there = other.classes.index(name)
            shares[place], correlations[place] = other.shares[there], other.correlations[there]
    return replace(noise, shares=shares, correlations=correlations)


def _with_drift(noise: PositionNoise, half: int, share: float, correlation: float) -> PositionNoise:
    shares, correlations = noise.shares.copy(), noise.correlations.copy()
    shares[noise.main, half], correlations[noise.main, half] = share, correlation
    return replace(noise, shares=shares, correlations=correlations)


def _system_with(
    system: CentreSystem, errors: Float64[np.ndarray, "k 3"], positions: StatedPositions, noise: PositionNoise
) -> tuple[Float64[np.ndarray, "r r"], Float64[np.ndarray, " r"], PositionObservations]:
    """Normal matrix and gradient of centres and offsets."""
    observed = noise.observations(positions)
    size, groups = len(system.gradient), len(observed.offset_sigmas)
    normal = np.zeros((size + 3 * groups, size + 3 * groups))
    normal[:size, :size] = system.normal
    gradient = np.concatenate([system.gradient, np.zeros(3 * groups)])
    member = (positions.group[:, None] == np.arange(groups)).astype(np.float64)
    for axis in range(3):
        precision = observed.precision[axis]
        centres, shared = 3 * positions.photo + axis, size + 3 * np.arange(groups) + axis
        crossed = precision @ member
        normal[np.ix_(centres, centres)] += precision
        normal[np.ix_(centres, shared)] += crossed
        normal[np.ix_(shared, centres)] += crossed.T
        normal[np.ix_(shared, shared)] += member.T @ crossed
        weighted = precision @ errors[:, axis]
        gradient[centres] += weighted
        gradient[shared] += member.T @ weighted
    index = np.arange(size, size + 3 * groups)
    normal[index, index] += (1.0 / observed.offset_sigmas**2).ravel()
    return normal, gradient, observed


def _moved(
    system: CentreSystem, errors: Float64[np.ndarray, "k 3"], positions: StatedPositions, noise: PositionNoise
) -> tuple[Float64[np.ndarray, " c"], Float64[np.ndarray, "g 3"]]:
    normal, gradient, _ = _system_with(system, errors, positions, noise)
    step = -solve(normal, gradient)
    size = len(system.gradient)
    return step[:size], step[size:].reshape(-1, 3)


def _fit(
    system: CentreSystem, errors: Float64[np.ndarray, "k 3"], positions: StatedPositions, noise: PositionNoise
) -> _Fit:
    normal, gradient, observed = _system_with(system, errors, positions, noise)
    size = len(system.gradient)
    sizes = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    factor = factorised(normal / np.outer(sizes, sizes) + 1e-13 * np.eye(len(normal)))
    lower, _ = scipy.linalg.lapack.dpotri(factor, lower=1)
    covariance = (np.tril(lower) + np.tril(lower, -1).T) / np.outer(sizes, sizes)
    step = -covariance @ gradient
    after, spread = np.zeros_like(errors), np.zeros((3, len(errors), len(errors)))
    quadratic = float(step @ gradient)
    likelihood = 2.0 * float(np.log(np.diag(factor)).sum() + np.log(sizes).sum())
    for axis in range(3):
        centres, shared = 3 * positions.photo + axis, size + 3 * positions.group + axis
        after[:, axis] = errors[:, axis] + step[centres] + step[shared]
        crossed = covariance[np.ix_(centres, shared)]
        spread[axis] = covariance[np.ix_(centres, centres)] + covariance[np.ix_(shared, shared)] + crossed + crossed.T
        precision = observed.precision[axis]
        quadratic += float(errors[:, axis] @ precision @ errors[:, axis])
        likelihood -= float(np.linalg.slogdet(precision)[1])
    likelihood += 2.0 * float(np.log(observed.offset_sigmas).sum())
    return _Fit(after, spread, likelihood + quadratic)


def _iterate_factors(
    system: CentreSystem,
    errors: Float64[np.ndarray, "k 3"],
    positions: StatedPositions,
    noise: PositionNoise,
    rounds: int = FACTOR_ROUNDS,
) -> PositionNoise:
    """Iterate the factors of a given drift (Förstner's estimation of variance components)."""
    for _ in range(rounds):
        fit = _fit(system, errors, positions, noise)
        precision = noise.precision(positions)
        found, degrees = np.zeros_like(noise.factors), noise.degrees.copy()
        for half, axes in enumerate(AXES):
            squares, free = np.zeros(len(positions)), np.zeros(len(positions))
            for axis in axes:
                squares += fit.errors[:, axis] * (precision[axis] @ fit.errors[:, axis])
                free += 1.0 - np.einsum("kl,lk->k", precision[axis], fit.spread[axis])
            for c in range(len(noise.classes)):
                mine = noise.of == c
                degrees[c, half] = max(float(free[mine].sum()), 0.0)
                found[c, half] = float(squares[mine].sum()) * noise.factors[c, half] ** 2
        factors = _weighed(found, degrees)
        change = float(np.abs(factors / noise.factors - 1.0).max())
        noise = replace(noise, factors=factors, degrees=degrees)
        if change < MIN_RELATIVE_CHANGE:
            break
    return noise


def _weighed(found: Float64[np.ndarray, "c 2"], degrees: Float64[np.ndarray, "c 2"]) -> Float64[np.ndarray, "c 2"]:
    """Factors from sums of squares and their degrees of freedom, with the stated standard deviation as a prior.

    Straight down, a tilt absorbs a horizontal error: where one direction has hardly any degrees of freedom, the prior
    is the other one's factor if that is larger, as a receiver that is worse than stated is so in both.
    """
    weight = np.where(degrees >= FEW_DEGREES, PRIOR_DEGREES_MANY, PRIOR_DEGREES)
    alone = (found + weight) / (degrees + weight)
    other = np.where(degrees[:, ::-1] >= FEW_DEGREES, np.maximum(alone[:, ::-1], 1.0), 1.0)
    mean = np.where(degrees >= FEW_DEGREES, 1.0, other)
    return np.asarray(np.maximum(np.sqrt((found + weight * mean) / (degrees + weight)), MIN_FACTOR))
