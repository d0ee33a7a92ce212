"""Measure how far the edges of roofs in an orthophoto are from the true ones.

At places along the true roof outline where the true image has its strongest edge on the outline, the orthophoto's
strongest edge is searched along the same normal. Leaning walls, and roofs that are doubled or torn, move it.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from tables import Row

REACH_PX = 12  # to each side of the true edge
STEPS_A_PX = 4
SMOOTH_PX = 0.7  # sigma of the blur before edges are searched: suppresses the noise of single pixels
ALONG_PX = 2.0  # between places on the outline
TRUE_WITHIN_PX = 0.75  # largest distance of the true image's strongest edge from the outline
MIN_STEP = 12.0  # grey levels per pixel: a roof that looks like its surroundings has no measurable edge
MIN_SHARE = 0.3  # least strength of an edge over the true edge's: anything weaker counts as missing
OUTSTANDING = 1.5  # times the strongest other true edge along the line
MAX_EDGE_OFFSET_PX = 2.5  # within this distance it is the same edge
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
OUTLINE_SIGMA_PX = 2.0  # blur of the mask from which the border's direction and subpixel position are computed


def outline(roofs: Bool[np.ndarray, "h w"]) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 2"]]:
    """Return places on a mask's border (column, row; the first pixel's centre is (0, 0)), and unit normals outwards."""
    soft = cv2.GaussianBlur(roofs.astype(np.float32), (0, 0), OUTLINE_SIGMA_PX)
    down, across = np.gradient(soft)
    found, normals = [], []
    contours, _ = cv2.findContours(roofs.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    for contour in contours:
        places = contour[:: max(1, round(ALONG_PX)), 0].astype(np.intp)
        column, row = places.T
        slope = np.stack([across[row, column], down[row, column]], axis=1).astype(np.float64)
        length = np.linalg.norm(slope, axis=1)
        good = length > 1e-3
        normal = -slope[good] / length[good, None]
        to_edge = (soft[row, column][good] - 0.5) / length[good]  # a Newton step to the border between pixels
        found.append(places[good] + normal * np.clip(to_edge, -1.0, 1.0)[:, None])
        normals.append(normal)
    if not found:
        return np.zeros((0, 2)), np.zeros((0, 2))
    return np.concatenate(found), np.concatenate(normals)


def strengths(
    picture: UInt8[np.ndarray, "h w 3"], places: Float64[np.ndarray, "n 2"], normals: Float64[np.ndarray, "n 2"]
) -> Float32[np.ndarray, "n k"]:
    """Return the brightness gradient across the outline, along a line through each place; grey levels per pixel."""
    grey = cv2.GaussianBlur(picture.astype(np.float32) @ LUMA, (0, 0), SMOOTH_PX)
    offsets = _offsets()
    lines = (places[:, None] + normals[:, None] * offsets[:, None]).astype(np.float32)
    values = cv2.remap(grey, lines[..., 0], lines[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(np.abs(np.gradient(values, 1.0 / STEPS_A_PX, axis=1)), np.float32)


def _offsets() -> Float64[np.ndarray, " k"]:
    return np.arange(-REACH_PX * STEPS_A_PX, REACH_PX * STEPS_A_PX + 1) / STEPS_A_PX


def visible_edges(strength: Float32[np.ndarray, "n k"]) -> Bool[np.ndarray, " n"]:
    """Return the places where the true image has a single prominent edge, on the outline."""
    offsets = _offsets()
    best = strength.argmax(axis=1)
    peak = strength.max(axis=1)
    other = np.where(np.abs(offsets[None] - offsets[best][:, None]) > MAX_EDGE_OFFSET_PX, strength, 0.0).max(axis=1)
    on_line = np.abs(offsets[best]) <= TRUE_WITHIN_PX
    return np.asarray(on_line & (peak >= MIN_STEP) & (peak >= OUTSTANDING * other))


def edge_distances(
    picture: UInt8[np.ndarray, "h w 3"],
    truth: UInt8[np.ndarray, "h w 3"],
    roofs: Bool[np.ndarray, "h w"],
    counts: Bool[np.ndarray, "h w"],
) -> Float64[np.ndarray, " n"]:
    """Return the pixels from true edges to the orthophoto's, infinite where it has none, at each measurable place.

    Args:
        picture: The orthophoto, black where it has nothing.
        truth: The true picture on the same grid.
        roofs: Mask of the true roofs.
        counts: Mask of the places that count.
    """
    places, normals = outline(roofs)
    height, width = roofs.shape
    column, row = np.round(places).astype(np.intp).T
    inside = (np.minimum(column, row) >= REACH_PX) & (column < width - REACH_PX) & (row < height - REACH_PX)
    inside[inside] &= counts[row[inside], column[inside]]
    places, normals = places[inside], normals[inside]
    true = strengths(truth, places, normals)
    visible = visible_edges(true)
    found = strengths(picture, places[visible], normals[visible])
    offsets = _offsets()
    shift = offsets[true[visible].argmax(axis=1)]  # the true image's own edge, to a quarter pixel
    apart = np.abs(offsets[found.argmax(axis=1)] - shift)
    lost = found.max(axis=1) < MIN_SHARE * true[visible].max(axis=1)
    return np.asarray(np.where(lost, np.inf, apart))


def edge_figures(distances_px: Float64[np.ndarray, " n"]) -> Row:
    """Return ``edges`` (places), ``median`` and ``p95`` of the distances, and the share ``lost``."""
    row: Row = {"edges": int(distances_px.size)}
    if distances_px.size == 0:
        return row
    quantiles = np.quantile(distances_px, [0.5, 0.95], method="higher")
    median, p95 = (float(q) if np.isfinite(q) else None for q in quantiles)
    return row | {"median": median, "p95": p95, "lost": float((~np.isfinite(distances_px)).mean())}
