"""Names of uploaded files: kept as they are, since control files and masks refer to them, or refused."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import PurePath
from typing import Literal

from splatpipe.pipeline.engine.runs.source import FILM_SUFFIXES, SUBTITLE_SUFFIX
from splatpipe.pipeline.photos.files.names import is_photo, is_plain

Kind = Literal["photo", "film", "survey", "other"]

MAX_NAME_BYTES = 240  # file systems take 255; part files have a longer name
RAW_SUFFIXES = (".dng", ".heic", ".heif")
SURVEY_SUFFIXES = (".txt", ".csv", ".geojson", ".xml", ".cam", SUBTITLE_SUFFIX)
# Text files with a meaning of their own; any other .txt is a list of control points.
NOT_CONTROL = ("geo.txt", "lens.txt", "image_groups.txt")
CONTROL_NAMES = ("gcp_list.txt", "control.csv")  # found by a run without being named
UNUSED = ("image_groups.txt",)  # of ODM, without a meaning here


class BadNameError(ValueError):
    """A file name that is refused; the message is a sentence."""


def plain_name(given: str) -> str:
    """The name of an uploaded file, without its folders.

    Raises:
        BadNameError: if it is empty, hidden, too long, or has characters that do not fit into a line of a file.
    """
    name = given.replace("\\", "/").rpartition("/")[2]
    shown = "".join(letter if letter.isprintable() else "?" for letter in name[:60])
    if not name or name.startswith("."):
        raise BadNameError(f'"{shown}" is not a name for a file: it is empty or begins with a dot.')
    if not is_plain(name) or any(0xD800 <= ord(letter) <= 0xDFFF for letter in name):
        raise BadNameError(f'The file name "{shown}" has characters that cannot be stored.')
    if len(name.encode()) > MAX_NAME_BYTES:
        raise BadNameError(f'The file name "{shown}…" is longer than {MAX_NAME_BYTES} bytes.')
    return name


def kind_of(name: str) -> Kind:
    """What an uploaded file is, by its name; ``other`` for what a run has no use for."""
    folded, suffix = PurePath(name).name.casefold(), PurePath(name).suffix.casefold()
    if is_photo(PurePath(name)) or suffix in RAW_SUFFIXES:
        return "photo"
    if suffix in FILM_SUFFIXES:
        return "film"
    return "survey" if suffix in SURVEY_SUFFIXES and folded not in UNUSED else "other"


def control_file(names: Iterable[str]) -> str | None:
    """The control file that has to be named to a run: any .txt that is nothing else; None if one is found without.

    Args:
        names: Names of all uploaded files.
    """
    listed = sorted(names)
    if any(name.casefold() in CONTROL_NAMES for name in listed):
        return None
    texts = (name for name in listed if name.casefold().endswith(".txt") and name.casefold() not in NOT_CONTROL)
    return next(texts, None)
