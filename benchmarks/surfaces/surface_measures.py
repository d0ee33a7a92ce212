"""Accuracy measures for surfaces: functions of arrays, independent of the method that made them.

Errors are NaN where something is missing that should exist. That counts as wrong: in shares, quantiles and the NMAD it
is worse than any bound. Only the bias, which is signed, covers existing values alone; completeness covers the rest.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8
from tables import Row

NMAD_OF_MAD = 1.4826  # MAD to standard deviation for normal errors (Höhle and Höhle, 2009)
MAX_CHANNEL_VALUE = 255.0  # largest value of a colour channel
MOVED_LIMIT = 1e3  # dB: for identical images


def figures(errors_m: Float64[np.ndarray, " n"], gsd_m: float) -> Row:
    """Summarise the errors at places that count, in GSD.

    Args:
        errors_m: Signed errors, normal to the surface; NaN where missing.
        gsd_m: GSD of the original photos.

    Returns:
        ``cells``, ``complete`` (share with a value), ``bias`` (median) and ``mean`` of the existing values; ``nmad``,
            ``p95`` and the shares ``within_2``, ``within_25`` (2.5) and ``within_3`` of all; None where not finite.
    """
    row: Row = {"cells": int(errors_m.size)}
    if errors_m.size == 0:
        return row
    errors = errors_m / gsd_m
    there = np.isfinite(errors)
    row["complete"] = float(there.mean())
    size = np.where(there, np.abs(errors), np.inf)
    row |= {f"within_{name}": float((size <= bound).mean()) for name, bound in (("2", 2), ("25", 2.5), ("3", 3))}
    row["p95"] = _finite(float(np.quantile(size, 0.95, method="higher")))
    if not there.any():
        return row | {"bias": None, "mean": None, "nmad": None}
    middle = float(np.median(errors[there]))
    apart = np.where(there, np.abs(errors - middle), np.inf)
    nmad = _finite(NMAD_OF_MAD * float(np.quantile(apart, 0.5, method="higher")))
    return row | {"bias": middle, "mean": float(errors[there].mean()), "nmad": nmad}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def near_steps(heights: Float64[np.ndarray, "h w"], step_m: float, cells: int) -> Bool[np.ndarray, "h w"]:
    """Return the cells within a distance of a step in the true heights, or of a hole.

    Args:
        heights: True heights; not finite where there is nothing.
        step_m: Difference that neighbours on a roof never reach.
        cells: The distance, cells.
    """
    held = np.where(np.isfinite(heights), heights, -1e9)
    step = np.zeros(heights.shape, bool)
    for axis in (0, 1):
        first, second = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        apart = np.abs(np.diff(held, axis=axis)) > step_m
        step[first] |= apart
        step[second] |= apart
    reach = max(cells - 1, 0)  # both cells of a step are within one of it
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.dilate(step.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0)


def relief_errors(
    found: Float64[np.ndarray, "h w"], true: Float64[np.ndarray, "h w"], cosine: Float64[np.ndarray, "h w"]
) -> Float64[np.ndarray, "h w"]:
    """Return the distances of grid heights normal to the true surface, positive outside; NaN where either is missing.

    Args:
        found: Heights; NaN where missing.
        true: True heights; not finite where there is nothing.
        cosine: Cosine between the true normal and the height axis.
    """
    return np.asarray(np.where(np.isfinite(true), found - np.where(np.isfinite(true), true, 0.0), np.nan) * cosine)


def psnr(
    picture: UInt8[np.ndarray, "h w 3"], truth: UInt8[np.ndarray, "h w 3"], counts: Bool[np.ndarray, "h w"]
) -> float:
    """Return the PSNR over the pixels that count, dB; the image must be black where it is empty."""
    apart = picture[counts].astype(np.float64) - truth[counts]
    mean = float(np.square(apart).mean())
    return MOVED_LIMIT if mean == 0.0 else 10.0 * math.log10(MAX_CHANNEL_VALUE**2 / mean)


def fitted_colours(
    picture: UInt8[np.ndarray, "h w 3"], truth: UInt8[np.ndarray, "h w 3"], counts: Bool[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the image with each channel fitted to the truth by an affine function over the pixels that count."""
    result = np.empty_like(picture)
    for channel in range(3):
        known = np.stack([picture[counts, channel].astype(np.float64), np.ones(int(counts.sum()))], axis=1)
        gain, offset = np.linalg.lstsq(known, truth[counts, channel].astype(np.float64), rcond=None)[0]
        result[..., channel] = np.clip(picture[..., channel] * gain + offset + 0.5, 0.0, MAX_CHANNEL_VALUE)
    return result


def reached(distances_m: Float64[np.ndarray, " n"], bound_m: float) -> float:
    """Return the share within a bound; zero for an empty product."""
    return float((distances_m <= bound_m).mean()) if distances_m.size else 0.0


def harmonic(precision: float, recall: float) -> float:
    """Return the harmonic mean of precision and recall, F1."""
    return 2.0 * precision * recall / (precision + recall) if precision + recall > 0.0 else 0.0


def rmse(apart: Float64[np.ndarray, "n 2"]) -> float | None:
    """Return the RMS length of difference vectors; None if one is missing (NaN) or there are none."""
    if apart.size == 0 or not np.isfinite(apart).all():
        return None
    return float(np.sqrt(np.square(apart).sum(axis=1).mean()))
