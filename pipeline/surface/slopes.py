"""Slopes of depth maps: how inverse depths grow from pixel to pixel, and turns of many vectors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32, Float64

from splatpipe.pipeline.surface.sources import PhotoWindow

SAME_PX = 10.0  # depths that differ by more than so many pixels' widths are not one surface
REACH = 2  # pixels around one that its slope is taken from


def turned(
    turn: Float64[np.ndarray, "3 3"],
    x: Float64[np.ndarray, " n"],
    y: Float64[np.ndarray, " n"],
    z: Float64[np.ndarray, " n"] | float = 1.0,
) -> list[Float64[np.ndarray, " n"]]:
    """A matrix times vectors, each by itself: a library's product would depend on how many there are."""
    return [turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z for i in range(3)]


def inverse_and_gradient(
    depth: Float32[np.ndarray, "h w"], window: PhotoWindow, same: float
) -> tuple[Float32[np.ndarray, "wh ww"], Float32[np.ndarray, "2 wh ww"]]:
    """Inverse depths of a window, 0 where there are none, and how they grow a pixel to the right and down.

    From pairs of pixels on both sides, up to two away, that lie in one plane with the pixel; from one side alone at a
    surface's rim; nan for a pixel without neighbours.
    """
    wide = _cut(depth, window, REACH)
    inverse = np.divide(np.float32(1.0), wide, out=np.full_like(wide, np.nan), where=wide > 0.0)  # nan is near nothing
    height, width = window.bottom - window.top, window.right - window.left
    centre = inverse[REACH:-REACH, REACH:-REACH]
    near = centre * np.float32(same)
    gradients = []
    for axis in (0, 1):

        def beside(along: int, aside: int, axis: int = axis) -> Float32[np.ndarray, "wh ww"]:
            down, right = (aside, along) if axis == 0 else (along, aside)
            rows, columns = (slice(REACH + by, REACH + by + size) for by, size in ((down, height), (right, width)))
            return np.asarray(inverse[rows, columns])

        gradients.append(_gradient(centre, near, beside))
    return np.nan_to_num(centre, nan=0.0), np.stack(gradients)


def _gradient(
    centre: Float32[np.ndarray, "h w"],
    near: Float32[np.ndarray, "h w"],
    beside: Callable[[int, int], Float32[np.ndarray, "h w"]],
) -> Float32[np.ndarray, "h w"]:
    """How inverse depths grow from a pixel to the next one in a direction, by least squares over pairs of pixels."""
    total, weight = np.zeros_like(centre), np.zeros_like(centre)
    twice = centre + centre
    for along in (1, 2):
        for aside in (-1, 0, 1):
            ahead, behind = beside(along, aside), beside(-along, aside)
            difference, bend = ahead - behind, ahead + behind
            bend -= twice
            flat = np.abs(bend, out=bend) < near
            flat &= np.abs(difference) < near * np.float32(2 * along)
            np.add(total, np.float32(along) * difference, out=total, where=flat)
            weight += flat * np.float32(2 * along * along)
    lone = np.flatnonzero(weight == 0.0)
    here = centre.ravel()[lone]
    result = np.divide(total, weight, out=total, where=weight > 0.0)
    ahead, behind = (beside(along, 0).ravel()[lone] - here for along in (1, -1))
    limit = near.ravel()[lone]
    single = np.where(np.abs(ahead) < limit, ahead, np.where(np.abs(behind) < limit, -behind, np.float32(np.nan)))
    result.ravel()[lone] = single
    return np.asarray(result)


def _cut(depth: Float32[np.ndarray, "h w"], window: PhotoWindow, reach: int) -> Float32[np.ndarray, "a b"]:
    """A window and some pixels around it; 0 outside of the picture."""
    height, width = depth.shape
    top, bottom = max(0, window.top - reach), min(height, window.bottom + reach)
    left, right = max(0, window.left - reach), min(width, window.right + reach)
    edges = (
        (top - window.top + reach, window.bottom + reach - bottom),
        (left - window.left + reach, window.right + reach - right),
    )
    return np.pad(depth[top:bottom, left:right], edges)
