"""Decode photos at small sizes for viewing, so that 20 megapixels cost little.

A JPEG's blocks can be decoded at a half, a quarter or an eighth of their size: most of the time and nearly all of the
memory of a large photo are saved. The decoded image still has at least twice the wanted size, and the area filter that
training uses does the rest. Smaller photos are decoded at full size: for them nothing changes.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.photos.pixels.images import Mask, Pixels, load_mask, read_image, reduced_camera, reduced_mask

SLACK = 2  # the decoded image is at least this many times the wanted size, or the decoder's own filter would show
STEPS = (
    (8, cv2.IMREAD_REDUCED_COLOR_8),
    (4, cv2.IMREAD_REDUCED_COLOR_4),
    (2, cv2.IMREAD_REDUCED_COLOR_2),
)
JPEG_BEGINS = b"\xff\xd8"  # anything else is decoded at full size before it is reduced


def small_view(view: View, max_megapixels: float) -> tuple[Camera, Pixels, Mask | None]:
    """Read a view as ``reduced_view`` does, for viewing rather than for training.

    Args:
        view: Of the dataset.
        max_megapixels: Its maximum size.

    Returns:
        Its camera at that size, the photo (h, w, 3) RGB, and its mask.

    Raises:
        StageError: if an image cannot be read or does not have its camera's size.
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
        # The last column may reach beyond the photo, by less than ``factor`` pixels: so pass the scale, not the size.
        across, down = (factor * small / large for small, large in zip(size, (full.width, full.height), strict=True))
        pixels = np.asarray(cv2.resize(pixels, None, fx=across, fy=down, interpolation=cv2.INTER_AREA), np.uint8)
        mask = None if mask is None else reduced_mask(mask, size)
    return camera, np.ascontiguousarray(pixels[:, :, ::-1]), mask


def read_small(path: Path, size: tuple[int, int], wanted: tuple[int, int]) -> tuple[int, Pixels]:
    """Decode a photo, at a reduced scale if it is a JPEG much larger than the wanted size.

    Args:
        path: The photo.
        size: Its width and height.
        wanted: The wanted width and height.

    Returns:
        The factor by which its sides were divided (rounded up), and the pixels, BGR.

    Raises:
        StageError: if it cannot be read.
    """
    room = min(side // (SLACK * want) for side, want in zip(size, wanted, strict=True))
    small = room >= STEPS[-1][0] and _is_jpeg(path)
    factor, flag = next(((by, how) for by, how in STEPS if small and room >= by), (1, cv2.IMREAD_COLOR))
    return factor, read_image(path, flag)


def _is_jpeg(path: Path) -> bool:
    """Whether the file's content is a JPEG, whatever its name; if it cannot be opened, the decoder reports it."""
    try:
        with path.open("rb") as file:
            return file.read(len(JPEG_BEGINS)) == JPEG_BEGINS
    except OSError:
        return False
