"""Find photos whose positions were swapped, since neither the flight path nor the image matches agree with them.

Photos that show the same thing were taken near each other, the nearer the better they match; and a flight takes the
short path from photo to photo. Each swap of two positions is tested against both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.sfm.pairing.pairs import Pair

MAX_DISTANCE_RATIO = 4.0  # over the usual distance of photos that match: a false match must not outweigh all others
MIN_PARTNERS = 3  # that each of the two matches
MIN_NEARER = 0.02  # reduction of two photos' distances to their partners, relative; right ones give 0.003 at most
CLEARLY_NEARER = 0.08  # where no times give the path
MIN_SHORTER, CLEARLY_SHORTER = 0.3, 1.5  # reduction of the path, in usual steps between two photos
HARDLY_NEARER = 0.008  # suffices where the path is clearly shorter
MAX_SWAPS = 20  # more are not swaps but disorder
MAX_PHOTOS = 3000  # all pairs of photos are tested


@dataclass(frozen=True)
class PositionEvidence:
    """Evidence on where the photos were taken.

    Attributes:
        places_m: (n, 3) east, north, up; NaN where unknown.
        times_s: Capture time of each, NaN where unknown.
        matches: Number of matching keypoints, by pair.
    """

    places_m: Float64[np.ndarray, "n 3"]
    times_s: Float64[np.ndarray, " n"]
    matches: Mapping[Pair, int]

    def order(self) -> Int64[np.ndarray, " m"]:
        """Photos with position and time, in the order in which they were taken; equal times in the photos' order."""
        known = np.flatnonzero(np.isfinite(self.places_m).all(axis=1) & np.isfinite(self.times_s))
        return np.asarray(known[np.argsort(self.times_s[known], kind="stable")], np.int64)


def find_swapped(flight: PositionEvidence) -> list[Pair]:
    """Pairs of photos (i, j), i < j, that very likely have each other's position, the clearest first."""
    located = np.flatnonzero(np.isfinite(flight.places_m).all(axis=1))
    if not 4 <= len(located) <= MAX_PHOTOS:
        return []
    row = {int(photo): number for number, photo in enumerate(located)}
    places = flight.places_m[located].copy()
    weights = np.zeros((len(located), len(located)))
    for (i, j), count in flight.matches.items():
        if i in row and j in row and count:
            weights[row[i], row[j]] = weights[row[j], row[i]] = np.sqrt(count)
    order = np.array([row[int(photo)] for photo in flight.order()], np.int64)
    has_order = len(order) >= max(4, len(located) // 2)
    swapped: list[Pair] = []
    while len(swapped) < MAX_SWAPS:
        best = _best_swap(places, weights, order if has_order else None)
        if best is None:
            break
        places[list(best)] = places[list(best)[::-1]]
        i, j = sorted(int(located[number]) for number in best)
        if (i, j) in swapped:
            break
        swapped.append((i, j))
    return swapped


def _best_swap(
    places: Float64[np.ndarray, "n 3"], weights: Float64[np.ndarray, "n n"], order: Int64[np.ndarray, " m"] | None
) -> tuple[int, int] | None:
    nearer = _nearer(places, weights)
    partners = (weights > 0.0).sum(axis=1)
    enough = np.minimum(partners[:, None], partners[None, :]) >= MIN_PARTNERS
    if order is None:
        good = enough & (nearer > CLEARLY_NEARER)
        score = nearer
    else:
        shorter = _shorter(places, order)
        good = enough & (nearer > MIN_NEARER) & (shorter > MIN_SHORTER)
        good |= enough & (nearer > HARDLY_NEARER) & (shorter > CLEARLY_SHORTER)
        score = nearer * np.maximum(shorter, 0.0)
    if not good.any():
        return None
    at = int(np.where(good, score, -np.inf).argmax())
    return at // len(places), at % len(places)


def _nearer(places: Float64[np.ndarray, "n 3"], weights: Float64[np.ndarray, "n n"]) -> Float64[np.ndarray, "n n"]:
    """Relative reduction of two photos' distances to the photos they match, if they swap positions."""
    distances = np.linalg.norm(places[:, None, :2] - places[None, :, :2], axis=2)
    if not (weights > 0.0).any():
        return np.zeros_like(weights)
    usual = max(float(np.median(distances[weights > 0.0])), 1e-6)
    distances = np.minimum(distances / usual, MAX_DISTANCE_RATIO)
    own = (weights * distances).sum(axis=1)
    now = own[:, None] + own[None, :]
    there = weights @ distances  # [a, b]: photo a at the position of b
    return np.asarray((now - there - there.T - 2.0 * weights * distances) / np.maximum(now, 1e-9))


def _shorter(places: Float64[np.ndarray, "n 3"], order: Int64[np.ndarray, " m"]) -> Float64[np.ndarray, "n n"]:
    """Reduction of the path through all photos, in usual steps, if two swap positions."""
    way = places[order]
    steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
    usual = max(float(np.median(steps)), 1e-6)
    count = len(way)
    distances = np.linalg.norm(way[:, None] - way[None, :], axis=2)
    cost = np.zeros((count, count))  # [a, b]: of the steps around slot a, were b's place there
    cost[1:] += distances[:-1]
    cost[:-1] += distances[1:]
    own = np.diagonal(cost)
    gain = own[:, None] + own[None, :] - cost - cost.T
    beside = np.arange(count - 1)  # two neighbours: the step between them stays as long as it is
    correction = 2.0 * steps
    gain[beside, beside + 1] -= correction
    gain[beside + 1, beside] -= correction
    full = np.full((len(places), len(places)), -np.inf)
    full[np.ix_(order, order)] = gain / usual
    np.fill_diagonal(full, -np.inf)
    return full
