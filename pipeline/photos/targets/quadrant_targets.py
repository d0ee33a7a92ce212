"""Detect the black-and-white quadrant targets that surveyors lay out or paint, with sub-pixel centres.

Where two dark and two bright sectors meet, brightness has a saddle: the determinant of its Hessian is negative there
(Sinzinger, "A model-based approach to junction detection using radial energy", 2008, and Geiger et al., "Automatic
camera and range sensor calibration using a single shot", ICRA 2012, look for such corners on calibration boards). Few
saddles pass the next test: on a ring around them, brightness crosses its mean four times and is point-symmetric. To
these, two blurred lines through one point are fitted by least squares, within the target's extent, which the contrast
across the lines determines. Anything that is not a target fails one of these tests.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatpipe.pipeline.photos.targets.quadrant_lines import (
    RING_PX,
    RING_STEPS,
    LinePair,
    correlation,
    fit_near,
    fit_within,
    model,
    pixels_within,
    sample_bilinearly,
    sample_ring,
)

SADDLE_SIGMA_PX = 1.0  # a smaller one admits noise, a larger one loses targets of 12 px seen obliquely
MIN_CONTRAST = 40.0  # white minus black, grey levels of 255
BLURRED_SIGMA_PX = 1.5  # largest blur of a saddle that is still found: lens, motion and our smoothing together
MIN_SADDLE = MIN_CONTRAST / (np.pi * BLURRED_SIGMA_PX**2)  # a quadrant's is contrast / (π σ²) at its centre
MAX_SADDLES = 100_000  # per tile, the strongest
RINGS_PX = (2.0, RING_PX)
MIN_RING_SYMMETRY = 0.75  # correlation of a ring with itself, rotated by 180°
RING_CONTRAST = 0.65  # contrast of a ring over MIN_CONTRAST: blur reduces it near the centre
# darkest over brightest on a ring: looser than MAX_DARK_RATIO, since blur mixes them near the centre
MAX_RING_DARK_RATIO = 0.7
ACROSS_PX = 1.5  # distance from a line at which its two sides are sampled
REACH_PX = 64  # along a line; larger targets are followed only this far
MIN_REACH_PX = 2.5
MIN_REACH_RATIO = 0.55  # smallest ratio of a line's reaches in its two directions
STEP_PX = 0.5
TILE_PX, OVERLAP_PX = 2048, 2 * REACH_PX + 16  # large images are searched in tiles, to save memory
MIN_EDGE_CONTRAST_SHARE = 0.5  # difference across a line over the contrast, below which the line has ended
FIT_SHARE = 0.7  # radius of the fitted pixels over the lines' reach: inside four triangles, too
MIN_FIT_PX = 2.2
LARGEST_FIT_PX = 14.0  # more pixels add hardly any information
MAX_MOVED_PX = 2.5  # distance of the fitted centre from the first fit's
APART_PX = 3.0  # one target has one centre
NEAR_CORRELATION = 0.9  # correlation with the first fit's model below which a candidate is dropped
MIN_CORRELATION = 0.975  # correlation of an isolated target with its model: a shadow's edge may cross it
MIN_CORRELATION_AMONG_SIMILAR = 0.986  # correlation required among similar patterns, as in gravel, leaves and façades
AROUND_PX = (2.0, 16.0)  # distances beyond a target's corners that are searched for other saddles
MAX_NEIGHBOUR_SADDLE_SHARE = 0.5  # strongest saddle around an isolated target over the target's own
OWN_PX = 1.6  # radius around a target's centre in which saddles are its own
MIN_ANGLE_DEG = 18.0  # between the lines
MAX_DARK_RATIO = 0.45  # brightness of a target's dark sectors over its bright ones
MIN_NEUTRAL = 0.75  # white minus black in the colour channel where it is smallest over that where it is largest
MAX_BLUR_PX = 1.6
# A disc of 12 px has the area of a square of 10.6 px, and blur takes some of it. Smaller ones have so few pixels that
# gravel correlates with 0.99.
MIN_SIZE_PX = 10.0
MAX_UNEVENNESS_SHARE = 0.15  # difference of the two dark sectors, or of the two bright ones, over the contrast


@dataclass(frozen=True)
class QuadrantTarget:
    """A detected target.

    Attributes:
        x: Of its centre, pixels; (0, 0) is the top-left corner of the first pixel.
        y: Likewise.
        size_px: Square root of the area that its lines span, pixels.
        sigma_px: Standard deviation of x and y estimated by the fit, pixels.
        score: Correlation of the pixels with the fitted pattern.
    """

    x: float
    y: float
    size_px: float
    sigma_px: float
    score: float


def find_quadrant_targets(pixels: UInt8[np.ndarray, "h w 3"]) -> list[QuadrantTarget]:
    """Find quadrant targets in an image.

    Args:
        pixels: RGB.

    Returns:
        The targets, sorted from top to bottom.
    """
    found: list[QuadrantTarget] = []
    for top in range(0, max(pixels.shape[0] - OVERLAP_PX, 1), TILE_PX - OVERLAP_PX):
        for left in range(0, max(pixels.shape[1] - OVERLAP_PX, 1), TILE_PX - OVERLAP_PX):
            for target in _search_tile(np.ascontiguousarray(pixels[top : top + TILE_PX, left : left + TILE_PX])):
                there = replace(target, x=target.x + left, y=target.y + top)
                if all(np.hypot(there.x - other.x, there.y - other.y) > APART_PX for other in found):
                    found.append(there)
    return sorted(found, key=lambda target: (target.y, target.x))


def _search_tile(pixels: UInt8[np.ndarray, "h w 3"]) -> list[QuadrantTarget]:
    """Find the targets in a tile of an image."""
    if min(pixels.shape[:2]) < 4 * int(RINGS_PX[-1]):
        return []
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    places = _saddles(grey)
    values, scores = fit_near(grey, places[_has_quadrant_ring(grey, places)])
    dark = (values[:, 4] - np.abs(values[:, 5])) / np.maximum(values[:, 4] + np.abs(values[:, 5]), 1e-9)
    worth = (scores > NEAR_CORRELATION) & (dark < MAX_RING_DARK_RATIO) & (2.0 * np.abs(values[:, 5]) > MIN_CONTRAST)
    found: list[QuadrantTarget] = []
    for k in np.flatnonzero(worth).tolist():
        x, y = (values[k, :2] + 0.5).tolist()
        if all(np.hypot(x - other.x, y - other.y) > APART_PX for other in found):
            target = _fit_target(grey, pixels, LinePair(values[k]))
            if target is not None:
                found.append(target)
    return found


def _saddles(grey: Float32[np.ndarray, "h w"]) -> Float64[np.ndarray, "n 2"]:
    """Find positions of strong saddles, the strongest first; (0, 0) is the first pixel's centre."""
    smooth = cv2.GaussianBlur(grey, (0, 0), SADDLE_SIGMA_PX)
    saddle = _saddle_strengths(smooth)
    largest = cv2.dilate(saddle, np.ones((3, 3), np.uint8))
    rows, columns = np.nonzero((saddle >= largest) & (saddle > MIN_SADDLE**2))
    border = int(np.ceil(RINGS_PX[-1])) + 1
    height, width = grey.shape
    inside = (rows >= border) & (rows < height - border) & (columns >= border) & (columns < width - border)
    rows, columns = rows[inside], columns[inside]
    order = np.argsort(-saddle[rows, columns], kind="stable")[:MAX_SADDLES]
    rows, columns = rows[order], columns[order]
    return np.asarray(np.stack([columns, rows], axis=1) + _to_level(smooth, rows, columns))


