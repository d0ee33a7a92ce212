"""Thumbnails of photos for embedding in pages: reduced, rotated upright, and limited in size."""

from __future__ import annotations

import base64
import io
import stat
import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from markupsafe import Markup
from PIL import Image, ImageOps

from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.photos.files.picture_file import open_picture, sparse_data_reason, turn_to_decode

MAX_BYTES = 512 << 20  # largest file that is read
MAX_PIXELS = 300_000_000  # largest photo decoded if it cannot be reduced meanwhile: about a gigabyte of memory
END_OF_JPEG = b"\xff\xd9"
QUALITY = 76
TURNS = {  # by EXIF orientation
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
MAX_CACHED = 1024  # thumbnails cached for a page that is written repeatedly


@dataclass(frozen=True)
class Thumbnail:
    """A small image.

    Attributes:
        picture: The image as a data URL.
        width: Pixels.
        height: Pixels.
        whole: False if the file is truncated: the missing part is grey.
    """

    picture: Markup
    width: int
    height: int
    whole: bool = True


def thumbnail(path: Path, side: int, orientation: int = 1) -> Thumbnail | None:
    """Make a photo's thumbnail; None if the photo cannot be read at all.

    Args:
        path: The file.
        side: Largest length of the longer side, pixels.
        orientation: EXIF orientation to assume if the file has none.
    """
    stamp = _file_stamp(path)
    return None if stamp is None else _thumbnail(path, side, orientation, stamp)


def crop_middle(path: Path, width: int, height: int) -> Thumbnail | None:
    """Crop the middle of a photo at full resolution; None if the photo cannot be read at all.

    Args:
        path: The file.
        width: Width of the crop, pixels.
        height: Height of the crop, pixels.
    """
    opened = _read(path, None)
    if opened is None:
        return None
    image, whole = opened
    left, top = max(0, (image.width - width) // 2), max(0, (image.height - height) // 2)
    return _encode(image.crop((left, top, min(image.width, left + width), min(image.height, top + height))), whole)


def _file_stamp(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except (OSError, ValueError):
        return None
    if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_BYTES:  # reading a pipe would block
        return None
    return status.st_mtime_ns, status.st_size


@lru_cache(maxsize=MAX_CACHED)
def _thumbnail(path: Path, side: int, orientation: int, _stamp: tuple[int, int]) -> Thumbnail | None:
    """The thumbnail of the file as it was at that stamp."""
    opened = _read(path, side)
    if opened is None:
        return None
    image, whole = opened
    if orientation in TURNS:
        image = image.transpose(TURNS[orientation])
    image.thumbnail((side, side), Image.Resampling.BOX if whole else Image.Resampling.NEAREST)
    return _encode(image, whole)


def _read(path: Path, side: int | None) -> tuple[Image.Image, bool] | None:
    """Read a photo as upright RGB, at about twice `side` if that is quicker; also returns whether it is complete."""
    if _file_stamp(path) is None:
        return None
    try:
        with open_regular(path) as file:
            data = file.read() or b""  # nothing: the kernel's log has nothing to say
    except (OSError, ValueError):
        return None
    for more in (b"", END_OF_JPEG):  # with an end marker, libjpeg fills the missing part with grey
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about large images or broken metadata: check has reported these
                with open_picture(io.BytesIO(data + more)) as image:
                    if sparse_data_reason(image, data):
                        return None
                    if side is not None:
                        image.draft("RGB", (2 * side, 2 * side))
                    if image.width * image.height > MAX_PIXELS:
                        return None
                    with turn_to_decode(image.width * image.height):
                        image.load()
                        return ImageOps.exif_transpose(image).convert("RGB"), not more
        except Exception:  # Pillow raises nearly anything on broken files, SyntaxError and struct.error among them
            continue
    return None


def _encode(image: Image.Image, whole: bool) -> Thumbnail:
    file = io.BytesIO()
    image.save(file, "JPEG", quality=QUALITY, optimize=True)
    code = base64.b64encode(file.getvalue()).decode()
    return Thumbnail(Markup("data:image/jpeg;base64," + code), image.width, image.height, whole)
