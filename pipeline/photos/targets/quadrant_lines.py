"""Fit two blurred lines through a point, which separate bright from dark, to the pixels around it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64

FIRST_BLUR_PX = 0.8
BLUR_BOUNDS_PX = (0.25, 4.8)
LONGEST_STEP = np.array([1.0, 1.0, 0.3, 0.3, np.inf, np.inf, 0.5])
RING_PX, RING_STEPS = 2.8, 32
NEAR_PX = 3.5  # radius of the first fit, around places
NEAR_ROUNDS = 6
AT_ONCE = 4096  # places at a time, to save memory
ROUNDS = 12
MIN_PIXELS = 14


@dataclass(frozen=True)
class LinePair:
    """Two lines through a point, and the brightness of the sectors between them.

    Attributes:
        values: x, y, two angles, mean brightness, half the contrast, blur (width of a hyperbolic tangent).
    """

    values: Float64[np.ndarray, " 7"]

    def directions(self) -> Float64[np.ndarray, "2 2"]:
        """Unit vectors along the lines."""
        angles = self.values[2:4]
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def sample_bilinearly(
    grey: Float32[np.ndarray, "h w"], x: Float32[np.ndarray, "n m"], y: Float32[np.ndarray, "n m"]
) -> Float32[np.ndarray, "n m"]:
    """Sample bilinearly, in pieces that remap supports (fewer than 32,768 rows)."""
    if len(x) == 0:
        return np.zeros_like(x)
    pieces = [
        cv2.remap(grey, x[k : k + 30_000], y[k : k + 30_000], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for k in range(0, len(x), 30_000)
    ]
    return np.concatenate(pieces)


def sample_ring(
    grey: Float32[np.ndarray, "h w"], places: Float64[np.ndarray, "n 2"], radius: float
) -> Float64[np.ndarray, "n steps"]:
    """Brightness on a circle around each place."""
    angles = 2.0 * np.pi * np.arange(RING_STEPS) / RING_STEPS
    x = (places[:, 0, None] + radius * np.cos(angles)).astype(np.float32)
    y = (places[:, 1, None] + radius * np.sin(angles)).astype(np.float32)
    return sample_bilinearly(grey, x, y).astype(np.float64)


def fit_near(
    grey: Float32[np.ndarray, "h w"], places: Float64[np.ndarray, "n 2"]
) -> tuple[Float64[np.ndarray, "k 7"], Float64[np.ndarray, " k"]]:
    """Fit lines through places to nearby pixels; return them and their correlations, for places that have lines."""
    found, scores = [np.zeros((0, 7))], [np.zeros(0)]
    for first in range(0, len(places), AT_ONCE):
        values = _starts(grey, places[first : first + AT_ONCE])
        values, score = _fit_discs(grey, values)
        found.append(values)
        scores.append(score)
    return np.concatenate(found), np.concatenate(scores)


def _starts(grey: Float32[np.ndarray, "h w"], places: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "k 7"]:
    """Initial lines, where the ring around a place crosses its mean brightness."""
    ring, half = sample_ring(grey, places, RING_PX), RING_STEPS // 2
    ring = (ring[:, :half] + ring[:, half:]) / 2.0
    low, high = ring.min(axis=1), ring.max(axis=1)
    middle = (low + high) / 2.0
    after = np.roll(ring, -1, axis=1)
    crosses = (ring > middle[:, None]) != (after > middle[:, None])
    two = crosses.sum(axis=1) == 2
    ring, after, middle, crosses = ring[two], after[two], middle[two], crosses[two]
    at = np.nonzero(crosses)[1].reshape(-1, 2)
    rows = np.arange(len(at))[:, None]
    angles = np.pi / half * (at + (middle[:, None] - ring[rows, at]) / (after[rows, at] - ring[rows, at]))
    # Either the bright or the dark sector lies between the first and the second line.
    sign = np.where(ring[rows[:, 0], (at[:, 0] + 1) % half] > middle, 1.0, -1.0)
    contrast = sign * (high[two] - low[two]) / 2.0
    blur = np.full(len(at), FIRST_BLUR_PX)
    return np.concatenate([places[two], angles, np.stack([middle, contrast, blur], axis=1)], axis=1)


def _fit_discs(
    grey: Float32[np.ndarray, "h w"], values: Float64[np.ndarray, "n 7"]
) -> tuple[Float64[np.ndarray, "n 7"], Float64[np.ndarray, " n"]]:
    """Fit lines by least squares over the pixels of a disc, all places at once, each with its own damping."""
    reach = int(NEAR_PX) + 1
    column, row = (v.ravel() for v in np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1)))
    disc = column**2 + row**2 <= NEAR_PX**2
    middle = np.rint(values[:, :2]).astype(np.int64)
    x = np.clip(middle[:, :1] + column[disc], 0, grey.shape[1] - 1)
    y = np.clip(middle[:, 1:] + row[disc], 0, grey.shape[0] - 1)
    seen = grey[y, x].astype(np.float64)
    x, y = x.astype(np.float64), y.astype(np.float64)
    damping = np.full(len(values), 1e-3)
    predicted, derivatives = model(values, x, y)
    cost = ((seen - predicted) ** 2).sum(axis=1)
    for _ in range(NEAR_ROUNDS):
        trial = _take_step(values, seen - predicted, derivatives, damping)
        predicted_there, derivatives_there = model(trial, x, y)
        there = ((seen - predicted_there) ** 2).sum(axis=1)
        better = there < cost
        values = np.where(better[:, None], trial, values)
        predicted = np.where(better[:, None], predicted_there, predicted)
        derivatives = np.where(better[:, None, None], derivatives_there, derivatives)
        cost = np.where(better, there, cost)
        damping = np.where(better, damping / 5.0, damping * 8.0)
    return values, correlation(seen, predicted)


def fit_within(grey: Float32[np.ndarray, "h w"], lines: LinePair, reach: Float64[np.ndarray, " 2"]) -> LinePair | None:
    """Fit lines by least squares over the pixels within an ellipse; None if it has too few.

    Args:
        grey: The image.
        lines: The initial lines.
        reach: Half-length along each line, pixels; the lines are conjugate diameters of the ellipse.
    """
    around = pixels_within(grey, lines, reach)
    if around is None:
        return None
    x, y, seen = (v[None] for v in around)
    values, damping = lines.values[None], np.full(1, 1e-3)
    predicted, derivatives = model(values, x, y)
    cost = float(((seen - predicted) ** 2).sum())
    for _ in range(ROUNDS):
        trial = _take_step(values, seen - predicted, derivatives, damping)
        predicted_there, derivatives_there = model(trial, x, y)
        there = float(((seen - predicted_there) ** 2).sum())
        if there >= cost:
            damping = damping * 8.0
            continue
        converged = cost - there < 1e-5 * cost
        values, predicted, derivatives, cost = trial, predicted_there, derivatives_there, there
        damping = damping / 5.0
        if converged:
            break
    return LinePair(values[0]) if np.isfinite(values).all() else None


def _take_step(
    values: Float64[np.ndarray, "n 7"],
    residuals: Float64[np.ndarray, "n m"],
    derivatives: Float64[np.ndarray, "n m 7"],
    damping: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, "n 7"]:
    """Take a bounded Levenberg-Marquardt step."""
    normal = np.einsum("nmi,nmj->nij", derivatives, derivatives)
    diagonal = np.einsum("nii->ni", normal) + 1e-9
    normal = normal + (damping[:, None] * diagonal)[:, :, None] * np.eye(7)
    step = np.linalg.solve(normal, np.einsum("nmi,nm->ni", derivatives, residuals)[:, :, None])[:, :, 0]
    trial = values + np.clip(step, -LONGEST_STEP, LONGEST_STEP)
    trial[:, 6] = np.clip(trial[:, 6], *BLUR_BOUNDS_PX)
    return np.asarray(trial)


def model(
    values: Float64[np.ndarray, "n 7"], x: Float64[np.ndarray, "n m"], y: Float64[np.ndarray, "n m"]
) -> tuple[Float64[np.ndarray, "n m"], Float64[np.ndarray, "n m 7"]]:
    """Brightness of the product of two blurred edges, and its derivatives.

    A blurred edge is approximated by a hyperbolic tangent, which is cheap.
    """
    cx, cy, first, second, middle, contrast, blur = (values[:, k, None] for k in range(7))
    dx, dy = x - cx, y - cy
    # Signed distances: positive to the left of the first line, to the right of the second.
    u = -np.sin(first) * dx + np.cos(first) * dy
    v = np.sin(second) * dx - np.cos(second) * dy
    p, q = np.tanh(u / blur), np.tanh(v / blur)
    dp, dq = contrast * q * (1.0 - p * p) / blur, contrast * p * (1.0 - q * q) / blur
    derivatives = np.stack(
        [
            dp * np.sin(first) - dq * np.sin(second),
            -dp * np.cos(first) + dq * np.cos(second),
            -dp * (np.cos(first) * dx + np.sin(first) * dy),
            dq * (np.cos(second) * dx + np.sin(second) * dy),
            np.ones_like(u),
            p * q,
            -(dp * u + dq * v) / blur,
        ],
        axis=2,
    )
    return middle + contrast * p * q, derivatives


def correlation(seen: Float64[np.ndarray, "n m"], predicted: Float64[np.ndarray, "n m"]) -> Float64[np.ndarray, " n"]:
    """Correlation of corresponding rows."""
    a, b = seen - seen.mean(axis=1, keepdims=True), predicted - predicted.mean(axis=1, keepdims=True)
    return np.asarray((a * b).sum(axis=1) / np.maximum(np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1)), 1e-9))


def pixels_within(
    grey: Float32[np.ndarray, "h w"], lines: LinePair, reach: Float64[np.ndarray, " 2"]
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]] | None:
    """Return x, y and brightness of the pixels within the ellipse whose conjugate radii are the lines' reaches."""
    axes = lines.directions() * reach[:, None]
    span = np.abs(axes).sum(axis=0)
    height, width = grey.shape
    cx, cy = lines.values[:2].tolist()
    left, right = int(np.floor(cx - span[0])), int(np.ceil(cx + span[0])) + 1
    top, bottom = int(np.floor(cy - span[1])), int(np.ceil(cy + span[1])) + 1
    left, top, right, bottom = max(left, 0), max(top, 0), min(right, width), min(bottom, height)
    if right - left < 3 or bottom - top < 3 or abs(np.linalg.det(axes)) < 1.0:
        return None
    column, row = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
    away = np.stack([column.ravel() - cx, row.ravel() - cy], axis=1) @ np.linalg.inv(axes)
    inside = (away**2).sum(axis=1) <= 1.0
    if inside.sum() < MIN_PIXELS:
        return None
    x, y = column.ravel()[inside].astype(np.float64), row.ravel()[inside].astype(np.float64)
    return x, y, grey[top:bottom, left:right].ravel()[inside].astype(np.float64)
