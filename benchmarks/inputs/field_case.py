"""What a field input is, and the demo's photos with other metadata, from which many are made."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image

DEMO = Path(__file__).resolve().parents[2] / "demo/capture"
PHOTOS = sorted((DEMO / "photos").glob("*.JPG"))
GPS_IFD = 0x8825
EXIF_IFD = 0x8769
LAST_FIX = 0xDA  # a JPEG's start of scan: no metadata after it
XMP_HEAD = b"http://ns.adobe.com/xap/1.0/\0"


@dataclass(frozen=True)
class FieldInput:
    """An input as somebody in the field would bring it.

    Attributes:
        name: Name of its folder, and on the command line.
        make: Writes the files into an empty folder.
        commands: Arguments of splatpipe, one command after the other; run in that folder.
        ends: Exit code of the last command.
        says: Words that it has to print, in any order, without regard to line breaks.
        silent_on: Words that it must not print.
        mended: What was wrong or unkind when the input was made; empty if nothing was.
    """

    name: str
    make: Callable[[Path], None]
    commands: tuple[str, ...]
    ends: int
    says: tuple[str, ...] = ()
    silent_on: tuple[str, ...] = ()
    mended: str = ""


def demo_bytes(index: int) -> bytes:
    """Return a photo of the demo capture (0 to 39)."""
    return PHOTOS[index].read_bytes()


def copy_photos(folder: Path, indices: Sequence[int], name: Callable[[int], str] | None = None) -> list[Path]:
    """Copy photos of the demo capture, under other names if wished; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / (name(i) if name else PHOTOS[i].name) for i in indices]
    for index, path in zip(indices, paths, strict=True):
        path.write_bytes(demo_bytes(index))
    return paths


def exif_of(data: bytes) -> Image.Exif:
    """Return a photo's EXIF, with its two inner directories loaded."""
    exif = Image.open(BytesIO(data)).getexif()
    exif.get_ifd(GPS_IFD)
    exif.get_ifd(EXIF_IFD)
    return exif


def with_metadata(data: bytes, exif: Image.Exif | bytes | None, *, xmp: bytes | None = None) -> bytes:
    """Return a JPEG with this EXIF and XMP in place of its own, its picture untouched."""
    kept, at = [], 2
    while data[at + 1] != LAST_FIX:
        size = struct.unpack(">H", data[at + 2 : at + 4])[0]
        if data[at + 1] != 0xE1:  # APP1: EXIF and XMP
            kept.append(data[at : at + 2 + size])
        at += 2 + size
    new = []
    if exif is not None:
        body = exif if isinstance(exif, bytes) else exif.tobytes()
        new.append(segment(0xE1, body if body.startswith(b"Exif") else b"Exif\0\0" + body))
    if xmp is not None:
        new.append(segment(0xE1, XMP_HEAD + xmp))
    return data[:2] + b"".join(new + kept) + data[at:]


def segment(marker: int, body: bytes) -> bytes:
    """Return a JPEG segment."""
    return bytes([0xFF, marker]) + struct.pack(">H", len(body) + 2) + body


def edited(
    index: int, gps: dict[int, Any] | None = None, main: dict[int, Any] | None = None, *, xmp: bool = False
) -> bytes:
    """Return a photo of the demo with changed EXIF tags.

    Args:
        index: The photo (0 to 39).
        gps: Tags of the GPS directory; None as a value takes one out.
        main: Tags of the main directory, likewise.
        xmp: Whether the photo keeps its XMP, which states the position again.
    """
    data = demo_bytes(index)
    exif = exif_of(data)
    for changes, tags in ((gps or {}, exif.get_ifd(GPS_IFD)), (main or {}, exif)):
        for tag, value in changes.items():
            if value is None:
                tags.pop(tag, None)
            else:
                tags[tag] = value
    return with_metadata(data, exif, xmp=Image.open(BytesIO(data)).info["xmp"] if xmp else None)


def gps_of(index: int) -> tuple[float, float, float]:
    """Return latitude, longitude (degrees) and altitude (metres) of a photo of the demo."""
    gps = exif_of(demo_bytes(index)).get_ifd(GPS_IFD)
    latitude, longitude = (sum(float(part) / 60**power for power, part in enumerate(gps[tag])) for tag in (2, 4))
    return latitude, longitude, float(gps[6])


def control_lines() -> list[str]:
    """Return the demo's control file, line by line; the first states the CRS."""
    return (DEMO / "gcp_list.txt").read_text(encoding="utf-8").splitlines()
