"""Photos for the browser in the stored pixel grid, to which marks refer, regardless of EXIF orientation.

A JPEG is sent without its metadata: without EXIF the browser does not rotate it, and no pixel changes. Formats that
browsers do not show (TIFF, 16 bits) are converted losslessly.
"""

from __future__ import annotations

import io
from pathlib import Path

from PIL import Image

from splatpipe.pipeline.photos.files.photo_list import Photo, decode, photo_bytes
from splatpipe.pipeline.photos.files.picture_file import open_picture

MAX_BYTES = 256 << 20
SOI, SOS, APP0, APP1, APP15, COMMENT, APP2, APP14 = 0xD8, 0xDA, 0xE0, 0xE1, 0xEF, 0xFE, 0xE2, 0xEE
KEPT = (APP0, APP14)  # segments with colour information; of APP2 only the ICC profile is kept
ICC = b"ICC_PROFILE\0"
PLAIN_MODES = ("RGB", "L")


def photo_for_browser(photo: Photo, part: Path, photos_dir: Path) -> tuple[bytes, str]:
    """A photo's bytes for the browser, and their media type.

    Args:
        photo: The photo.
        part: The folder of the part ``ingest.photos``.
        photos_dir: The user's folder.

    Raises:
        SplatpipeError: if the file is gone or is no longer the one that was checked.
    """
    data = photo_bytes(photo, part, photos_dir)
    try:
        if len(data) <= MAX_BYTES:
            with open_picture(io.BytesIO(data)) as picture:
                plain = picture.format == "JPEG" and picture.mode in PLAIN_MODES
                plain = plain and picture.size == (photo.width, photo.height)
            if plain:
                return without_metadata(data), "image/jpeg"
    except (OSError, ValueError, SyntaxError):
        pass  # reported by the decoder below
    pixels = decode(photo, part, photos_dir)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=1)
    return buffer.getvalue(), "image/png"


def without_metadata(jpeg: bytes) -> bytes:
    """Remove EXIF, XMP, comments and trailing data from a JPEG.

    Raises:
        ValueError: if it is not a JPEG.
    """
    if jpeg[:2] != bytes((0xFF, SOI)):
        raise ValueError("no JPEG")
    kept, at = [jpeg[:2]], 2
    while True:
        while jpeg[at : at + 2] == b"\xff\xff":  # fill bytes
            at += 1
        if len(jpeg) < at + 4 or jpeg[at] != 0xFF:
            raise ValueError("a broken JPEG")
        kind = jpeg[at + 1]
        if kind == SOS:
            return b"".join([*kept, jpeg[at:]])
        end = at + 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
        segment = jpeg[at:end]
        is_profile = kind == APP2 and segment[4:].startswith(ICC)
        if not (APP0 <= kind <= APP15 or kind == COMMENT) or kind in KEPT or is_profile:
            kept.append(segment)
        at = end
