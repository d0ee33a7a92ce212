"""One-pass resampling of a photo from any camera into a pinhole camera, without aliasing."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float64, UInt8

MAX_SAMPLES = 16  # a side of a pixel; reductions by more are softened first
STRIP_PIXELS = 1 << 21  # samples held at a time
ONE_TO_ONE = 1.1  # up to this reduction one sample a pixel, interpolated by a cubic, is sharper than several


def resample(
    photo: UInt8[np.ndarray, "h w *channels"], source: pycolmap.Camera, target: pycolmap.Camera
) -> UInt8[np.ndarray, "th tw *channels"]:
    """What the target camera would have seen, standing and looking as the source did.

    Every pixel is the mean of samples spread over it, each interpolated in the full photo: an area filter through the
    distortion, with no intermediate picture. Bounds the memory by working on strips of rows.

    Args:
        photo: In the source camera's grid.
        source: Of any model.
        target: Pinhole.
    """
    if source.is_undistorted() and _same_view(source, target):
        if (source.width, source.height) == (target.width, target.height):
            return photo
        return np.asarray(cv2.resize(photo, (target.width, target.height), interpolation=cv2.INTER_AREA))
    reduction = _reduction(source, target)
    if reduction > MAX_SAMPLES:
        size = math.ceil(photo.shape[1] * MAX_SAMPLES / reduction), math.ceil(photo.shape[0] * MAX_SAMPLES / reduction)
        photo = np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA))
        source = pycolmap.Camera(source.todict())
        source.rescale(*size)
        reduction = _reduction(source, target)
    samples = 1 if reduction <= ONE_TO_ONE else min(MAX_SAMPLES, math.ceil(reduction))
    interpolation = cv2.INTER_CUBIC if samples == 1 else cv2.INTER_LINEAR
    result = np.empty((target.height, target.width, *photo.shape[2:]), np.uint8)
    rows = max(1, STRIP_PIXELS // (target.width * samples * samples))
    for top in range(0, target.height, rows):
        bottom = min(target.height, top + rows)
        x, y = _sample_places(source, target, top, bottom, samples)
        strip = cv2.remap(photo, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)
        if samples > 1:
            strip = cv2.resize(strip, (target.width, bottom - top), interpolation=cv2.INTER_AREA)
        result[top:bottom] = strip
    return result


def _same_view(source: pycolmap.Camera, target: pycolmap.Camera) -> bool:
    """Whether two pinhole cameras differ in size alone."""
    scaled = pycolmap.Camera(source.todict())
    scaled.rescale(target.width, target.height)
    intrinsics = [np.asarray(camera.calibration_matrix()) for camera in (scaled, target)]
    return bool(np.allclose(intrinsics[0], intrinsics[1], rtol=1e-9, atol=1e-6))


def _reduction(source: pycolmap.Camera, target: pycolmap.Camera) -> float:
    """Photo pixels a target pixel, a side, at the target's centre and corners: the largest."""
    width, height = target.width, target.height
    corners = np.array([[x, y] for x in (0.0, width / 2, width - 1.0) for y in (0.0, height / 2, height - 1.0)])
    here = _project(source, target, corners)
    steps = [_project(source, target, corners + step) - here for step in ([1.0, 0.0], [0.0, 1.0])]
    return float(max(np.nanmax(np.hypot(step[:, 0], step[:, 1])) for step in steps))


def _project(
    source: pycolmap.Camera, target: pycolmap.Camera, places: Float64[np.ndarray, "n 2"]
) -> Float64[np.ndarray, "n 2"]:
    """Pixels of the target camera in the source camera; the centre of the first pixel is (0.5, 0.5) in both."""
    rays = np.ones((len(places), 3))
    rays[:, 0] = (places[:, 0] - target.principal_point_x) / target.focal_length_x
    rays[:, 1] = (places[:, 1] - target.principal_point_y) / target.focal_length_y
    return np.asarray(source.img_from_cam(rays))


def _sample_places(
    source: pycolmap.Camera, target: pycolmap.Camera, top: int, bottom: int, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's maps of the samples of target rows ``top`` to ``bottom``: ((bottom-top)*samples, width*samples) each.

    The distortion is evaluated at the pixels' centres, one further on every side, and interpolated linearly between
    them, where it is as good as straight.
    """
    x, y = np.meshgrid(np.arange(-1, target.width + 1) + 0.5, np.arange(top - 1, bottom + 1) + 0.5)
    places = _project(source, target, np.column_stack([x.ravel(), y.ravel()])) - 0.5  # OpenCV's first centre is 0, 0
    maps = []
    for axis in (0, 1):
        grid = places[:, axis].reshape(x.shape).astype(np.float32)
        if samples > 1:
            size = grid.shape[1] * samples, grid.shape[0] * samples
            grid = cv2.resize(grid, size, interpolation=cv2.INTER_LINEAR)
        maps.append(np.ascontiguousarray(grid[samples:-samples, samples:-samples]))
    return maps[0], maps[1]
