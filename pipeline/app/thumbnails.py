"""Small pictures of photos, for pages that carry them within: shrunk, turned for people, and never too large."""

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

FORMATS = ("JPEG", "PNG", "TIFF")  # as ingest takes them; an MPO opens as JPEG
MOST_BYTES = 512 << 20  # of a file
MOST_PIXELS = 300_000_000  # of a photo that cannot be shrunk while it is read: some gigabyte of memory
END_OF_JPEG = b"\xff\xd9"
QUALITY = 76
TURNS = {  # by EXIF's orientation
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
MOST_KEPT = 1024  # small pictures of a page that is written again and again


@dataclass(frozen=True)
class Thumbnail:
    """A small picture.

    Attributes:
        picture: As a data address.
        width: Pixels.
        height: Pixels.
        whole: False where the file ends before its picture does: what is missing is grey.
    """

    picture: Markup
    width: int
    height: int
    whole: bool = True


def thumbnail(path: Path, side: int, orientation: int = 1) -> Thumbnail | None:
    """A photo, small; None where it cannot be read at all.

    Args:
        path: The file.
        side: Pixels of its longer side, at most.
        orientation: As EXIF counts, of a file that does not say it itself.
    """
    stamp = _file_stamp(path)
    return None if stamp is None else _thumbnail(path, side, orientation, stamp)


def cut_out(path: Path, width: int, height: int) -> Thumbnail | None:
    """The middle of a photo, pixel by pixel; None where it cannot be read at all.

    Args:
        path: The file.
        width: Pixels across, of the photo's own.
        height: Pixels down.
    """
    opened = _read(path, None)
    if opened is None:
        return None
    image, whole = opened
    left, top = max(0, (image.width - width) // 2), max(0, (image.height - height) // 2)
    return _coded(image.crop((left, top, min(image.width, left + width), min(image.height, top + height))), whole)


def _file_stamp(path: Path) -> tuple[int, int] | None:
    try:
        told = path.stat()
    except (OSError, ValueError):
        return None
    if not stat.S_ISREG(told.st_mode) or told.st_size > MOST_BYTES:  # a pipe would be waited for
        return None
    return told.st_mtime_ns, told.st_size


@lru_cache(maxsize=MOST_KEPT)
def _thumbnail(path: Path, side: int, orientation: int, _stamp: tuple[int, int]) -> Thumbnail | None:
    """Of the file as it was at that stamp."""
    opened = _read(path, side)
    if opened is None:
        return None
    image, whole = opened
    if orientation in TURNS:
        image = image.transpose(TURNS[orientation])
    image.thumbnail((side, side), Image.Resampling.BOX if whole else Image.Resampling.NEAREST)
    return _coded(image, whole)


def _read(path: Path, side: int | None) -> tuple[Image.Image, bool] | None:
    """A photo in RGB, turned for people, about twice `side` large if that is quicker; and whether it is whole."""
    if _file_stamp(path) is None:
        return None
    try:
        data = path.read_bytes()
    except (OSError, ValueError):
        return None
    for more in (b"", END_OF_JPEG):  # libjpeg paints grey what is missing before an end
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a large picture, or broken metadata: check has told
                with Image.open(io.BytesIO(data + more), formats=FORMATS) as image:
                    if side is not None:
                        image.draft("RGB", (2 * side, 2 * side))
                    if image.width * image.height > MOST_PIXELS:
                        return None
                    image.load()
                    return ImageOps.exif_transpose(image).convert("RGB"), not more
        except Exception:  # Pillow raises nearly anything on broken files, SyntaxError and struct.error among them
            continue
    return None


def _coded(image: Image.Image, whole: bool) -> Thumbnail:
    file = io.BytesIO()
    image.save(file, "JPEG", quality=QUALITY, optimize=True)
    code = base64.b64encode(file.getvalue()).decode()
    return Thumbnail(Markup("data:image/jpeg;base64," + code), image.width, image.height, whole)