def _saddle_strengths(smooth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """The negative determinant of the Hessian."""
    # The kernels' scale is too large by 2 to the power of their order.
    xx, yy = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, scale=0.25), cv2.Sobel(smooth, cv2.CV_32F, 0, 2, scale=0.25)
    saddle = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, scale=0.25)
    cv2.multiply(saddle, saddle, saddle)
    cv2.multiply(xx, yy, xx)
    cv2.subtract(saddle, xx, saddle)
    return np.asarray(saddle)


def _to_level(
    smooth: Float32[np.ndarray, "h w"], rows: Int64[np.ndarray, " n"], columns: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 2"]:
    """Offsets from pixels to the stationary points of brightness (one Newton step), a pixel at most."""
    patch = np.stack([[smooth[rows + y, columns + x] for x in (-1, 0, 1)] for y in (-1, 0, 1)]).astype(np.float64)
    gx, gy = (patch[1, 2] - patch[1, 0]) / 2.0, (patch[2, 1] - patch[0, 1]) / 2.0
    xx, yy = patch[1, 2] + patch[1, 0] - 2.0 * patch[1, 1], patch[2, 1] + patch[0, 1] - 2.0 * patch[1, 1]
    xy = (patch[2, 2] + patch[0, 0] - patch[2, 0] - patch[0, 2]) / 4.0
    det = np.minimum(xx * yy - xy * xy, -1e-6)
    return np.asarray(np.clip(np.stack([(xy * gy - yy * gx) / det, (xy * gx - xx * gy) / det], axis=1), -1.0, 1.0))


def _has_quadrant_ring(grey: Float32[np.ndarray, "h w"], places: Float64[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Whether places have two bright and two dark sectors around them, point-symmetrically."""
    good = np.ones(len(places), dtype=bool)
    for radius in RINGS_PX:
        chosen = np.flatnonzero(good)
        if len(chosen) == 0:
            break
        ring = sample_ring(grey, places[chosen], radius)
        low, high = ring.min(axis=1), ring.max(axis=1)
        above = ring > ((low + high) / 2.0)[:, None]
        crossings = (above != np.roll(above, 1, axis=1)).sum(axis=1)
        centred = ring - ring.mean(axis=1, keepdims=True)
        power = (centred**2).sum(axis=1)
        alike = (centred * np.roll(centred, RING_STEPS // 2, axis=1)).sum(axis=1)
        good[chosen] = (
            (crossings == 4)
            & (high - low > RING_CONTRAST * MIN_CONTRAST)
            & (low < MAX_RING_DARK_RATIO * high)
            & (alike > MIN_RING_SYMMETRY * np.maximum(power, 1e-6))
        )
    return good


def _fit_target(
    grey: Float32[np.ndarray, "h w"], pixels: UInt8[np.ndarray, "h w 3"], start: LinePair
) -> QuadrantTarget | None:
    """Fit the target that starts from these lines; None if there is none."""
    reach = _reach(grey, start)
    lines = None if reach is None else fit_within(grey, start, _fit_radius(reach))
    if lines is None or np.hypot(*(lines.values[:2] - start.values[:2])) > MAX_MOVED_PX:
        return None
    reach = _reach(grey, lines)
    return None if reach is None else _check_target(grey, pixels, lines, reach)


def _fit_radius(reach: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, " 2"]:
    return np.clip(FIT_SHARE * reach, MIN_FIT_PX, LARGEST_FIT_PX)


def _reach(grey: Float32[np.ndarray, "h w"], lines: LinePair) -> Float64[np.ndarray, " 2"] | None:
    """Extent of the contrast along each line, the mean of both directions; None if it does not fit a target."""
    cx, cy, contrast = lines.values[0], lines.values[1], 2.0 * abs(lines.values[5])
    if contrast < MIN_CONTRAST:
        return None
    steps = np.arange(1.0, REACH_PX, STEP_PX)
    reaches = []
    directions = lines.directions()
    sine = abs(float(np.linalg.det(directions)))
    if sine < np.sin(np.radians(MIN_ANGLE_DEG)):
        return None
    for k in (0, 1):
        along, aside = directions[k], directions[1 - k] * (ACROSS_PX / sine)
        ways = []
        for way in (1.0, -1.0):
            x, y = cx + way * steps * along[0], cy + way * steps * along[1]
            sides = sample_bilinearly(
                grey,
                np.stack([x + aside[0], x - aside[0]]).astype(np.float32),
                np.stack([y + aside[1], y - aside[1]]).astype(np.float32),
            )
            # Positive as long as the sides match the sectors at the centre.
            sign = way * np.sign(lines.values[5]) * _side(directions, k)
            difference = sign * (sides[0] - sides[1]) / contrast
            ended = np.flatnonzero(difference[2:] < MIN_EDGE_CONTRAST_SHARE)
            end = len(steps) if len(ended) == 0 else int(ended[0]) + 2
            ways.append(float(steps[min(end, len(steps) - 1)]))
        if min(ways) < MIN_REACH_RATIO * max(ways) or min(ways) < MIN_REACH_PX:
            return None
        reaches.append(sum(ways) / 2.0)
    return np.array(reaches)


def _side(directions: Float64[np.ndarray, "2 2"], k: int) -> float:
    """The sign of the model's product ahead on a line, on the side to which the other line points."""
    ahead = directions[k] + 1e-3 * directions[1 - k]
    u = -directions[0, 1] * ahead[0] + directions[0, 0] * ahead[1]
    v = directions[1, 1] * ahead[0] - directions[1, 0] * ahead[1]
    return float(np.sign(u * v))


def _check_target(
    grey: Float32[np.ndarray, "h w"],
    pixels: UInt8[np.ndarray, "h w 3"],
    lines: LinePair,
    reach: Float64[np.ndarray, " 2"],
) -> QuadrantTarget | None:
    """Return the target if its pixels pass the tests, else None."""
    around = pixels_within(grey, lines, _fit_radius(reach))
    if around is None or lines.values[6] > MAX_BLUR_PX:
        return None
    x, y, seen = around
    predicted, derivatives = (v[0] for v in model(lines.values[None], x[None], y[None]))
    score = float(correlation(seen[None], predicted[None])[0])
    middle, half = float(lines.values[4]), abs(float(lines.values[5]))
    if not _is_even(lines, x, y, seen):
        return None
    if (
        score < MIN_CORRELATION
        or middle - half > MAX_DARK_RATIO * (middle + half)
        or not _is_neutral(pixels, x, y, predicted)
    ):
        return None
    variance = float(((seen - predicted) ** 2).sum()) / max(len(seen) - 7, 1)
    covariance = variance * np.linalg.pinv(derivatives.T @ derivatives)
    sigma = float(np.sqrt(max(np.trace(covariance[:2, :2]) / 2.0, 0.0)))
    directions = lines.directions()
    area = 4.0 * reach[0] * reach[1] * abs(float(np.linalg.det(directions)))
    cx, cy = lines.values[:2].tolist()
    size = float(np.sqrt(area))
    if size < MIN_SIZE_PX or (score < MIN_CORRELATION_AMONG_SIMILAR and not _is_isolated(grey, cx, cy, size)):
        return None
    return QuadrantTarget(cx + 0.5, cy + 0.5, size, sigma, score)


def _is_isolated(grey: Float32[np.ndarray, "h w"], cx: float, cy: float, size_px: float) -> bool:
    """Whether no saddle around a target is nearly as strong as its centre."""
    corners = size_px / np.sqrt(2.0)
    reach = int(np.ceil(corners + AROUND_PX[1]))
    left, top = max(int(cx) - reach, 0), max(int(cy) - reach, 0)
    piece = grey[top : int(cy) + reach + 1, left : int(cx) + reach + 1]
    strengths = _saddle_strengths(cv2.GaussianBlur(piece, (0, 0), SADDLE_SIGMA_PX))
    row, column = np.indices(piece.shape)
    away = np.hypot(column + left - cx, row + top - cy)
    around = (away > corners + AROUND_PX[0]) & (away < corners + AROUND_PX[1])
    if not around.any():
        return False
    return bool(strengths[around].max() < MAX_NEIGHBOUR_SADDLE_SHARE**2 * strengths[away < OWN_PX].max())


def _is_even(
    lines: LinePair, x: Float64[np.ndarray, " n"], y: Float64[np.ndarray, " n"], seen: Float64[np.ndarray, " n"]
) -> bool:
    """Whether opposite sectors are equally bright: those of cars and their shadows are not."""
    cx, cy, first, second, _, contrast = lines.values[:6].tolist()
    u = -np.sin(first) * (x - cx) + np.cos(first) * (y - cy) > 0.0
    v = np.sin(second) * (x - cx) - np.cos(second) * (y - cy) > 0.0
    sectors = [seen[(u == a) & (v == b)] for a in (False, True) for b in (False, True)]
    if min(len(sector) for sector in sectors) == 0:
        return False
    means = [float(sector.mean()) for sector in sectors]
    off = max(abs(means[0] - means[3]), abs(means[1] - means[2]))
    return bool(off < MAX_UNEVENNESS_SHARE * 2.0 * abs(contrast))


def _is_neutral(
    pixels: UInt8[np.ndarray, "h w 3"],
    x: Float64[np.ndarray, " n"],
    y: Float64[np.ndarray, " n"],
    predicted: Float64[np.ndarray, " n"],
) -> bool:
    """Whether the difference between bright and dark is neutral in colour."""
    colours = pixels[y.astype(np.int64), x.astype(np.int64)].astype(np.float64)
    bright = predicted > predicted.mean()
    if not bright.any() or bright.all():
        return False
    difference = colours[bright].mean(axis=0) - colours[~bright].mean(axis=0)
    return float(difference.min()) > MIN_NEUTRAL * float(difference.max())
