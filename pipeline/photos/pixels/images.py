"""Read a dataset's images as arrays, in their stored grid: EXIF orientation is never applied."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.geometry.camera import Camera, reduced_size
from splatpipe.pipeline.photos.pixels.dataset import View

Pixels = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]


def read_image(path: Path, flags: int) -> Pixels:
    """Decode an image file in its stored grid.

    Args:
        path: A JPEG or PNG that `undistort` wrote.
        flags: OpenCV's IMREAD flags.

    Raises:
        StageError: if it cannot be read.
    """
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise StageError(
            f"{path.name} of the dataset cannot be read: {error.strerror}.",
            hint="Run again with --rerun-from undistort.",
        ) from error
    pixels = cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
    if pixels is None:
        raise StageError(
            f"{path.name} of the dataset is no readable image.",
            hint="Run again with --rerun-from undistort.",
        )
    return np.asarray(pixels, np.uint8)


def load_colour(view: View) -> Pixels:
    """Read a view's photo, (h, w, 3) RGB, 8 bits.

    Raises:
        StageError: if it cannot be read or is not of its camera's size.
    """
    pixels = read_image(view.image_path, cv2.IMREAD_COLOR_RGB)
    _check_size(view, pixels, view.image_path)
    return pixels


def load_mask(view: View) -> Mask | None:
    """Read a view's mask, (h, w), True where the photo counts; None if it has none."""
    return None if view.mask_path is None else _load_mask(view, view.mask_path)


def reduced_sky(view: View, max_megapixels: float) -> Mask | None:
    """Read a view's sky mask, (h, w), at the size of ``reduced_view``, True in the sky; None if it has none."""
    if view.sky_path is None:
        return None
    camera = reduced_camera(view.camera, max_megapixels)
    return reduced_mask(_load_mask(view, view.sky_path), (camera.width, camera.height))


def reduced_camera(camera: Camera, max_megapixels: float | None, level: int = 0) -> Camera:
    """The camera of ``reduced_view``, without reading the photo.

    Args:
        camera: In the dataset's grid.
        max_megapixels: Limit of the size, rounded as `undistort` does; None for the dataset's own size.
        level: How often that size is halved, rounded down, at least 1 pixel a side.
    """
    width, height = camera.width, camera.height
    if max_megapixels is not None:
        width, height = reduced_size(width, height, max_megapixels)
    size = (max(1, width >> level), max(1, height >> level))
    return camera if size == (camera.width, camera.height) else camera.scaled(*size)


def reduced_view(view: View, max_megapixels: float | None, level: int = 0) -> tuple[Camera, Pixels, Mask | None]:
    """Read a view at the size for training or evaluation, reduced from the dataset's photo by one area filter.

    Args:
        view: Of the dataset.
        max_megapixels: As for ``reduced_camera``.
        level: As for ``reduced_camera``.

    Returns:
        Its camera, its photo (h, w, 3), and its mask (h, w) or None; a pixel counts if all that it covers do.

    Raises:
        StageError: if the photo or its mask cannot be read or is not of its camera's size.
    """
    (reduced,) = reduced_views(view, max_megapixels, [level])
    return reduced


def reduced_views(
    view: View, max_megapixels: float | None, levels: Sequence[int]
) -> Iterator[tuple[Camera, Pixels, Mask | None]]:
    """Yield ``reduced_view`` at several levels from one decode.

    Raises:
        StageError: as ``reduced_view``.
    """
    colour, mask = load_colour(view), load_mask(view)
    for level in levels:
        camera = reduced_camera(view.camera, max_megapixels, level)
        if camera is view.camera:
            yield camera, colour, mask
            continue
        size = (camera.width, camera.height)
        smaller = np.asarray(cv2.resize(colour, size, interpolation=cv2.INTER_AREA), np.uint8)
        yield camera, smaller, None if mask is None else reduced_mask(mask, size)


def _load_mask(view: View, path: Path) -> Mask:
    pixels = read_image(path, cv2.IMREAD_GRAYSCALE)
    _check_size(view, pixels, path)
    return np.asarray(pixels > 0)


def reduced_mask(mask: Mask, size: tuple[int, int]) -> Mask:
    """Reduce a mask to (width, height): True where all pixels covered are True."""
    # Not tested for a share of 1: OpenCV's weights may add up to only 0.999, but a sum of zeros is exactly zero.
    return np.asarray(cv2.resize((~mask).astype(np.float32), size, interpolation=cv2.INTER_AREA) == 0.0)


def _check_size(view: View, pixels: Pixels, path: Path) -> None:
    height, width = pixels.shape[:2]
    if (width, height) != (view.camera.width, view.camera.height):
        raise StageError(
            f"{path.name} is {width}×{height} pixels, but its camera says {view.camera.width}×{view.camera.height}."
        )


def reduced(pixels: Pixels, longest: int) -> Pixels:
    """Downscale an image to a longer side of at most ``longest`` pixels by area averaging; never upscale."""
    height, width = pixels.shape[:2]
    scale = longest / max(height, width)
    if scale >= 1.0:
        return pixels
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
