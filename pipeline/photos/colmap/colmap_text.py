"""COLMAP's text models where pycolmap's reader falls short: names with blanks, byte order marks, missing lines.

The format is that of COLMAP's documentation ("Output format", text). A name is the rest of its line, but the reader
takes only what stands before the next blank. It refuses a file with a byte order mark, with which Windows' editor and
its PowerShell save text. In an ``images.txt`` without the lines of keypoints, it skips every other photo, or the last.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.engine.files.text_lines import encoding_of, open_text
from splatpipe.pipeline.engine.runs.colmap_folder import LONGEST_LINE, photo_lines

PHOTO_FIELDS = 10  # IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
LONGEST_NAME = 4096  # as in a binary model
TEXT_SUFFIX = ".txt"


@dataclass(frozen=True)
class TextPhotos:
    """The photos of ``images.txt``.

    Attributes:
        names: Whole names by image id.
        cameras: A photo's name by the id of its camera, for each camera that a photo has.
        ends: Whether the last photo has its second line, too; an editor may have stripped it if it was empty.
    """

    names: Mapping[int, str]
    cameras: Mapping[str, str]
    ends: bool


def read_photos(path: Path) -> TextPhotos:
    """Read ``images.txt``, except for poses and keypoints.

    Raises:
        OSError: if it cannot be read.
        ValueError: if a photo's line has no name, or the line of keypoints is missing.
    """
    names: dict[int, str] = {}
    cameras: dict[str, str] = {}
    keypoints = "\n"
    for number, line, keypoints in photo_lines(path):
        fields = line.split(None, PHOTO_FIELDS - 1)
        if len(fields) < PHOTO_FIELDS or not fields[0].isascii() or not fields[0].isdigit():
            raise ValueError(f"{path.name}, line {number}: not IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        if len(fields[-1]) > LONGEST_NAME:
            raise ValueError(f"{path.name}, line {number}: a name of {len(fields[-1])} characters")
        if _is_photo(keypoints):
            raise ValueError(
                f"{path.name}, line {number + 1}: a photo where the keypoints of the one before belong; "
                "each photo has two lines, of which the second may be empty"
            )
        names[int(fields[0])] = _decoded(fields[-1])
        cameras.setdefault(fields[-2], names[int(fields[0])])
    return TextPhotos(names, cameras, keypoints != "")


def require_cameras(path: Path, photos: TextPhotos) -> None:
    """Check that each photo's camera is in ``cameras.txt``; pycolmap would miss a rig, of which the files say nothing.

    Raises:
        OSError: if it cannot be read.
        ValueError: if one is not.
    """
    lacking = dict(photos.cameras)
    with open_text(path) as file:
        while line := file.readline(LONGEST_LINE):
            lacking.pop((line.split(None, 1) or [""])[0], None)
    for camera, name in lacking.items():
        raise ValueError(f"{name[:100]} has camera {camera[:20]}, which is not in {path.name}")


def _is_photo(line: str) -> bool:
    """Whether a line is a photo's: keypoints are numbers, but a name, the tenth field, hardly ever is one."""
    fields = line[: PHOTO_FIELDS * LONGEST_NAME].split(None, PHOTO_FIELDS - 1)
    if len(fields) < PHOTO_FIELDS:
        return False
    try:
        float(fields[-1].split(None, 1)[0])
    except ValueError:
        return True
    return len(line.split(None, PHOTO_FIELDS)) == PHOTO_FIELDS  # keypoints come in threes: never ten fields


def _decoded(name: str) -> str:
    """A name that is no UTF-8 read in Windows' western code page, as survey files are."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return name.encode("utf-8", "surrogateescape").decode("cp1252", "backslashreplace")
    return name


@contextmanager
def plain_text(folder: Path, photos: TextPhotos) -> Iterator[Path]:
    """The folder of a text model that pycolmap can read: itself, or a copy in UTF-8 whose last lines end.

    Raises:
        OSError: if a file cannot be read, or the copy cannot be written.
        UnicodeDecodeError: if a file is not in the encoding that it states.
    """
    paths = [path for path in sorted(folder.glob(f"*{TEXT_SUFFIX}")) if path.is_file()]
    if photos.ends and not any(encoding_of(path) for path in paths):
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="splatpipe-colmap-") as name:
        copy = Path(name)
        for path in paths:
            with (
                open_text(path) as source,
                (copy / path.name).open("w", encoding="utf-8", errors="surrogateescape", newline="") as target,
            ):
                shutil.copyfileobj(source, target)
                target.write("\n\n")
        yield copy
