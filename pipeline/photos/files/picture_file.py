"""The one way to open and decode a user's picture, whose size is not to be trusted: a few kB can claim 500 megapixels.

Everybody asks ``sparse_data_reason`` or compares the size that the header states before any pixel is decoded, and large
pictures are decoded one at a time in a process.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image

from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.photos.files.extra_formats import (
    RAW_MODULE,
    is_dng,
    is_heic,
    is_installed,
    open_dng,
    open_heic,
)

# Pillow's JPEG plugin also opens MPO, a JPEG with a second image, which DJI and phones write.
PHOTO_FORMATS = ("JPEG", "PNG", "TIFF")
LARGE_PIXELS = 40_000_000  # larger images are decoded one at a time: some hundred megabytes each
# bytes per pixel of a large photo's file; one colour all over takes 0.0156 with JPEG's usual tables
MIN_BYTES_PER_PIXEL = 0.01
MAX_PNG_CHUNKS = 1_000_000  # chunks of a PNG that are read at most: libpng writes one for 8 kB
TILE_TAGS = (322, 323)  # width and length of a TIFF's tiles
ALWAYS_ALLOWED_TILE_PX = 4096  # pixels per side that a tile may have in a picture of any size
HEAD_BYTES = 16
STRIP_ROWS = 256  # pixel rows of a picture that are converted at a time
INVERSE_ORIENTATION = {  # the inverse of the transposition that each EXIF orientation requires
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}
_one_large_at_a_time = threading.RLock()


def open_picture(source: Any, *, max_pixels: int | None = None) -> Image.Image:
    """Open a JPEG, PNG, TIFF, HEIC or DNG by its content, without Pillow's own size limit.

    Args:
        source: A path or a binary file object.
        max_pixels: Refuse an image with more pixels before any of them is decoded.

    Raises:
        ValueError: if it has more than ``max_pixels`` pixels.
        OSError: if it is not such an image (Pillow's ``UnidentifiedImageError`` is one), or its tiles are too large.
    """
    Image.MAX_IMAGE_PIXELS = None  # Pillow's limit is process-wide and refuses 200 MP panoramas; ours is checked below
    head = _head(source)
    if is_heic(head):
        picture = open_heic(source)
    elif isinstance(source, BytesIO) and is_installed(RAW_MODULE) and is_dng(source.getvalue()):
        picture = open_dng(source.getvalue())
    else:
        picture = Image.open(source, formats=PHOTO_FORMATS)
    if max_pixels is not None and picture.width * picture.height > max_pixels:
        raise ValueError(f"it has {picture.width} × {picture.height} pixels")
    _check_tiles(picture)
    return picture


def _head(source: Any) -> bytes:
    """A file's first bytes."""
    if isinstance(source, str | os.PathLike):
        with open_regular(Path(source)) as file:
            return file.read(HEAD_BYTES)
    head: bytes = source.read(HEAD_BYTES)
    source.seek(0)
    return head


def _check_tiles(picture: Image.Image) -> None:
    """Refuse a TIFF with tiles much larger than itself: libtiff decodes whole tiles, here 2 GB of 1.5 MB.

    Raises:
        OSError: if one is.
    """
    tags = getattr(picture, "tag_v2", {})
    for tag, side in zip(TILE_TAGS, picture.size, strict=True):
        found = tags.get(tag, 0)
        if not isinstance(found, int) or found > max(ALWAYS_ALLOWED_TILE_PX, 2 * side):
            raise OSError(f"its tiles of {found} pixels are larger than the picture")


def sparse_data_reason(picture: Image.Image, data: bytes) -> str:
    """Why an opened image cannot be a photo: its pixels take too few bytes of its file; empty if it can be one."""
    pixels = picture.width * picture.height
    if pixels <= LARGE_PIXELS:
        return ""
    taken = _png_bytes(data) if picture.format == "PNG" else len(data)
    if taken >= MIN_BYTES_PER_PIXEL * pixels:
        return ""
    return f"claims {picture.width} × {picture.height} pixels in only {taken / 1e3:,.0f} kB: it is no photo"


def _png_bytes(data: bytes) -> int:
    """How many bytes of a PNG are pixels: other chunks may have any size."""
    at, taken = 8, 0
    for _ in range(MAX_PNG_CHUNKS):
        length = int.from_bytes(data[at : at + 4], "big")
        taken += length if data[at + 4 : at + 8] == b"IDAT" else 0
        at += 12 + length
        if at >= len(data):
            break
    return min(taken, len(data))


def turn_to_decode(pixels: int) -> AbstractContextManager[object]:
    """Wait until no other thread of this process decodes a large picture, if this is one."""
    return _one_large_at_a_time if pixels > LARGE_PIXELS else contextlib.nullcontext()


def strips_of(picture: Image.Image) -> Iterator[Image.Image]:
    """A decoded picture in strips of ``STRIP_ROWS`` rows, so that converting it takes little memory."""
    for top in range(0, picture.height, STRIP_ROWS):
        yield picture.crop((0, top, picture.width, min(picture.height, top + STRIP_ROWS)))


def load_stored(picture: Image.Image, orientation: int) -> Image.Image:
    """Decode an opened image in full, in the stored grid.

    Args:
        picture: From ``open_picture``, not yet loaded.
        orientation: Its EXIF orientation, 1 to 8.
    """
    picture.load()
    # Pillow applies the orientation while loading a TIFF, but for no other format.
    return undo_orientation(picture, orientation) if picture.format == "TIFF" else picture


def undo_orientation(picture: Image.Image, orientation: int) -> Image.Image:
    """Convert an image to which an EXIF orientation (1 to 8) was applied back to the stored grid."""
    method = INVERSE_ORIENTATION.get(orientation)
    return picture if method is None else picture.transpose(method)
