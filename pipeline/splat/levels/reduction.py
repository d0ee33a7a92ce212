"""Reduce the number of Gaussians by merging neighbours, the most similar first."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from scipy.spatial import cKDTree
from torch import Tensor

from splatpipe.pipeline.splat.levels.matching import match_cheapest
from splatpipe.pipeline.splat.levels.merge_costs import merge_costs
from splatpipe.pipeline.splat.model.gaussians import PARAMETERS, Gaussians
from splatpipe.pipeline.splat.model.moments import merge_pairs, moments_of, shares
from splatpipe.pipeline.splat.model.morton import morton_keys

NEIGHBOURS = 16
"""Merge candidates per Gaussian: with 8, levels of detail at their display distance are 0.5 dB worse."""
ROUND_SHARE = 0.3
"""Largest share of the Gaussians removed per round: the smaller, the closer to always merging the cheapest pair."""
LARGE_POWER = 0.1
"""Power of the area relative to the median's by which merging a large Gaussian costs more: a scene's few enormous ones
fill whole images, while the many that are only large because they are far away should merge nearly like others."""
PIECE = 200_000
"""Gaussians processed together: bounds the memory."""
_ROWS_AT_ONCE = 1 << 15
_JITTER_SHARE = 1e-9  # jitter over the extent: parts coincident points in the k-d tree, which would be slow with many
_JITTER_SEED = 1
_FLAT = 1e-3  # standard deviation of what is flat, as a share of the median of the largest ones
_MIN_LOG_SCALE = -30.0


@dataclass(frozen=True, eq=False)
class Reduction:
    """Reduced Gaussians, and how far the originals lie from them.

    Attributes:
        gaussians: The remaining Gaussians, each in the position of the first of those merged into it.
        spreads: Mass-weighted RMS distance of the originals' centres from each one's centre, world units; 0 for an
            unmerged Gaussian.
        counts: How many originals each represents.
    """

    gaussians: Gaussians
    spreads: Float64[np.ndarray, " n"]
    counts: Int64[np.ndarray, " n"]

    @classmethod
    def unmerged(cls, gaussians: Gaussians) -> Reduction:
        """All Gaussians, unmerged."""
        return cls(gaussians, np.zeros(len(gaussians)), np.ones(len(gaussians), dtype=np.int64))

    @classmethod
    def joined(cls, parts: Sequence[Reduction]) -> Reduction:
        """Concatenate at least one reduction, all of the same SH degree."""
        return cls(
            Gaussians.concat([part.gaussians for part in parts]),
            np.concatenate([part.spreads for part in parts]),
            np.concatenate([part.counts for part in parts]),
        )


def reduce_to(gaussians: Gaussians, count: int) -> Gaussians:
    """Merge neighbours down to a count; each merge keeps mass, mean and covariance (``moments.merge_pairs``).

    Args:
        gaussians: On the CPU. Those with a NaN, or at infinity, cannot be drawn and are removed first.
        count: Number of Gaussians to keep, at least 1.

    Returns:
        ``count`` Gaussians, or fewer if fewer can be drawn; the argument itself if it has no more than ``count``.

    Raises:
        ValueError: if the count is less than 1.
    """
    if 1 <= count < len(gaussians):
        gaussians = gaussians.clone()
    return reduce_further(Reduction.unmerged(gaussians), count).gaussians


def reduce_further(start: Reduction, count: int, large_power: float = LARGE_POWER) -> Reduction:
    """Like ``reduce_to`` for already reduced Gaussians, without a copy.

    Args:
        start: Overwritten with merged Gaussians if it has more than ``count``.
        count: Number of Gaussians to keep, at least 1.
        large_power: See ``LARGE_POWER``.

    Raises:
        ValueError: if the count is less than 1.
    """
    if count < 1:
        raise ValueError(f"{count} Gaussians are no splat")
    if len(start.gaussians) <= count:
        return start
    work = Reduction(start.gaussians.detach(), start.spreads, start.counts)
    alive = np.flatnonzero(_drawn(work.gaussians))
    least_variance = _least_variance(work.gaussians, alive)
    turn = 0
    while len(alive) > count:
        quota = min(len(alive) - count, max(1, math.ceil(ROUND_SHARE * len(alive))))
        pairs = _cheapest_pairs(work, alive, quota, turn, least_variance, large_power)
        _merge_into_first(work, pairs)
        gone = np.zeros(len(work.counts), dtype=bool)
        gone[pairs[:, 1]] = True
        alive = alive[~gone[alive]]
        turn += 1
    return Reduction(work.gaussians.select(torch.from_numpy(alive)), work.spreads[alive], work.counts[alive])


def _least_variance(gaussians: Gaussians, alive: Int64[np.ndarray, " n"]) -> float:
    """The variance below which an axis counts as flat, from the median size of all, world units squared."""
    if not len(alive):
        return 1.0
    largest = gaussians.log_scales[torch.from_numpy(alive)].amax(1).to(torch.float64)
    return math.exp(2.0 * max(float(largest.median()), _MIN_LOG_SCALE)) * _FLAT**2


def _drawn(gaussians: Gaussians) -> Bool[np.ndarray, " n"]:
    """Which Gaussians can be drawn; infinite parameters for opacities of 0 and 1 and scales of 0 are valid."""
    fine = torch.ones(len(gaussians), dtype=torch.bool)
    for name in PARAMETERS:
        for first in range(0, len(gaussians), _ROWS_AT_ONCE):
            rows = slice(first, first + _ROWS_AT_ONCE)
            values: Tensor = getattr(gaussians, name)[rows].reshape(len(fine[rows]), -1)
            if name == "opacity_logits":
                fine[rows] &= ~values.isnan().any(1)
            elif name == "log_scales":
                fine[rows] &= (values < math.inf).all(1)
            else:
                fine[rows] &= values.isfinite().all(1)
    return np.asarray(fine.numpy())


def _cheapest_pairs(
    work: Reduction,
    alive: Int64[np.ndarray, " n"],
    quota: int,
    turn: int,
    least_variance: float,
    large_power: float,
) -> Int64[np.ndarray, "m 2"]:
    """The cheapest disjoint pairs over all pieces; at least one."""
    found, costs = [], []
    for piece in _pieces(work.gaussians, alive, turn):
        part = work.gaussians.select(torch.from_numpy(piece))
        pairs, paid = _piece_pairs(part, work.counts[piece], least_variance, large_power)
        found.append(piece[pairs])
        costs.append(paid)
    order = np.argsort(np.concatenate(costs), kind="stable")[:quota]
    return np.asarray(np.concatenate(found)[order])


def _pieces(work: Gaussians, alive: Int64[np.ndarray, " n"], turn: int) -> Iterator[Int64[np.ndarray, " m"]]:
    """Parts of space with at most ``PIECE`` Gaussians, with different borders every other turn."""
    if len(alive) <= PIECE:
        yield alive
        return
    count = math.ceil(len(alive) / PIECE) + turn % 2
    yield from np.array_split(_along_a_curve(work.means, alive), count)


def _along_a_curve(means: Float[Tensor, "n 3"], alive: Int64[np.ndarray, " m"]) -> Int64[np.ndarray, " m"]:
    """Indices sorted along a Morton curve through nearly all Gaussians."""
    some = means[torch.from_numpy(alive[:: max(1, len(alive) // PIECE)])].to(torch.float64)
    low, high = (torch.from_numpy(corner) for corner in np.percentile(some.numpy(), [1.0, 99.0], axis=0))
    keys = np.empty(len(alive), np.int64)
    for first in range(0, len(alive), PIECE):
        rows = slice(first, first + PIECE)
        places = means[torch.from_numpy(alive[rows])].to(torch.float64)
        keys[rows] = morton_keys(places, low, high - low).numpy()
    return alive[np.argsort(keys, kind="stable")]


def _piece_pairs(
    piece: Gaussians, counts: Int64[np.ndarray, " n"], least_variance: float, large_power: float
) -> tuple[Int64[np.ndarray, "m 2"], Float64[np.ndarray, " m"]]:
    """A matching of neighbours, and each pair's cost times the number of originals that it represents."""
    moments = moments_of(piece)
    edges = _neighbours(moments.means)
    colours = piece.sh.to(torch.float32).reshape(len(piece), -1).numpy()
    costs = merge_costs(moments, colours, edges, least_variance) * counts[edges].sum(1)
    largest = moments.areas[edges].max(1) * (_FLAT**2 / least_variance)
    costs *= np.maximum(largest, 1.0) ** large_power
    chosen = match_cheapest(edges, costs, len(piece))
    return edges[chosen], costs[chosen]


