"""Convert photos that are not plain 8-bit RGB or grey to PNGs that every reader supports."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Shaped, UInt8
from PIL import Image

from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.photos.files.photo_list import read_checked
from splatpipe.pipeline.photos.files.picture_file import STRIP_ROWS, load_stored, open_picture, turn_to_decode
from splatpipe.pipeline.photos.intake.check import CheckedPhoto, deep_pixels, stored_orientation

PNG_LEVEL = 1  # zlib's fastest: for an intermediate file, half the size is not worth ten times the time
FULL_RANGE = 65535.0
NARROW_RANGE = FULL_RANGE / 4  # 16-bit files that use less hold 10 to 14 bits, or temperatures


def scale_of(ranges: list[tuple[float, float]]) -> tuple[float, float]:
    """Choose the values that become black and white in all photos of one camera, so that brightness stays comparable.

    Args:
        ranges: Lowest and highest value of each photo.

    Returns:
        0 and 65535 for photos that use the full 16 bits; else the lowest and the highest value of all photos.
    """
    low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
    if low >= 0.0 and high <= FULL_RANGE and high - low >= NARROW_RANGE:
        return 0.0, FULL_RANGE
    return low, high


def read_8bit(
    photo: CheckedPhoto, scale: tuple[float, float] | None
) -> tuple[np.ndarray, UInt8[np.ndarray, "h w"] | None]:
    """Decode a photo of any kind to 8 bits, in the stored grid.

    Args:
        photo: A checked photo.
        scale: Of a deep photo: the values that become 0 and 255.

    Returns:
        (h, w, 3) RGB or (h, w) grey, uint8; and the opacity, 0 to 255, or None for an opaque photo.
    """
    data = read_checked(photo.path, photo.name, photo.sha256)
    with open_picture(BytesIO(data)) as picture:
        orientation = stored_orientation(photo.exif, picture)
        if scale is not None:
            deep = deep_pixels(data, picture, orientation)
            if deep is not None:
                return _scale(deep, scale)
        stored = load_stored(picture, orientation)
    if stored.has_transparency_data:
        rgba = np.asarray(stored.convert("RGBA"))
        return rgba[:, :, :3], rgba[:, :, 3]
    return np.asarray(stored.convert("L" if stored.mode in ("1", "L") else "RGB")), None


def convert_photo(
    photo: CheckedPhoto, scale: tuple[float, float] | None, target: Path
) -> UInt8[np.ndarray, "h w"] | None:
    """Write a photo's 8-bit PNG.

    Args:
        photo: A checked photo that is not plain.
        scale: Of a deep photo: the values that become 0 and 255.
        target: The PNG; its folder is created.

    Returns:
        Its mask from transparency, 0 where opacity is below half, else 255; None for an opaque photo.
    """
    with turn_to_decode(photo.width * photo.height):
        pixels, opacity = read_8bit(photo, scale)
        save_png(pixels, target)
    if opacity is None or not photo.transparent:
        return None
    return np.where(opacity < 128, 0, 255).astype(np.uint8)


def save_png(pixels: UInt8[np.ndarray, "h w *channels"], target: Path) -> None:
    """Write a PNG without any metadata, creating its folder."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with new_file(target) as file:
        Image.fromarray(np.ascontiguousarray(pixels)).save(file, format="PNG", compress_level=PNG_LEVEL)


def _scale(
    deep: Shaped[np.ndarray, "h w *channels"], scale: tuple[float, float]
) -> tuple[np.ndarray, UInt8[np.ndarray, "h w"] | None]:
    low, high = scale
    colours = deep[..., :3] if deep.ndim == 3 else deep
    scaled = np.empty(colours.shape, np.uint8)
    for top in range(0, len(colours), STRIP_ROWS):
        values = colours[top : top + STRIP_ROWS].astype(np.float32) - np.float32(low)
        values *= np.float32(255.0 / max(high - low, 1e-30))
        values = np.nan_to_num(values, nan=0.0, posinf=255.0, neginf=0.0)
        scaled[top : top + STRIP_ROWS] = np.rint(np.clip(values, 0.0, 255.0)).astype(np.uint8)
    opacity = None
    if deep.ndim == 3 and deep.shape[2] == 4:
        opacity = (deep[:, :, 3] >> 8).astype(np.uint8)
    return scaled, opacity
