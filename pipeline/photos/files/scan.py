"""Find the files of the photo folder that are photos, or claim to be."""

from __future__ import annotations

import os
import stat
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from splatpipe.pipeline.engine.files.product_folders import program_of
from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.engine.machine import pseudo_devices
from splatpipe.pipeline.photos.files.companions import MASK, find_companions, other_formats, reason_of
from splatpipe.pipeline.photos.files.extra_formats import (
    DNG_REASON,
    HEIC_REASON,
    MODULES,
    is_heic,
    is_installed,
)
from splatpipe.pipeline.photos.files.names import is_plain, list_names

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
MAGICS = {  # first bytes of pictures whose names claim to be some
    "BMP": (b"BM",),
    "JPEG XL": (b"\xff\x0a", b"\0\0\0\x0cJXL \r\n"),
    "JPEG 2000": (b"\0\0\0\x0cjP  \r\n", b"\xff\x4f\xff\x51"),
    "OpenEXR": (b"\x76\x2f\x31\x01",),
}
DNG_SUFFIX = ".dng"
RAW_REASON = "is a camera's raw file: develop it to JPEG or TIFF"
TWIN_REASON = "is another format of a photo that is used"
TIFF_HEADS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


@dataclass(frozen=True)
class Candidate:
    """A file to be checked: its name (POSIX path relative to the photo folder) and its path."""

    name: str
    path: Path


@dataclass(frozen=True)
class ExcludedPhoto:
    """An excluded photo.

    Attributes:
        name: Its name.
        reason: Why: the end of a sentence that starts with the name.
        kind: ``companion`` for a file that belongs to a photo, so that nothing is lost without it; ``products`` for a
            folder of a program's products.
    """

    name: str
    reason: str
    kind: Literal["unusable", "duplicate", "companion", "products"] = "unusable"


def by_reason(entries: Iterable[ExcludedPhoto]) -> dict[str, list[str]]:
    """The names of excluded photos by their reasons."""
    names: dict[str, list[str]] = {}
    for entry in entries:
        names.setdefault(entry.reason, []).append(entry.name)
    return names


def with_reason(names: Sequence[str], reason: str) -> str:
    """A sentence, without its full stop, about photos that are excluded for the same reason."""
    return f"{list_names(names)} {reason}" if len(names) == 1 else f"{list_names(names)}; each {reason}"


@dataclass(frozen=True)
class PhotoMask:
    """A mask that lies beside its photo: its name, the photo's, and its path."""

    name: str
    owner: str
    path: Path


@dataclass(frozen=True)
class Scan:
    """The content of a photo folder.

    Attributes:
        candidates: Files to be checked, sorted by name.
        left_out: Files that claim to be photos but cannot be used, or belong to photos, sorted by name.
        others: Number of other files, which are ignored.
        masks: Masks of photos that lie among them, sorted by name.
    """

    candidates: tuple[Candidate, ...]
    left_out: tuple[ExcludedPhoto, ...]
    others: int
    masks: tuple[PhotoMask, ...] = ()


def scan_folder(root: Path) -> Scan:
    """Scan a folder recursively.

    Hidden files and folders, ``masks/`` and ``sky_masks/`` are skipped, and so are folders of a program's products, and
    links to folders (they may be circular, and the run's digests do not cover their targets). A file is recognized as
    a photo by its first bytes, whatever its name.

    Args:
        root: The folder that names are relative to.
    """
    candidates: list[Candidate] = []
    extra: dict[str, list[Candidate]] = {reason: [] for reason in MODULES if is_installed(MODULES[reason])}
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
        products = {name: program for name in folders if (program := program_of(Path(folder) / name))}
        folders[:] = [name for name in folders if name not in products]
        left_out += [
            ExcludedPhoto(_name(Path(folder) / name, root), f"is a folder of {program}'s products", "products")
            for name, program in products.items()
        ]
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
            problem = _name_problem(path.relative_to(root))
            if reason is None and problem is None:
                candidates.append(Candidate(_name(path, root), path))
            elif problem is None and reason in extra:
                extra[reason].append(Candidate(_name(path, root), path))
            else:
                left_out.append(ExcludedPhoto(_name(path, root), reason or problem or ""))
    for more in extra.values():
        twins = other_formats([each.name for each in more], [each.name for each in candidates])
        candidates += [each for each in more if each.name not in twins]
        left_out += [ExcludedPhoto(each.name, TWIN_REASON, "companion") for each in more if each.name in twins]
    return _without_companions(sorted(candidates, key=lambda candidate: candidate.name), left_out, others)


def _without_companions(candidates: Sequence[Candidate], left_out: Sequence[ExcludedPhoto], others: int) -> Scan:
    """The scan, with the files that belong to photos told apart from these."""
    companions = find_companions(candidate.name for candidate in candidates)
    photos = [candidate for candidate in candidates if candidate.name not in companions]
    formats = (RAW_REASON, DNG_REASON, *map(_unsupported, OTHER_PICTURES.values()))
    raws = {entry.name for entry in left_out if entry.reason in formats}
    twins = other_formats(raws, [photo.name for photo in photos])
    masks, excluded = [], []
    for candidate in candidates:
        companion = companions.get(candidate.name)
        if companion is not None and companion.kind == MASK:
            masks.append(PhotoMask(candidate.name, companion.owner, candidate.path))
        elif companion is not None:
            excluded.append(ExcludedPhoto(candidate.name, reason_of(companion), "companion"))
    for entry in left_out:
        known = entry.name in twins
        excluded.append(ExcludedPhoto(entry.name, TWIN_REASON, "companion") if known else entry)
    return Scan(tuple(photos), tuple(sorted(excluded, key=lambda entry: entry.name)), others, tuple(masks))


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
        return DNG_REASON if suffix == DNG_SUFFIX and head.startswith(TIFF_HEADS) else RAW_REASON
    kind = _kind(head)
    if kind == "photo":
        return None
    if kind:
        return _unsupported(kind)
    if not claims:
        return ""
    if not head:
        return "is empty"
    other = next((name for name, magics in MAGICS.items() if head.startswith(magics)), "")
    return _unsupported(other) if other else f"is no {_claimed_format(suffix)} picture, whatever its name says"


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


def _unsupported(kind: str) -> str:
    if kind == "HEIC":
        return HEIC_REASON
    return f"is a {kind} picture, which is not supported: convert it to JPEG or PNG"


def _kind(head: bytes) -> str:
    """``photo`` for a supported format, the format's name for other images, empty for anything else."""
    if head.startswith((b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", *TIFF_HEADS)):
        return "photo"
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "WebP"
    if is_heic(head):
        return "HEIC"
    if head[4:12] in (b"ftypavif", b"ftypavis"):
        return "AVIF"
    return ""
