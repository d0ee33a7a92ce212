"""Which cells of a coarse surface model are ground: what wide windows leave, and what joins it without a step.

1. Low noise is taken out: pits too small to be seen into.
2. What is narrower than a window and stands out of it is an object, for windows from a cell to the widest building
   (opening with growing windows; Zhang et al., "A progressive morphological filter for removing nonground measurements
   from airborne LIDAR data", IEEE TGRS 41, 2003), over the site's trend, so that a slope is like a plane.
3. Windows cut off hill tops and terraces, too. So cells are joined to patches between which there are steps: a patch of
   which enough is left is ground as a whole, except for pieces that the windows cut off and from which it goes down
   steeply nearly all around. A dune has no step around it; a roof has, with a gap perhaps where a tree leans on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.surface.ground.membrane import fill_membrane
from splatpipe.pipeline.surface.ground.trend import site_trend

Cells = Float64[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]

WIDEST_M = 30.0  # half the width of the widest building that is taken out
WINDOW_GROWTH = 1.4  # from one window to the next
RISE = 0.1  # height over half width from which something is an object, over the trend
NOISE_GSD = 4.0  # height differences up to this are noise: 95 % of heights are within 3 GSD
STEP_SLOPE = 1.0  # steeper than 45°, there is no way from a patch to the next: earth stands less steeply
MIN_GROUND_SHARE = 0.3  # of a patch, that has to be left by the windows
PIT_M, PIT_M2 = 1.2, 1.0  # half width and area up to which a pit is noise
LOW_OBJECT_M, LOW_OBJECT_M2 = 3.0, 30.0  # half width and area up to which something lower than a step is an object,
EDGE_SHARE, EDGE_SLOPE = 0.6, 0.25  # if this share of its edge is steeper than this: the rest is a hump of the ground
GROWTH_CELLS = 4  # into steps, from both sides
GROWTH_DOWN, GROWTH_UP = 0.3, 0.15  # slopes over the trend: what rises is more often an object's foot
SURE_NEIGHBOURS, SURE_M2 = 6, 4.0  # of eight, and area of cells with so many: what else is ground must not rise


@dataclass(frozen=True)
class GroundScale:
    """What the filter's lengths follow from.

    Attributes:
        cell_m: Cell size of the coarse surface model, metres.
        gsd_m: GSD of the photos, metres.
    """

    cell_m: float
    gsd_m: float

    @property
    def noise_m(self) -> float:
        """Height difference that noise may make, metres."""
        return NOISE_GSD * self.gsd_m

    def cells(self, metres: float) -> int:
        """Cells in a length, at least one."""
        return max(1, round(metres / self.cell_m))

    def windows(self) -> list[int]:
        """Half widths of the windows, cells, each larger than the one before."""
        widest, found = self.cells(WIDEST_M), [1]
        while found[-1] < widest:
            found.append(min(widest, max(found[-1] + 1, math.ceil(WINDOW_GROWTH * found[-1]))))
        return found


def find_ground(height: Cells, scale: GroundScale) -> Mask:
    """Find the cells that are ground.

    Args:
        height: Low heights of cells, metres; NaN where there are none.
        scale: Their size.
    """
    clean = np.where(_pits(height, scale), np.nan, height)
    if not np.isfinite(clean).any():
        return np.zeros(height.shape, np.bool_)
    over = clean - site_trend(clean, scale.cell_m)
    left = _left_by_windows(over, scale)
    patches = _whole_patches(clean, left, scale)
    objects = _low_objects(over, scale) | _steep_pieces(patches & ~left, over, scale)
    grown = _grown(patches & ~objects, over, scale) & ~objects
    return _without_feet(grown, over, scale)


def _pits(height: Cells, scale: GroundScale) -> Mask:
    """Cells of pits that are too small to be real, as low noise makes them."""
    radius = scale.cells(PIT_M)
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    raised = cv2.dilate(np.where(np.isfinite(height), height, -np.inf), kernel, borderValue=-np.inf)
    closed = cv2.erode(raised, kernel, borderValue=np.inf)
    with np.errstate(invalid="ignore"):
        deep = (closed - height > scale.noise_m + RISE * PIT_M) & np.isfinite(height)
    _, parts, facts, _ = cv2.connectedComponentsWithStats(deep.astype(np.uint8), connectivity=8)
    small = facts[:, cv2.CC_STAT_AREA] * scale.cell_m**2 <= PIT_M2
    small[0] = False
    return np.asarray(small[parts])


def _opened(height: Cells, radius: int) -> Cells:
    """Opening with a square of this half width; NaN is nothing, neither low nor high."""
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    known = np.isfinite(height)
    low = cv2.erode(np.where(known, height, np.inf), kernel, borderValue=np.inf)
    low = np.where(np.isfinite(low), low, -np.inf)
    high = cv2.dilate(low, kernel, borderValue=-np.inf)
    return np.where(known, high, np.nan)


def _left_by_windows(over: Cells, scale: GroundScale) -> Mask:
    """Cells that no window takes for an object."""
    here, objects = over, ~np.isfinite(over)
    for radius in scale.windows():
        low = _opened(here, radius)
        with np.errstate(invalid="ignore"):
            objects |= here - low > scale.noise_m + RISE * radius * scale.cell_m
        here = low
    return np.asarray(~objects)


def _steps(height: Cells, scale: GroundScale) -> Mask:
    """Cells beside which heights differ by more than a slope explains, and those without a height."""
    kernel = np.ones((3, 3), np.uint8)
    known = np.isfinite(height)
    high = cv2.dilate(np.where(known, height, -np.inf), kernel, borderValue=-np.inf)
    low = cv2.erode(np.where(known, height, np.inf), kernel, borderValue=np.inf)
    with np.errstate(invalid="ignore"):
        steep = known & (high - low > scale.noise_m + 2.0 * STEP_SLOPE * scale.cell_m)
    return np.asarray(steep | ~known)


def _whole_patches(height: Cells, left: Mask, scale: GroundScale) -> Mask:
    """Patches without a step, of which enough is left by the windows."""
    smooth = ~_steps(height, scale)
    count, parts = cv2.connectedComponents(smooth.astype(np.uint8), connectivity=4)
    total = np.bincount(parts.ravel(), minlength=count)
    kept = np.bincount(parts.ravel(), left.ravel(), minlength=count)
    good = kept >= MIN_GROUND_SHARE * total
    good[0] = False
    return np.asarray(good[parts])


def _low_objects(over: Cells, scale: GroundScale) -> Mask:
    """What is narrow and stands out of the ground with steep edges nearly all around, however low it is."""
    cut = np.zeros(over.shape, np.bool_)
    for radius in scale.windows():
        if radius * scale.cell_m > LOW_OBJECT_M:
            break
        with np.errstate(invalid="ignore"):
            cut |= over - _opened(over, radius) > scale.noise_m + RISE * radius * scale.cell_m
    return _steep_pieces(cut, over, scale, LOW_OBJECT_M2)


def _steep_pieces(cut: Mask, over: Cells, scale: GroundScale, largest_m2: float = math.inf) -> Mask:
    """Pieces that windows have cut off and from whose edge it goes down steeply nearly all around."""
    count, parts, facts, _ = cv2.connectedComponentsWithStats(cut.astype(np.uint8), connectivity=4)
    border = cut & (cv2.erode(cut.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) == 0)
    beside = cv2.erode(np.where(cut | np.isnan(over), np.inf, over), np.ones((5, 5), np.uint8), borderValue=np.inf)
    with np.errstate(invalid="ignore"):
        steep = border & (over - beside > scale.noise_m + EDGE_SLOPE * 2.0 * scale.cell_m)
    edges, steep_edges = (np.bincount(parts[mask], minlength=count) for mask in (border, steep))
    objects = (facts[:, cv2.CC_STAT_AREA] * scale.cell_m**2 <= largest_m2) & (steep_edges >= EDGE_SHARE * edges)
    objects[0] = False
    return np.asarray(objects[parts])


def _grown(ground: Mask, over: Cells, scale: GroundScale) -> Mask:
    """Ground extended into the steps around it, as far as heights continue."""
    near = np.ones((3, 3), np.float64)
    for _ in range(GROWTH_CELLS):
        weight = cv2.filter2D(ground.astype(np.float64), -1, near, borderType=cv2.BORDER_CONSTANT)
        total = cv2.filter2D(np.where(ground, over, 0.0), -1, near, borderType=cv2.BORDER_CONSTANT)
        mean = total / np.maximum(weight, 1.0)
        rise = over - mean
        with np.errstate(invalid="ignore"):
            low = rise <= scale.noise_m / 2.0 + GROWTH_UP * scale.cell_m
            like = low & (rise >= -scale.noise_m - GROWTH_DOWN * scale.cell_m)
        new = ~ground & (weight >= 2.0) & like
        if not new.any():
            break
        ground = ground | new
    return ground


def _without_feet(ground: Mask, over: Cells, scale: GroundScale) -> Mask:
    """Ground without the feet of objects, and without scraps, that rise over what is surely ground around them."""
    around = np.ones((3, 3), np.float64)
    count = cv2.filter2D(ground.astype(np.float64), -1, around, borderType=cv2.BORDER_REFLECT) - ground
    core = ground & (count >= SURE_NEIGHBOURS)
    _, parts, facts, _ = cv2.connectedComponentsWithStats(core.astype(np.uint8), connectivity=4)
    large = facts[:, cv2.CC_STAT_AREA] * scale.cell_m**2 >= SURE_M2
    large[0] = False
    sure = np.asarray(large[parts])
    if not sure.any():
        return ground
    level = fill_membrane(np.where(sure, over, np.nan))
    with np.errstate(invalid="ignore"):
        return np.asarray(ground & (sure | (over - level <= scale.noise_m / 2.0)))
