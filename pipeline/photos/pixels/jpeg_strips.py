"""Write a JPEG strip by strip, so that a large image is never held whole in memory.

A JPEG's blocks of 8 × 8 pixels are coded independently, except for their mean, which is coded as the difference from
the previous block; a restart marker resets it (ITU-T T.81, B.2.4.4 and F.1.1.5.1). So strips of whole rows of blocks,
each coded as an image with the same tables, become one image when joined by such markers: its pixels are the same as
if it had been coded at once.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.output_file import new_file

QUALITY = 97  # with full chroma: far above what training reaches, and a third of a PNG's size and decoding time
OPTIONS = (
    *(cv2.IMWRITE_JPEG_QUALITY, QUALITY),
    *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
)
BLOCK = 8  # pixels a side, with full chroma
STRIP_PIXELS = 1 << 21  # coded at a time; smaller images are one strip: a plain file without markers
START_OF_FRAME, RESTART_INTERVAL, START_OF_SCAN = 0xC0, 0xDD, 0xDA
FIRST_RESTART, RESTARTS = 0xD0, 8
END = b"\xff\xd9"
Strip = UInt8[np.ndarray, "rows w 3"]


def write_jpeg(path: Path, strips: Iterable[Strip], height: int) -> None:
    """Write an image that is given in strips.

    Args:
        path: The file.
        strips: BGR, from the top, of any heights and equal widths.
        height: Total height, pixels.

    Raises:
        StageError: if a strip cannot be encoded.
    """
    with new_file(path) as file:
        for number, strip in enumerate(_equal_strips(strips)):
            head, scan = _parts(_encode(path.name, strip))
            if number == 0:
                file.write(head if len(strip) == height else _head(head, strip, height))
            else:
                file.write(bytes((0xFF, FIRST_RESTART + (number - 1) % RESTARTS)))
            file.write(scan)
        file.write(END)


def _equal_strips(strips: Iterable[Strip]) -> Iterator[Strip]:
    """Regroup rows into strips of equal heights, multiples of a block; the last strip holds the rest."""
    kept: list[Strip] = []
    for strip in strips:
        rows = max(BLOCK, STRIP_PIXELS // strip.shape[1] // BLOCK * BLOCK)
        kept.append(strip)
        while sum(map(len, kept)) > rows:  # not >=: only the last strip may be shorter
            joined = np.concatenate(kept)
            yield joined[:rows]
            kept = [joined[rows:]]
    if kept:
        yield np.concatenate(kept)


def _encode(name: str, pixels: Strip) -> bytes:
    done, encoded = cv2.imencode(".jpg", np.ascontiguousarray(pixels), list(OPTIONS))
    if not done:
        raise StageError(f"{name} could not be encoded.")
    return bytes(encoded)


def _segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield marker, first byte and end of each segment up to the start of scan."""
    at, marker = 2, 0
    while marker != START_OF_SCAN:
        marker, length = data[at + 1], struct.unpack(">H", data[at + 2 : at + 4])[0]
        yield marker, at, at + 2 + length
        at += 2 + length


def _parts(data: bytes) -> tuple[bytes, bytes]:
    """Split a JPEG into its header and its coded pixels."""
    *_, (_, _, scan) = _segments(data)
    return data[:scan], data[scan : -len(END)]


def _head(head: bytes, strip: Strip, height: int) -> bytes:
    """Turn the first strip's header into that of the whole image: its height, and the blocks between markers."""
    changed = bytearray(head)
    across = -(-strip.shape[1] // BLOCK)
    for marker, first, end in _segments(head):
        if marker == START_OF_FRAME:  # after the marker: two bytes of length, one of precision, then the height
            changed[first + 5 : first + 7] = struct.pack(">H", height)
        if marker == START_OF_SCAN:
            interval = struct.pack(">BBHH", 0xFF, RESTART_INTERVAL, 4, across * (len(strip) // BLOCK))
            return bytes(changed[:first]) + interval + bytes(changed[first:end])
    raise AssertionError("a JPEG without a scan")
