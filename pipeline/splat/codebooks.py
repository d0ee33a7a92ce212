"""Codebooks of one number: so many values, and the nearest of them for every number; the same for any threads."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8

CODEBOOK_SIZE = 256
"""Values in a codebook: what a byte tells apart."""
_STRETCHES = 4096  # of equal numbers of values, along which their density is followed
_ITERATIONS = 200  # from a start that is near the best the last ones move values by a thousandth of their distance


def fit_codebook(
    values: Float32[np.ndarray, " n"], weights: Float32[np.ndarray, " n"] | None = None, size: int = CODEBOOK_SIZE
) -> Float32[np.ndarray, 256]:
    """The values whose squares of distances to all numbers sum up to little.

    The start has the density that is best for many values, the cube root of the numbers' own (P. F. Panter and W. Dite,
    "Quantization distortion in pulse-count modulation with nonuniform spacing of levels", 1951); from there every value
    moves to the mean of the numbers that are nearest to it (S. Lloyd, "Least squares quantization in PCM", 1982), which
    for sorted numbers takes a search instead of a pass.

    Args:
        values: Numbers, finite.
        weights: Of each, positive; alike without.
        size: Most different values.

    Returns:
        Ascending; the last one again where fewer are needed.
    """
    if not len(values):
        return np.zeros(CODEBOOK_SIZE, np.float32)
    order = np.argsort(values, kind="stable")
    ordered = values[order].astype(np.float64)
    is_new = np.concatenate(([True], ordered[1:] != ordered[:-1]))
    if np.count_nonzero(is_new) <= size:
        return _filled(ordered[is_new])
    mass, moment = np.zeros((2, len(ordered) + 1))
    np.cumsum(np.ones(len(ordered)) if weights is None else weights[order], out=mass[1:])
    del order, is_new  # of the harmonics of five million Gaussians each array here is a tenth of all that they are
    moments = np.diff(mass)
    moments *= ordered
    np.cumsum(moments, out=moment[1:])
    del moments
    found = _start(ordered, mass, size)
    for _ in range(_ITERATIONS):
        bounds = _bounds(ordered, found)
        inside, sums = np.diff(mass[bounds]), np.diff(moment[bounds])
        found = np.where(inside > 0.0, sums / np.where(inside > 0.0, inside, 1.0), found)
    return _filled(np.unique(found.astype(np.float32)))


def nearest_codes(
    values: Float32[np.ndarray, "*shape"], codebook: Float32[np.ndarray, 256]
) -> UInt8[np.ndarray, "*shape"]:
    """Which of a codebook's values is nearest to each number."""
    return np.asarray(np.searchsorted((codebook[1:] + codebook[:-1]) / 2, values).astype(np.uint8))


def _start(
    ordered: Float64[np.ndarray, " n"], mass: Float64[np.ndarray, " n1"], size: int
) -> Float64[np.ndarray, " k"]:
    """In stretches of equal mass and width w there are best w^(2/3) of all values."""
    ends = np.searchsorted(mass[1:], np.linspace(0.0, mass[-1], _STRETCHES + 1)).clip(0, len(ordered) - 1)
    edges = ordered[ends]
    share = np.concatenate(([0.0], np.cumsum(np.diff(edges) ** (2.0 / 3.0))))
    at = (np.arange(size) + 0.5) * (share[-1] / size)
    return np.asarray(np.interp(at, share, edges))


def _bounds(ordered: Float64[np.ndarray, " n"], found: Float64[np.ndarray, " k"]) -> Int64[np.ndarray, " k1"]:
    middles = (found[1:] + found[:-1]) / 2
    return np.concatenate(([0], np.searchsorted(ordered, middles), [len(ordered)])).astype(np.int64)


def _filled(found: Float[np.ndarray, " m"]) -> Float32[np.ndarray, 256]:
    return np.concatenate((found, np.full(CODEBOOK_SIZE - len(found), found[-1]))).astype(np.float32)
