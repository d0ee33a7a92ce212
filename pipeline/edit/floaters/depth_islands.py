"""Removes islands from a depth map: small regions nearer than everything around them get the surrounding depth.

A grey-scale closing (the largest depth along a line segment, then the least of those) fills what is shorter than the
segment. The minimum over several directions is used, so that a pole or an eave, long in one direction, stays: the
infimum of closings by segments (P. Soille, "Morphological Image Analysis", 2nd ed. 2004).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

LINE_SHARE = 0.1
"""Largest extent of an island as a share of an image's longer side: 63 pixels at 0.3 megapixels."""
DIRECTIONS = 8
SKY_DEPTH_RATIO = 4.0  # depth of pixels without a surface over the farthest depth: the sky is behind everything


def without_islands(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """The depth map with islands replaced by the depth behind them; elsewhere about unchanged, never nearer.

    Args:
        depth: Depths along the view axis, world units; 0 where there is no surface.
    """
    farthest = float(depth.max(initial=0.0))
    if farthest <= 0.0:
        return np.full_like(depth, SKY_DEPTH_RATIO)
    solid = np.where(depth > 0.0, depth, np.float32(SKY_DEPTH_RATIO * farthest))
    least = np.full_like(solid, np.inf)
    for line in _lines(max(3, round(LINE_SHARE * max(depth.shape)))):
        closed = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, line, borderType=cv2.BORDER_REPLICATE)
        np.minimum(least, closed, out=least)
    return least


def _lines(length: int) -> list[UInt8[np.ndarray, "_ _"]]:
    """Structuring elements: segments through a rectangle's centre, one pixel wide, in ``DIRECTIONS`` directions."""
    half = (length | 1) // 2
    lines = []
    for turn in range(DIRECTIONS):
        angle = math.pi * turn / DIRECTIONS
        right, down = round(half * math.cos(angle)), round(half * math.sin(angle))
        line = np.zeros((2 * abs(down) + 1, 2 * abs(right) + 1), np.uint8)  # no larger: OpenCV is fast for a column
        middle_x, middle_y = abs(right), abs(down)
        cv2.line(line, (middle_x - right, middle_y - down), (middle_x + right, middle_y + down), 1)
        lines.append(line)
    return lines
