"""Compare the detail and brightness of photos with those of neighbours that show the same thing.

Each matching pair is compared at its matches, so that the scene content cancels out. A photo's own deviation is the
median of these differences; neighbours that turn out to be outliers are excluded in later passes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float32, Float64

from splatpipe.pipeline.photos.intake.detail import DIRECTIONS
from splatpipe.pipeline.sfm.matching.quick_match import InlierMatches, QuickFeatures
from splatpipe.pipeline.sfm.pairing.pairs import Pair

MIN_PLACES = 8  # minimum number of matches for comparing a pair
ALIKE_SIZES = 1.5  # ratio of relative keypoint sizes: beyond it, one photo has more detail because it is closer
PASSES = 3
ODD_DETAIL = 0.6  # logarithm of an energy ratio: such dull photos are not a reference for others
ODD_LEVEL_EV = 0.7
CLIPPED = -0.06  # binary logarithm of linear light above which values are saturated: 250 of 255
ALONE_DETAIL, ALONE_EV = 2.0, 2.0  # for photos that match none, against all others, whose content differs as well


def detail_loss(
    all_features: Sequence[QuickFeatures], found: Mapping[Pair, InlierMatches]
) -> Float64[np.ndarray, "n directions"]:
    """Estimate how much less fine detail each photo has than its neighbours where both show the same, by direction.

    Returns:
        Natural logarithms of a ratio of energies, above 0 for a duller photo; NaN for photos that could not be
        compared.
    """
    differences = {}
    for pair, agreed in found.items():
        value = _detail_difference(all_features[pair[0]], all_features[pair[1]], agreed)
        if value is not None:
            differences[pair] = value
    own = _own_share(differences, len(all_features), DIRECTIONS, ODD_DETAIL)
    return _or_alone(own, [-_medians(found.detail, DIRECTIONS) for found in all_features], ALONE_DETAIL)


def brighter_ev(
    all_features: Sequence[QuickFeatures], found: Mapping[Pair, InlierMatches]
) -> Float64[np.ndarray, " n"]:
    """Estimate by how many EV each photo is brighter than its neighbours where both show the same; NaN if unknown."""
    differences = {}
    for (i, j), agreed in found.items():
        here, there = all_features[i].levels[agreed.first], all_features[j].levels[agreed.second]
        known = np.isfinite(here) & np.isfinite(there)
        drawn = known & (here < CLIPPED) & (there < CLIPPED)
        rows = drawn if np.count_nonzero(drawn) >= MIN_PLACES else known
        if np.count_nonzero(rows) >= MIN_PLACES:
            value = float(np.median(here[rows] - there[rows]))
            differences[i, j] = np.array([value]), np.array([-value])
    own = _own_share(differences, len(all_features), 1, ODD_LEVEL_EV)
    return _or_alone(own, [_medians(found.levels[:, None], 1) for found in all_features], ALONE_EV)[:, 0]


def _detail_difference(
    first: QuickFeatures, second: QuickFeatures, agreed: InlierMatches
) -> tuple[Float64[np.ndarray, " directions"], Float64[np.ndarray, " directions"]] | None:
    """Return how much duller the first photo is, by its own directions, and the second, by its own; None if unknown."""
    ratio = (first.sizes[agreed.first] / first.width) / (second.sizes[agreed.second] / second.width)
    alike = (ratio > 1.0 / ALIKE_SIZES) & (ratio < ALIKE_SIZES)
    here, there = first.detail[agreed.first], second.detail[agreed.second]
    rows = np.flatnonzero(alike & np.isfinite(here).all(axis=1) & np.isfinite(there).all(axis=1))
    if len(rows) < MIN_PLACES:
        return None
    turn = second.angles_deg[agreed.second[rows]] - first.angles_deg[agreed.first[rows]]
    shift = np.rint(turn / (180.0 / DIRECTIONS)).astype(np.int64)[:, None]
    own = np.arange(DIRECTIONS)
    in_first = np.take_along_axis(there[rows], (own + shift) % DIRECTIONS, axis=1) - here[rows]
    in_second = np.take_along_axis(here[rows], (own - shift) % DIRECTIONS, axis=1) - there[rows]
    return np.median(in_first, axis=0).astype(np.float64), np.median(in_second, axis=0).astype(np.float64)


def _medians(values: Float32[np.ndarray, "n k"], size: int) -> Float64[np.ndarray, " k"]:
    known = values[np.isfinite(values).all(axis=1)]
    return np.median(known, axis=0).astype(np.float64) if len(known) else np.full(size, np.nan)


def _or_alone(
    own: Float64[np.ndarray, "n k"], plain: Sequence[Float64[np.ndarray, " k"]], least: float
) -> Float64[np.ndarray, "n k"]:
    """Compare photos that match no other with all others; fill in their values where they differ by over ``least``."""
    alone = ~np.isfinite(own).any(axis=1)
    stacked = np.stack(plain) if len(plain) else own
    others = stacked[~alone & np.isfinite(stacked).all(axis=1)]
    if not alone.any() or not len(others):
        return own
    steps = stacked - np.median(others, axis=0)
    far = alone & (np.abs(np.nan_to_num(steps)) > least).any(axis=1)
    return np.where(far[:, None], steps, own)


def _own_share(
    differences: Mapping[Pair, tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]],
    count: int,
    size: int,
    odd: float,
) -> Float64[np.ndarray, "count size"]:
    """Return each photo's median difference from its neighbours, excluding outlier neighbours unless all are."""
    neighbours: list[list[tuple[int, Float64[np.ndarray, " k"]]]] = [[] for _ in range(count)]
    for (i, j), (of_first, of_second) in sorted(differences.items()):
        neighbours[i].append((j, of_first))
        neighbours[j].append((i, of_second))
    own = np.full((count, size), np.nan)
    is_odd = np.zeros(count, dtype=bool)
    for _ in range(PASSES):
        for photo, pairs in enumerate(neighbours):
            if pairs:
                trusted = [value for other, value in pairs if not is_odd[other]] or [value for _, value in pairs]
                own[photo] = np.median(trusted, axis=0)
        is_odd = (np.abs(np.nan_to_num(own)) > odd).any(axis=1)
    return own
