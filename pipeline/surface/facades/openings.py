"""Outlines of a wall's openings, its projecting parts, and the wall itself."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from splatpipe.pipeline.surface.sheets.raster_plane import RasterPlane

RECESS_M, JUT_M = 0.05, 0.12  # behind the plane: window frames; in front of it: canopies, not shutters and plinths
STEP_GSD = 2.0  # and at least this many pixels: depths of coarse photos scatter more
MIN_AREA_M2 = 0.15  # smallest opening; smaller ones are vents and noise
MIN_NOTCH_M = 0.06  # narrower notches and spots of a mask are removed
BRIDGED_M = 1.2  # narrower notches in the wall's outline, e.g. by bushes in front of it, are closed
OUTLINE_TOLERANCE_CELLS = 1.5  # tolerance of a simplified outline
MIN_ENCLOSED_SHARE, RIM_CELLS = (
    0.5,
    3,
)  # least share of the wall's face in the cells around an opening: around a roof, it is small
# Share of its level rectangle that an opening fills to be drawn as one; a round window fills 0.79.
MIN_RECTANGLE_SHARE = 0.8
Ring = Float64[np.ndarray, "_ 2"]


def recesses(depth: Float32[np.ndarray, "h w"], plane: RasterPlane) -> list[Ring]:
    """Outlines of openings (areas behind the plane surrounded by the wall's face) on the plane, metres."""
    limit = max(RECESS_M, STEP_GSD * plane.lattice.cell_m)
    face = np.isfinite(depth) & (np.nan_to_num(depth, nan=-np.inf) >= -limit)
    return _rings(np.nan_to_num(depth, nan=0.0) < -limit, plane, face)


def projections(depth: Float32[np.ndarray, "h w"], plane: RasterPlane) -> list[Ring]:
    """Outlines of parts that project from the plane, metres."""
    limit = max(JUT_M, STEP_GSD * plane.lattice.cell_m)
    return _rings(np.nan_to_num(depth, nan=0.0) > limit, plane, None)


def outlines(depth: Float32[np.ndarray, "h w"], plane: RasterPlane) -> list[Ring]:
    """Outlines of the known wall, with small holes and notches closed."""
    known = np.isfinite(depth).astype(np.uint8)
    reach = round(BRIDGED_M / plane.lattice.cell_m)
    wide = cv2.copyMakeBorder(known, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0)
    closed = np.asarray(cv2.morphologyEx(wide, cv2.MORPH_CLOSE, _square(reach)))
    height, width = known.shape
    return _rings(closed[reach : reach + height, reach : reach + width] > 0, plane, None)


def _square(cells: int) -> UInt8[np.ndarray, "k k"]:
    """A square kernel of odd size: an even one would shift the result."""
    side = 2 * (cells // 2) + 1
    return np.ones((side, side), np.uint8)


def _rings(there: Bool[np.ndarray, "h w"], plane: RasterPlane, face: Bool[np.ndarray, "h w"] | None) -> list[Ring]:
    """Outlines of connected parts, along the cells' borders, from the largest.

    Args:
        there: Mask to outline.
        plane: The plane with its cells.
        face: The wall's face, which has to surround openings; openings that are nearly level rectangles are drawn as
            such. None if the parts are not openings.
    """
    cell = plane.lattice.cell_m
    kernel = _square(round(MIN_NOTCH_M / cell))
    mask = np.asarray(cv2.morphologyEx(there.astype(np.uint8), cv2.MORPH_OPEN, kernel))
    mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel))
    count, parts, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    sizes = stats[:, cv2.CC_STAT_AREA]
    rings = []
    for part in sorted(range(1, count), key=lambda part: (-int(sizes[part]), part)):
        if sizes[part] * cell**2 < MIN_AREA_M2:
            break
        left, top, width, height = (int(stats[part, k]) for k in range(4))
        own = parts[top : top + height, left : left + width] == part
        if face is not None and _enclosed(own, left, top, face) < MIN_ENCLOSED_SHARE:
            continue
        ring = _level_rectangle(own) if face is not None and own.mean() >= MIN_RECTANGLE_SHARE else _trace_outline(own)
        columns, rows = (ring + np.array([left, top])).T
        rings.append(np.column_stack([plane.lattice.east_m + columns * cell, plane.lattice.north_m - rows * cell]))
    return rings


def _enclosed(own: Bool[np.ndarray, "a b"], left: int, top: int, face: Bool[np.ndarray, "h w"]) -> float:
    """The share of cells around a part that are the wall's face."""
    reach = RIM_CELLS
    wide = np.pad(own, reach).astype(np.uint8)
    around = np.asarray(cv2.dilate(wide, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))) > wide
    there = np.pad(face, reach)[top : top + wide.shape[0], left : left + wide.shape[1]]
    return float(there[around].mean())


def _level_rectangle(own: Bool[np.ndarray, "h w"]) -> Ring:
    """The level rectangle whose sides are the medians of a part's ends over rows and columns."""
    height, width = own.shape
    rows, columns = own[own.any(axis=1)], own.T[own.any(axis=0)]
    left, right = np.median(rows.argmax(axis=1)), width - np.median(rows[:, ::-1].argmax(axis=1))
    top, bottom = np.median(columns.argmax(axis=1)), height - np.median(columns[:, ::-1].argmax(axis=1))
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


def _trace_outline(own: Bool[np.ndarray, "h w"]) -> Ring:
    """A part's simplified outline; cells are doubled so that it follows their borders instead of their centres."""
    fine = np.pad(np.kron(own.view(np.uint8), np.ones((2, 2), np.uint8)), 1)
    found, _ = cv2.findContours(fine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    longest = max(found, key=len)
    corners = np.asarray(cv2.approxPolyDP(longest, 2.0 * OUTLINE_TOLERANCE_CELLS, True)).reshape(-1, 2)
    return (corners - 0.5) / 2.0
