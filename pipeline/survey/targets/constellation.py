"""Matching of detected places to surveyed points by their constellation."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.similarity import Similarity, fit_similarity

REACH_M = 25.0  # horizontal offset of a whole capture, with a poor receiver
TOLERANCE_M = 1.5  # after translation: the positions' frame may be slightly rotated
MIN_TOLERANCE_M = 0.15  # after the similarity: the model may be slightly deformed
RESIDUALS = 4.0  # tolerance over the median residual
MIN_MATCHES = 3  # fewer places may match points by chance
MAX_HYPOTHESES = 2000
MAX_TRIPLES = 500  # triples of known pairs, as hypotheses
MAX_ROUNDS = 5
MIN_EXTENT_RATIO = 0.1  # second over longest extent; points nearly on a line do not determine a tilt
WRONG_RATIO = 3.0  # distance over the tolerance beyond which a place known by its number belongs to another point


@dataclass(frozen=True)
class ConstellationMatch:
    """A match of places to points.

    Attributes:
        pairs: Indices of place and point.
        tolerance_m: Largest distance accepted.
        points_from_places: The transformation.
    """

    pairs: Int64[np.ndarray, "k 2"]
    tolerance_m: float
    points_from_places: Similarity


def overlay(
    places: Float64[np.ndarray, "m 3"], points: Float64[np.ndarray, "n 3"], known: Mapping[int, int]
) -> ConstellationMatch | None:
    """Find which places are which points.

    Args:
        places: (m, 3) metres, in roughly the points' orientation and scale, but translated, unless three are known.
        points: (n, 3) metres; an unknown height is NaN.
        known: Indices of the points of some places, by index of the place; used as given.

    Returns:
        The match; None if no match is better than all others.
    """
    if len(known) >= MIN_MATCHES:
        pairs = np.array(sorted(known.items()), dtype=np.int64).reshape(-1, 2)
        start = _agreed(places, points, pairs)
    else:
        moved = _moved(places, points, known)
        if moved is None:
            return None
        start = Similarity(1.0, np.eye(3), moved)
    tolerance = TOLERANCE_M
    current, pairs = start, np.zeros((0, 2), dtype=np.int64)
    for _ in range(MAX_ROUNDS):
        pairs, residuals = _assigned(current.apply(places), points, tolerance)
        if len(pairs) < MIN_MATCHES:
            return None
        current = _fitted(places, points, pairs)
        residuals = _distances(current.apply(places)[pairs[:, 0]], points[pairs[:, 1]])
        tolerance = min(TOLERANCE_M, max(MIN_TOLERANCE_M, RESIDUALS * float(np.median(residuals))))
    pairs, _ = _assigned(current.apply(places), points, tolerance)
    return ConstellationMatch(pairs, tolerance, current) if len(pairs) >= MIN_MATCHES else None


def _agreed(
    places: Float64[np.ndarray, "m 3"], points: Float64[np.ndarray, "n 3"], known: Int64[np.ndarray, "k 2"]
) -> Similarity:
    """Fit the similarity that most of the known pairs agree on, as targets may have been laid out with swapped
    numbers."""
    whole = _fitted(places, points, known)
    target = points[known[:, 1]]
    if (_distances(whole.apply(places)[known[:, 0]], target) <= TOLERANCE_M).all():
        return whole
    triples = list(itertools.combinations(range(len(known)), MIN_MATCHES))
    best = np.ones(len(known), dtype=bool)
    most = 0
    for triple in triples[:: max(1, len(triples) // MAX_TRIPLES)]:
        moved = _fitted(places, points, known[list(triple)]).apply(places)
        good = _distances(moved[known[:, 0]], target) <= TOLERANCE_M
        if good.sum() > most:
            best, most = good, int(good.sum())
    return _fitted(places, points, known[best] if most >= MIN_MATCHES else known)


def _moved(
    places: Float64[np.ndarray, "m 3"], points: Float64[np.ndarray, "n 3"], known: Mapping[int, int]
) -> Float64[np.ndarray, " 3"] | None:
    """Return the translation that matches most places to points; None if a different one matches as many."""
    differences = points[None] - places[:, None]
    near = np.hypot(differences[..., 0], differences[..., 1]) < REACH_M
    if known:
        chosen = np.zeros_like(near)
        chosen[list(known.keys()), list(known.values())] = True
        near &= chosen
    rows, columns = np.nonzero(near)
    stride = max(1, len(rows) // MAX_HYPOTHESES)
    scored = []
    for place, point in zip(rows[::stride].tolist(), columns[::stride].tolist(), strict=True):
        shift = np.where(np.isnan(differences[place, point]), 0.0, differences[place, point])
        pairs, residuals = _assigned(places + shift, points, TOLERANCE_M)
        scored.append((len(pairs), -float(residuals.sum()), shift))
    if not scored:
        return None
    scored.sort(key=lambda each: each[:2], reverse=True)
    most, _, best = scored[0]
    rivals = [each for each in scored if each[0] == most and np.hypot(*(each[2] - best)[:2]) > 2.0 * TOLERANCE_M]
    return None if most < MIN_MATCHES or rivals else best


def _assigned(
    places: Float64[np.ndarray, "m 3"], points: Float64[np.ndarray, "n 3"], tolerance: float
) -> tuple[Int64[np.ndarray, "k 2"], Float64[np.ndarray, " k"]]:
    """Return mutual nearest neighbours of places and points within a tolerance, and their distances."""
    if len(places) == 0 or len(points) == 0:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    away = _distances(places[:, None], points[None])
    nearest = away.argmin(axis=0)
    mutual = away.argmin(axis=1)[nearest] == np.arange(len(points))
    distances = away[nearest, np.arange(len(points))]
    good = np.flatnonzero(mutual & (distances <= tolerance))
    return np.stack([nearest[good], good], axis=1).astype(np.int64), distances[good]


def _distances(
    places: Float64[np.ndarray, "*batch 3"], points: Float64[np.ndarray, "*other 3"]
) -> Float64[np.ndarray, "*both"]:
    difference = points - places
    return np.asarray(np.linalg.norm(np.where(np.isnan(difference), 0.0, difference), axis=-1))


def _fitted(
    places: Float64[np.ndarray, "m 3"], points: Float64[np.ndarray, "n 3"], pairs: Int64[np.ndarray, "k 2"]
) -> Similarity:
    """Fit a similarity by least squares: all seven parameters, or no tilt if the pairs do not determine it."""
    source, target = places[pairs[:, 0]], points[pairs[:, 1]]
    whole = np.isfinite(target).all(axis=1)
    if _spread(source, whole):
        size, rotation, translation = fit_similarity(source[whole], target[whole], np.ones(int(whole.sum())))
        return Similarity(float(size), rotation, translation)
    a, b = source[:, 0] + 1j * source[:, 1], target[:, 0] + 1j * target[:, 1]
    extent = max(float(np.vdot(a - a.mean(), a - a.mean()).real), 1e-12)
    factor = complex(np.vdot(a - a.mean(), b - b.mean())) / extent
    scale: float = max(abs(factor), 1e-6)
    turn = factor / scale
    rotation = np.array([[turn.real, -turn.imag, 0.0], [turn.imag, turn.real, 0.0], [0.0, 0.0, 1.0]])
    moved = target - scale * source @ rotation.T
    lift = float(moved[whole, 2].mean()) if whole.any() else 0.0
    return Similarity(scale, rotation, np.array([moved[:, 0].mean(), moved[:, 1].mean(), lift]))


def _spread(source: Float64[np.ndarray, "k 3"], whole: Bool[np.ndarray, " k"]) -> bool:
    """Return whether the places whose points have heights determine a rotation."""
    if whole.sum() < MIN_MATCHES:
        return False
    extents = np.linalg.svd(source[whole] - source[whole].mean(axis=0), compute_uv=False)
    return bool(extents[1] > MIN_EXTENT_RATIO * extents[0])