def _neighbours(means: Float64[np.ndarray, "n 3"]) -> Int64[np.ndarray, "e 2"]:
    """Sorted pairs of neighbours, lower index first; includes a chain through all, so a matching always exists."""
    count = len(means)
    extent = float(np.ptp(means, axis=0).max()) or 1.0
    noise = np.random.default_rng(_JITTER_SEED).uniform(-1.0, 1.0, means.shape)
    apart = means + _JITTER_SHARE * extent * noise
    _, nearest = cKDTree(apart).query(apart, k=min(NEIGHBOURS + 1, count))
    nearest = nearest.reshape(count, -1)
    own = np.repeat(np.arange(count), nearest.shape[1])
    keys = morton_keys(torch.from_numpy(apart), *(torch.from_numpy(x) for x in (apart.min(0), np.ptp(apart, axis=0))))
    chain = np.argsort(keys.numpy(), kind="stable")
    first, second = np.concatenate([own, chain[:-1]]), np.concatenate([nearest.ravel(), chain[1:]])
    low, high = np.minimum(first, second), np.maximum(first, second)
    codes = np.unique((low * count + high)[low != high])
    return np.stack(np.divmod(codes, count), axis=1)


def _merge_into_first(work: Reduction, pairs: Int64[np.ndarray, "m 2"]) -> None:
    """Replace each pair's first Gaussian with the merged one."""
    gaussians, spreads = work.gaussians, work.spreads
    for start in range(0, len(pairs), _ROWS_AT_ONCE):
        i, j = pairs[start : start + _ROWS_AT_ONCE].T
        first, second = torch.from_numpy(i), torch.from_numpy(j)
        one, other = gaussians.select(first), gaussians.select(second)
        ours, theirs = moments_of(one), moments_of(other)
        share = shares(ours, theirs)
        apart = ((ours.means - theirs.means) ** 2).sum(1)
        within = share * spreads[i] ** 2 + (1.0 - share) * spreads[j] ** 2
        spreads[i] = np.sqrt(within + share * (1.0 - share) * apart)
        work.counts[i] += work.counts[j]
        for name, tensor in merge_pairs(one, other).tensors().items():
            gaussians.tensors()[name][first] = tensor
