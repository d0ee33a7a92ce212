"""Photos for those who look at them small: decoded small where they are large, so that 20 megapixels cost little.

A JPEG's blocks can be decoded at a half, a quarter or an eighth of their size: most of the time and nearly all of the
memory of a large photo are saved. What is decoded so still has twice the wanted size at least, and the area filter that
trainings use does the rest. Photos that are not that large are decoded whole: nothing changes for them.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.dataset import View
from splatpipe.pipeline.photos.images import Mask, Pixels, load_mask, read_image, reduced_camera, reduced_mask

ROOM = 2  # a side of what is decoded is so many of the wanted one at least: below, its own filter would show
STEPS = (
    (8, cv2.IMREAD_REDUCED_COLOR_8),
    (4, cv2.IMREAD_REDUCED_COLOR_4),
    (2, cv2.IMREAD_REDUCED_COLOR_2),
)
JPEG_BEGINS = b"\xff\xd8"  # anything else is decoded whole before it is made smaller


def small_view(view: View, max_megapixels: float) -> tuple[Camera, Pixels, Mask | None]:
    """A view as ``reduced_view`` has it, to look at rather than to train on.

    Args:
        view: Of the dataset.
        max_megapixels: Its size at most.

    Returns:
        Its camera at that size, the photo (h, w, 3) RGB, and its mask.

    Raises:
        StageError: if a picture cannot be read or is not of its camera's size.
    """
    camera, full = reduced_camera(view.camera, max_megapixels), view.camera
    size = (camera.width, camera.height)
    factor, pixels = read_small(view.image_path, (full.width, full.height), size)
    if pixels.shape[:2] != (math.ceil(full.height / factor), math.ceil(full.width / factor)):
        raise StageError(
            f"{view.image_path.name} is not of its camera's size, {full.width}×{full.height} pixels.",
            hint="Run again with --rerun-from undistort.",
        )
    mask = load_mask(view)
    if camera is not full:
        # Its last column may reach beyond the photo, by less than a factor: so the scale is given, not the size alone.
        across, down = (factor * small / large for small, large in zip(size, (full.width, full.height), strict=True))
        pixels = np.asarray(cv2.resize(pixels, None, fx=across, fy=down, interpolation=cv2.INTER_AREA), np.uint8)
        mask = None if mask is None else reduced_mask(mask, size)
    return camera, np.ascontiguousarray(pixels[:, :, ::-1]), mask


def read_small(path: Path, size: tuple[int, int], wanted: tuple[int, int]) -> tuple[int, Pixels]:
    """Decode a photo, made smaller meanwhile where it is a JPEG of far more than the wanted size.

    Args:
        path: The photo.
        size: Its width and height.
        wanted: Those that are asked for.

    Returns:
        By what its sides were divided, rounded up; and the pixels, BGR.

    Raises:
        StageError: if it cannot be read.
    """
    room = min(side // (ROOM * want) for side, want in zip(size, wanted, strict=True))
    small = room >= STEPS[-1][0] and _is_jpeg(path)
    factor, flag = next(((by, how) for by, how in STEPS if small and room >= by), (1, cv2.IMREAD_COLOR))
    return factor, read_image(path, flag)


def _is_jpeg(path: Path) -> bool:
    """By its content: names are the user's. What cannot be opened is told by who decodes it."""
    try:
        with path.open("rb") as file:
            return file.read(len(JPEG_BEGINS)) == JPEG_BEGINS
    except OSError:
        return False
