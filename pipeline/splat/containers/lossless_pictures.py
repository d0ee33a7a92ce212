"""Images whose pixels are data: writes lossless WebP; reads untrusted WebP and PNG after checking their sizes."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from splatpipe.pipeline.engine.errors import SplatpipeError

_QUALITY, _METHOD = 70, 4  # libwebp's own for lossless; see docs of `cwebp -q -m`
_AGAIN = "Copy or export it again."


def webp_of_pixels(pixels: UInt8[np.ndarray, "h w c"]) -> bytes:
    """Encode pixels of 3 or 4 channels as lossless WebP, preserving colours of transparent pixels."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", lossless=True, quality=_QUALITY, method=_METHOD, exact=True)
    return file.getvalue()


def pixels_of_picture(path: Path, name: str, data: bytes, least: int, most: int) -> UInt8[np.ndarray, "h w 4"]:
    """Decode an image within size limits.

    Args:
        path: The splat, for error messages.
        name: The image, for error messages.
        data: The encoded image.
        least: Minimum number of pixels.
        most: Maximum number of pixels.

    Raises:
        SplatpipeError: if it has fewer or more pixels, is broken, or is neither WebP nor PNG.
    """
    size = _size(data)
    if size is None:
        raise SplatpipeError(f"{path}: {name[:60]} is not a WebP or PNG image.", hint=_AGAIN)
    if not least <= size[0] * size[1] <= most:
        raise SplatpipeError(
            f"{path}: {name[:60]} has {size[0]} × {size[1]} pixels; {least:,} are needed.", hint=_AGAIN
        )
    try:
        with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as picture:
            if picture.size != size:
                raise ValueError("of another size than its header says")
            return np.asarray(picture.convert("RGBA"))
    except Exception as error:  # Pillow's readers raise almost anything on broken files
        reason = " ".join(str(error).split())[:120]
        raise SplatpipeError(f"{path}: {name[:60]} is damaged: {reason}.", hint=_AGAIN) from error


def _size(data: bytes) -> tuple[int, int] | None:
    """Width and height in a header, for which a decoder would allocate memory.

    Source: RFC 9649 (WebP image format), sections 2.5 to 2.7; PNG specification, third edition, 11.2.1.
    """
    start = data[:32].ljust(32, b"\0")
    if start.startswith(b"\x89PNG\r\n\x1a\n"):
        width, height = struct.unpack_from(">II", start, 16)
        return int(width), int(height)
    if start[:4] != b"RIFF" or start[8:12] != b"WEBP":
        return None
    kind = start[12:16]
    if kind == b"VP8L":
        bits = int.from_bytes(start[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        return int.from_bytes(start[24:27], "little") + 1, int.from_bytes(start[27:30], "little") + 1
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", start, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None
