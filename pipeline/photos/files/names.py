"""Match names from elsewhere with photos."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterable
from pathlib import PurePath, PurePosixPath

PHOTO_SUFFIXES = ("jpg", "jpeg", "jpe", "jfif", "mpo", "png", "tif", "tiff")


CONTROL = re.compile("[\\x00-\\x1f\\x7f-\\x9f\\u2028\\u2029]")  # line breaks of any kind, tabs, and the like


def is_plain(name: str) -> bool:
    """Whether a name fits into a line of a file: lists of photos and control files have one photo per line."""
    return CONTROL.search(name) is None


def is_photo(path: PurePath) -> bool:
    """Whether a file's suffix is a photo's."""
    return path.suffix.casefold().lstrip(".") in PHOTO_SUFFIXES


class NameFinder:
    """Find a photo by name: an exact match, else the only match ignoring case, then suffix, then folder.

    Programs that export models differ in how much of the path and of the suffix they keep; so do people.

    Args:
        photos: Names of all photos.
    """

    def __init__(self, photos: Iterable[str]) -> None:
        self._tables: list[tuple[Callable[[str], str], dict[str, list[str]]]] = []
        names = list(dict.fromkeys(photos))
        for key in (str, _folded, _without_suffix, _last, lambda name: _without_suffix(_last(name))):
            table: dict[str, list[str]] = {}
            for name in names:
                table.setdefault(key(name), []).append(name)
            self._tables.append((key, table))

    def __call__(self, name: str) -> str | None:
        """Return the photo's name; None if there is none, or if there are several."""
        found = (table.get(key(name), []) for key, table in self._tables)
        return next((photos[0] for photos in found if len(photos) == 1), None)

    def several(self, name: str) -> list[str]:
        """Return the photos that a name may mean, if they are several and none fits better."""
        found = (table.get(key(name), []) for key, table in self._tables)
        return [] if self(name) is not None else next((photos for photos in found if photos), [])


def hint_of_several(names: Iterable[str], photos: Iterable[str]) -> str:
    """What to do about names that may mean several photos; empty if there are none.

    Args:
        names: As a file has them.
        photos: Names of all photos.
    """
    find = NameFinder(sorted(photos))
    found = next(((name, several) for name in names if (several := find.several(name))), None)
    if found is None:
        return ""
    return f"{printable(found[0])} may be {list_names(found[1], 3)}: write the photos' folders before their names."


def match_names(names: Iterable[str], photos: Iterable[str]) -> dict[str, str]:
    """Match a model's images with photos, each photo at most once; equal names take precedence.

    Args:
        names: Of the model's images.
        photos: Of all photos.

    Returns:
        The photo's name by the image's name, without the images that match none.
    """
    known = set(photos)
    find = NameFinder(sorted(known))
    matched: dict[str, str] = {}
    taken: set[str] = set()
    for name in sorted(set(names), key=lambda name: (name not in known, name)):
        photo = find(name)
        if photo is not None and photo not in taken:
            matched[name] = photo
            taken.add(photo)
    return matched


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name.replace("\\", "/")).casefold()  # Macs take letters and accents apart


def _last(name: str) -> str:
    return PurePosixPath(_folded(name)).name


def _without_suffix(name: str) -> str:
    stem, dot, suffix = _folded(name).rpartition(".")
    return stem if dot and suffix in PHOTO_SUFFIXES else _folded(name)


def without_zeros(name: str) -> str:
    """A name whose numbers have lost their leading zeros, as in a spreadsheet's column of numbers."""
    return re.sub(r"(?<!\d)0+(?=\d)", "", name)


NAMES_SHOWN = 10  # names listed in one message; left_out.json lists them all


def list_names(names: Iterable[str], limit: int = NAMES_SHOWN) -> str:
    """Format names for a message: the first few, and how many more."""
    listed = [printable(name) for name in names]
    more = f" and {len(listed) - limit} more" if len(listed) > limit else ""
    return ", ".join(listed[:limit]) + more


def printable(name: str) -> str:
    """Escape line breaks and other unprintable characters of a name."""
    return "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in name)
