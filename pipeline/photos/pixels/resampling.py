"""One-pass resampling of a photo from any camera into a pinhole camera, without aliasing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, UInt8

MAX_SAMPLES = 16  # per side of a pixel; for larger reductions, the photo is reduced first
STRIP_PIXELS = 1 << 21  # samples held at a time
SINGLE_PIXELS = 1 << 18  # with one sample per pixel: strips are then independent, and the result is identical
PROJECTED = 1 << 16  # places projected at a time, in double precision
MARGIN = 3  # rows around those that samples lie in: a cubic uses one before and two after
ONE_TO_ONE = 1.1  # up to this reduction, one cubic sample per pixel is sharper than several
KEPT_PIXELS = 1 << 23  # largest target, in pixels, whose sample places are kept for all photos of a camera: 64 MB

Rows = UInt8[np.ndarray, "rows w *channels"]
Places = Float32[np.ndarray, "2 rows columns"]
"""x and y in the photo, as OpenCV counts them, of the centres of a target's pixels and of one more on every side."""


def kept_places(source: pycolmap.Camera, target: pycolmap.Camera) -> Places | None:
    """What ``resample`` needs of two cameras, for all photos that share them; None if too large, or if it needs none.

    Args:
        source: Of any model.
        target: Pinhole.
    """
    if _is_filtered_whole(source, target) or target.width * target.height > KEPT_PIXELS:
        return None
    return _places(source, target, 0, target.height)


def resample(
    photo: UInt8[np.ndarray, "h w *channels"],
    source: pycolmap.Camera,
    target: pycolmap.Camera,
    places: Places | None = None,
) -> UInt8[np.ndarray, "th tw *channels"]:
    """Resample a photo to what the target camera would have seen from the same pose.

    Every pixel is the mean of samples spread over it, each interpolated in the full photo: an area filter through the
    distortion, with no intermediate image. Works on strips of rows to bound memory.

    Args:
        photo: In the source camera's grid.
        source: Of any model.
        target: Pinhole.
        places: ``kept_places`` of the two cameras, which saves time and changes nothing.
    """
    if _is_plain(source, target):
        if (source.width, source.height) == (target.width, target.height):
            return photo
        return np.asarray(cv2.resize(photo, (target.width, target.height), interpolation=cv2.INTER_AREA))
    reduction = _reduction(source, target)
    if reduction > MAX_SAMPLES:
        size = math.ceil(photo.shape[1] * MAX_SAMPLES / reduction), math.ceil(photo.shape[0] * MAX_SAMPLES / reduction)
        photo = np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA))
        source = pycolmap.Camera(source.todict())
        source.rescale(*size)
    result = np.empty((target.height, target.width, *photo.shape[2:]), np.uint8)
    top = 0
    for strip in _strips(lambda first, last: photo[first:last], source, target, places):
        result[top : top + len(strip)] = strip
        top += len(strip)
    return result


def resampled_strips(
    rows_of: Callable[[int, int], Rows],
    source: pycolmap.Camera,
    target: pycolmap.Camera,
    places: Places | None = None,
) -> Iterator[UInt8[np.ndarray, "rows tw 3"]]:
    """Yield the result of ``resample`` strip by strip, from the top, without an array of the photo or the result.

    If the whole photo is reduced by one filter, the result is one strip.

    Args:
        rows_of: Returns the photo's rows from the first up to the second argument, in the source camera's grid.
        source: Of any model.
        target: Pinhole.
        places: As for ``resample``.
    """
    if _is_filtered_whole(source, target):
        yield resample(rows_of(0, source.height), source, target)
    else:
        yield from _strips(rows_of, source, target, places)


def _is_plain(source: pycolmap.Camera, target: pycolmap.Camera) -> bool:
    """Whether a photo is only reduced."""
    return source.is_undistorted() and _same_view(source, target)


def _is_filtered_whole(source: pycolmap.Camera, target: pycolmap.Camera) -> bool:
    """Whether one filter reduces the whole photo at first."""
    return _is_plain(source, target) or _reduction(source, target) > MAX_SAMPLES


