"""Roofs in a coarse surface model: what stands over the ground and is plane over a metre or two, unlike crowns."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64

Cells = Float64[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]

MIN_HEIGHT_M = 2.2  # over the ground: garages are higher, cars and hedges lower
WINDOW_M = 1.1  # over which a roof is plane, from dormer to chimney
MAX_SCATTER_GSD, MAX_SCATTER_M = 1.2, 0.01  # standard deviation of the heights about a roof's plane: the sum of both
MIN_KNOWN_SHARE = 0.6  # of a window, that has to be high
MIN_ROOF_M2 = 2.0  # of the middles of plane windows that touch
MIN_WIDTH_M = 0.8  # of them: windows lie half beyond them, so that a roof is wider
GAP_M = 2.5  # between them, where there is something else on the roof: edges, chimneys, dormers
MAX_HOLE_M2 = 20.0  # inside roofs, of what is high


@dataclass(frozen=True)
class RoofScale:
    """Cell size and GSD, metres."""

    cell_m: float
    gsd_m: float

    def radius(self, metres: float) -> int:
        """Half width in cells of a window of a width."""
        return max(1, round(metres / 2.0 / self.cell_m))


def find_roofs(height: Cells, over: Cells, scale: RoofScale) -> Mask:
    """Cells of buildings, as seen from above.

    Args:
        height: Mean heights of the topmost surface, metres; NaN where there are none.
        over: The same over the ground; NaN or 0 on ground.
        scale: Cell size and GSD.
    """
    high = np.isfinite(height) & (np.nan_to_num(over) > MIN_HEIGHT_M)
    scatter, share = _scatter(np.where(high, height, 0.0), high, scale.radius(WINDOW_M))
    limit = MAX_SCATTER_GSD * scale.gsd_m + MAX_SCATTER_M
    plane = high & (share >= MIN_KNOWN_SHARE) & (scatter <= limit)
    plane = _morph(plane, cv2.MORPH_OPEN, scale.radius(MIN_WIDTH_M))
    _, parts, facts, _ = cv2.connectedComponentsWithStats(plane.astype(np.uint8), connectivity=8)
    large = facts[:, cv2.CC_STAT_AREA] * scale.cell_m**2 >= MIN_ROOF_M2
    large[0] = False
    roofs = large[parts]
    wide = cv2.dilate(roofs.astype(np.uint8), _square(scale.radius(WINDOW_M) + 1)) > 0
    return np.asarray(high & _without_holes(high & _morph(wide, cv2.MORPH_CLOSE, scale.radius(GAP_M)), scale))


def _without_holes(mask: Mask, scale: RoofScale) -> Mask:
    """The mask with its small holes."""
    holes = np.pad(~mask, 1, constant_values=True)
    _, parts, facts, _ = cv2.connectedComponentsWithStats(holes.astype(np.uint8), connectivity=4)
    small = facts[:, cv2.CC_STAT_AREA] * scale.cell_m**2 <= MAX_HOLE_M2
    small[[0, parts[0, 0]]] = False  # the mask, and the outside
    return np.asarray(mask | small[parts][1:-1, 1:-1])


def _scatter(height: Cells, known: Mask, radius: int) -> tuple[Cells, Cells]:
    """Standard deviation about the least-squares plane in the window around each cell, and the share that is known.

    Sums over windows of 1, x, y, z and their products; x and y count from the window's middle, heights from their mean
    in it.
    """
    side = 2 * radius + 1
    weight = known.astype(np.float64)
    base = float(height[known].mean()) if known.any() else 0.0
    z = np.where(known, height - base, 0.0)
    x, y = (np.arange(length, dtype=np.float64) for length in (height.shape[1], height.shape[0]))

    def summed(values: Cells) -> Cells:
        return np.asarray(
            cv2.boxFilter(values, cv2.CV_64F, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
        )

    count = np.maximum(summed(weight), 1e-9)
    mean = summed(z) / count
    fields = {"x": weight * x, "y": weight * y[:, None]}
    sx, sy = summed(fields["x"]) / count, summed(fields["y"]) / count
    xx = summed(fields["x"] * x) / count - sx * sx
    yy = summed(fields["y"] * y[:, None]) / count - sy * sy
    xy = summed(fields["x"] * y[:, None]) / count - sx * sy
    xz, yz = summed(z * x) / count - sx * mean, summed(z * y[:, None]) / count - sy * mean
    zz = summed(z * z) / count - mean * mean
    det = np.maximum(xx * yy - xy * xy, 1e-9)
    explained = (yy * xz * xz - 2.0 * xy * xz * yz + xx * yz * yz) / det
    return np.sqrt(np.maximum(zz - explained, 0.0)), count / side**2


def _square(radius: int) -> np.ndarray:
    return np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)


def _morph(mask: Mask, what: int, radius: int) -> Mask:
    wide = np.pad(mask.astype(np.uint8), radius + 1)
    done = cv2.morphologyEx(wide, what, _square(radius))
    return np.asarray(done[radius + 1 : -radius - 1, radius + 1 : -radius - 1] > 0)
