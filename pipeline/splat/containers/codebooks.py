"""Scalar codebooks: their values, and the nearest value for every number; identical for any number of threads."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8

CODEBOOK_SIZE = 256
"""Values in a codebook: one per byte value."""
_STRETCHES = 4096  # bins of equal counts from which the density is estimated
_ITERATIONS = 200  # starting near the optimum, the last ones move values by a thousandth of their spacing


def fit_codebook(
    values: Float32[np.ndarray, " n"], weights: Float32[np.ndarray, " n"] | None = None, size: int = CODEBOOK_SIZE
) -> Float32[np.ndarray, 256]:
    """Fit a codebook with a small sum of squared distances to all numbers.

    The start has the density that is optimal for many values, the cube root of the numbers' own (P. F. Panter and W.
    Dite, "Quantization distortion in pulse-count modulation with nonuniform spacing of levels", 1951); from there every
    value moves to the mean of the numbers nearest to it (S. Lloyd, "Least squares quantization in PCM", 1982), which
    for sorted numbers takes a binary search instead of a pass.

    Args:
        values: Numbers, finite.
        weights: Positive weight of each number; None for equal weights.
        size: Maximum number of distinct values.

    Returns:
        The values, ascending; the last one is repeated if fewer are needed.
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
    del order, is_new  # for the SH of five million Gaussians, each array here is a tenth of the whole model
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
    """Index of the codebook value nearest to each number."""
    return np.asarray(np.searchsorted((codebook[1:] + codebook[:-1]) / 2, values).astype(np.uint8))


def _start(
    ordered: Float64[np.ndarray, " n"], mass: Float64[np.ndarray, " n1"], size: int
) -> Float64[np.ndarray, " k"]:
    """Initial values: in bins of equal mass, the optimal share of values in a bin of width w goes as w^(2/3)."""
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