def _strips(
    rows_of: Callable[[int, int], Rows], source: pycolmap.Camera, target: pycolmap.Camera, places: Places | None
) -> Iterator[UInt8[np.ndarray, "rows tw *channels"]]:
    reduction = _reduction(source, target)
    samples = 1 if reduction <= ONE_TO_ONE else min(MAX_SAMPLES, math.ceil(reduction))
    interpolation = cv2.INTER_CUBIC if samples == 1 else cv2.INTER_LINEAR
    held = SINGLE_PIXELS if samples == 1 else STRIP_PIXELS
    rows = max(1, held // (target.width * samples * samples))
    for top in range(0, target.height, rows):
        bottom = min(target.height, top + rows)
        here = _places(source, target, top, bottom) if places is None else places[:, top : bottom + 2]
        x, y = _sample_places(here, samples)
        first, last = _reach(y, source.height)
        y -= np.float32(first)  # exact: a whole number is subtracted from a larger one, or zero
        strip = cv2.remap(rows_of(first, last), x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)
        if samples > 1:
            strip = cv2.resize(strip, (target.width, bottom - top), interpolation=cv2.INTER_AREA)
        yield np.asarray(strip)


def _reach(y: np.ndarray, height: int) -> tuple[int, int]:
    """The first row of the photo that samples at ``y`` use, and the one after the last; all if one is not finite."""
    low, high = float(y.min()), float(y.max())
    if not (math.isfinite(low) and math.isfinite(high)):
        return 0, height
    first = min(max(math.floor(low) - MARGIN, 0), height - 1)
    return first, max(min(math.ceil(high) + MARGIN + 1, height), first + 1)


def _same_view(source: pycolmap.Camera, target: pycolmap.Camera) -> bool:
    """Whether two pinhole cameras differ only in size."""
    scaled = pycolmap.Camera(source.todict())
    scaled.rescale(target.width, target.height)
    intrinsics = [np.asarray(camera.calibration_matrix()) for camera in (scaled, target)]
    return bool(np.allclose(intrinsics[0], intrinsics[1], rtol=1e-9, atol=1e-6))


def _reduction(source: pycolmap.Camera, target: pycolmap.Camera) -> float:
    """Largest number of photo pixels per target pixel, linear, at the target's centre, edge midpoints and corners."""
    width, height = target.width, target.height
    corners = np.array([[x, y] for x in (0.0, width / 2, width - 1.0) for y in (0.0, height / 2, height - 1.0)])
    here = _project(source, target, corners)
    steps = [_project(source, target, corners + step) - here for step in ([1.0, 0.0], [0.0, 1.0])]
    return float(max(np.nanmax(np.hypot(step[:, 0], step[:, 1])) for step in steps))


def _project(
    source: pycolmap.Camera, target: pycolmap.Camera, places: Float64[np.ndarray, "n 2"]
) -> Float64[np.ndarray, "n 2"]:
    """Map pixels of the target camera to the source camera; the first pixel's centre is (0.5, 0.5) in both."""
    rays = np.ones((len(places), 3))
    rays[:, 0] = (places[:, 0] - target.principal_point_x) / target.focal_length_x
    rays[:, 1] = (places[:, 1] - target.principal_point_y) / target.focal_length_y
    return np.asarray(source.img_from_cam(rays))


def _places(source: pycolmap.Camera, target: pycolmap.Camera, top: int, bottom: int) -> Places:
    """Places of target rows ``top`` to ``bottom``; a pixel's do not depend on the rows asked for."""
    wide, high = target.width + 2, bottom - top + 2
    grids = np.empty((2, high, wide), np.float32)
    at_once = max(1, PROJECTED // wide)
    for row in range(0, high, at_once):
        here = np.arange(row, min(high, row + at_once))
        x, y = np.meshgrid(np.arange(-1, wide - 1) + 0.5, here + (top - 1) + 0.5)
        places = (
            _project(source, target, np.column_stack([x.ravel(), y.ravel()])) - 0.5
        )  # OpenCV's first centre is 0, 0
        grids[:, here] = places.T.reshape(2, len(here), wide)
    return grids


def _sample_places(places: Places, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's maps of the samples of target rows, the caller's own: (rows*samples, width*samples) each.

    The distortion is evaluated at the pixels' centres, plus one pixel on every side, and interpolated linearly between
    them, where it is practically linear.
    """
    maps = []
    for grid in places:
        if samples > 1:
            size = grid.shape[1] * samples, grid.shape[0] * samples
            finer = np.asarray(cv2.resize(grid, size, interpolation=cv2.INTER_LINEAR))
        else:
            finer = grid.copy()  # the caller moves the maps, and these places may be kept
        maps.append(finer[samples:-samples, samples:-samples])
    return maps[0], maps[1]
