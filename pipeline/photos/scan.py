"""Find the files of the photo folder that are photos, or claim to be."""

from __future__ import annotations

import os
import stat
from collections.abc import Container
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.engine.machine import pseudo_devices
from splatpipe.pipeline.engine.small_file import open_regular
from splatpipe.pipeline.photos.names import is_plain

PHOTO_SUFFIXES = {".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".png", ".tif", ".tiff"}
OTHER_PICTURES = {
    ".heic": "HEIC",
    ".heif": "HEIF",
    ".avif": "AVIF",
    ".webp": "WebP",
    ".jxl": "JPEG XL",
    ".jp2": "JPEG 2000",
    ".bmp": "BMP",
    ".exr": "OpenEXR",
}
RAW_SUFFIXES = {".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw", ".iiq", ".3fr"}
MASK_FOLDER = "masks"
SKY_FOLDER = "sky_masks"
HEAD_BYTES = 16
MAX_NAME_BYTES = 250
TIFF_HEADS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


@dataclass(frozen=True)
class Candidate:
    """A file to be checked: its name (POSIX path relative to the photo folder) and its path."""

    name: str
    path: Path


@dataclass(frozen=True)
class ExcludedPhoto:
    """An excluded photo, and why: ``reason`` ends a sentence that starts with the name."""

    name: str
    reason: str


@dataclass(frozen=True)
class Scan:
    """The content of a photo folder.

    Attributes:
        candidates: Files to be checked, sorted by name.
        left_out: Files that claim to be photos but cannot be used, sorted by name.
        others: Number of other files, which are ignored.
    """

    candidates: tuple[Candidate, ...]
    left_out: tuple[ExcludedPhoto, ...]
    others: int


def scan_folder(root: Path) -> Scan:
    """Scan a folder recursively.

    Hidden files and folders, ``masks/`` and ``sky_masks/`` are skipped, and so are links to folders (they may be
    circular, and the run's digests do not cover their targets). A file is recognized as a photo by its first bytes,
    whatever its name.

    Args:
        root: The folder that names are relative to.
    """
    candidates: list[Candidate] = []
    left_out: list[ExcludedPhoto] = []
    others = 0
    pseudo = pseudo_devices()

    def unreadable(error: OSError) -> None:
        left_out.append(
            ExcludedPhoto(_name(Path(error.filename), root), "is a folder that cannot be read (permission denied)")
        )

    for folder, folders, files in os.walk(root, onerror=unreadable):
        skipped = [name for name in folders if name.startswith(".") or name.casefold() in (MASK_FOLDER, SKY_FOLDER)]
        folders[:] = sorted(set(folders) - set(skipped))
        links = [Path(folder) / name for name in folders if (Path(folder) / name).is_symlink()]
        left_out += [ExcludedPhoto(_name(link, root), "is a link to a folder, which is not followed") for link in links]
        for name in files:
            if name.startswith("."):
                continue
            path = Path(folder) / name
            reason = _exclusion_reason(path, pseudo)
            if reason == "":
                others += 1
                continue
            reason = reason or _name_problem(path.relative_to(root))
            if reason is None:
                candidates.append(Candidate(_name(path, root), path))
            else:
                left_out.append(ExcludedPhoto(_name(path, root), reason))
    return Scan(
        tuple(sorted(candidates, key=lambda candidate: candidate.name)),
        tuple(sorted(left_out, key=lambda entry: entry.name)),
        others,
    )


def _name(path: Path, root: Path) -> str:
    """The POSIX path relative to the root; bytes that are not UTF-8 show as ``\\xNN``."""
    return os.fsencode(path.relative_to(root).as_posix()).decode("utf-8", errors="backslashreplace")


def _exclusion_reason(path: Path, pseudo: Container[int]) -> str | None:
    """None for a candidate; the reason for a file that claims to be a photo; an empty text for any other file."""
    suffix = path.suffix.casefold()
    claims = suffix in PHOTO_SUFFIXES or suffix in RAW_SUFFIXES or suffix in OTHER_PICTURES
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) or status.st_dev in pseudo:
            return "is not a regular file" if claims or path.is_symlink() else ""
        with open_regular(path) as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        return f"cannot be read ({error.strerror})" if claims else ""
    if suffix in RAW_SUFFIXES:  # most raw formats are TIFF files with a thumbnail in front
        return "is a camera's raw file: develop it to JPEG or TIFF"
    kind = _kind(head)
    if kind == "photo":
        return None
    if kind:
        return f"is a {kind} picture, which is not supported: convert it to JPEG or PNG"
    if not claims:
        return ""
    return "is empty" if not head else f"is no {_claimed_format(suffix)} picture, whatever its name says"


def _name_problem(relative: Path) -> str | None:
    try:
        str(relative).encode()
    except UnicodeEncodeError:
        return "has a name that is not UTF-8: rename it"
    if not is_plain(str(relative)):
        return "has a line break or another control character in its name: rename it"
    # Masks and converted photos are called NAME.png, and file systems allow 255 bytes.
    return "has a name that is too long: rename it" if len(relative.name.encode()) > MAX_NAME_BYTES else None


def _claimed_format(suffix: str) -> str:
    if suffix in OTHER_PICTURES:
        return OTHER_PICTURES[suffix]
    return {".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF"}.get(suffix, "JPEG")


def _kind(head: bytes) -> str:
    """``photo`` for a supported format, the format's name for other images, empty for anything else."""
    if head.startswith((b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", *TIFF_HEADS)):
        return "photo"
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "WebP"
    if head[4:8] == b"ftyp" and head[8:12] in (b"heic", b"heix", b"mif1", b"msf1", b"hevc"):
        return "HEIC"
    if head[4:12] in (b"ftypavif", b"ftypavis"):
        return "AVIF"
    return ""
