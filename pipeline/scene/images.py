"""Pictures of a dataset as arrays, in their stored grid: EXIF orientation is never applied."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.scene.dataset import View

Pixels = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]


def read_image(path: Path, flags: int) -> Pixels:
    """Decode an image file in its stored grid.

    Args:
        path: A JPEG or PNG that `undistort` left.
        flags: OpenCV's IMREAD flags.

    Raises:
        StageError: if it cannot be read.
    """
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise StageError(f"{path.name} of the dataset cannot be read: {error.strerror}.") from error
    pixels = cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
    if pixels is None:
        raise StageError(
            f"{path.name} of the dataset is no readable image.",
            hint="Run again with --rerun-from undistort.",
        )
    return np.asarray(pixels, np.uint8)


def load_colour(view: View) -> Pixels:
    """A view's photo, (h, w, 3) RGB, 8 bits.

    Raises:
        StageError: if it cannot be read or is not of its camera's size.
    """
    pixels = np.ascontiguousarray(read_image(view.image_path, cv2.IMREAD_COLOR)[:, :, ::-1])
    _check_size(view, pixels, view.image_path)
    return pixels


def load_mask(view: View) -> Mask | None:
    """A view's mask, (h, w), True where the photo counts; None where it has none."""
    if view.mask_path is None:
        return None
    pixels = read_image(view.mask_path, cv2.IMREAD_GRAYSCALE)
    _check_size(view, pixels, view.mask_path)
    return np.asarray(pixels > 0)


def _check_size(view: View, pixels: Pixels, path: Path) -> None:
    height, width = pixels.shape[:2]
    if (width, height) != (view.camera.width, view.camera.height):
        raise StageError(
            f"{path.name} is {width}×{height} pixels, but its camera says {view.camera.width}×{view.camera.height}."
        )
