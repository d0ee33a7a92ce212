"""Files that other programs and cameras put beside photos: masks, previews, depth maps, raw files.

They are told by their names: a photo's name with a tag (``NAME_mask.JPG``, as OpenDroneMap wants it, ``mask_NAME``,
``NAME.JPG.mask.png``), or the same name in a folder called by the tag (``depth/NAME.png``). A tag alone says nothing:
the photo that the file belongs to must be there.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from splatpipe.pipeline.photos.files.names import PHOTO_SUFFIXES

MASK, PREVIEW, DEPTH = "mask", "preview", "depth map"
CONFIDENCE, NORMALS = "confidence map", "normal map"
TAGS = {
    **dict.fromkeys(("mask", "masks"), MASK),
    **dict.fromkeys(("thumb", "thumbs", "thumbnail", "thumbnails", "thm", "preview", "previews"), PREVIEW),
    **dict.fromkeys(("depth", "depths", "depthmap", "depthmaps", "depth_map", "depth_maps"), DEPTH),
    **dict.fromkeys(("disparity", "dpt"), DEPTH),
    **dict.fromkeys(("confidence", "conf"), CONFIDENCE),
    **dict.fromkeys(("normal", "normals"), NORMALS),
}
REDUCED_FOLDERS = ("images_2", "images_4", "images_8")  # as trainers of splats keep reduced copies of images/
PREVIEW_SUFFIX = ".thm"  # a JPEG beside a camera's film or photo
_TAG = "|".join(sorted(TAGS, key=len, reverse=True))
_AFTER = re.compile(rf"(?P<owner>.+)[ ._-](?P<tag>{_TAG})")
_BEFORE = re.compile(rf"(?P<tag>{_TAG})[ ._-](?P<owner>.+)")
# What the photo has where the map has its tag.
_COLOUR = re.compile(r"(?:rgb|colou?r|image|img|frame|photo)[ ._-]?(?=.)")


@dataclass(frozen=True)
class Companion:
    """A file that belongs to a photo.

    Attributes:
        kind: What it is, such as ``MASK``.
        owner: The photo's name; empty for a camera's preview without one.
    """

    kind: str
    owner: str


def find_companions(names: Iterable[str]) -> dict[str, Companion]:
    """Find the pictures that belong to others.

    Args:
        names: Of all pictures: POSIX paths relative to the photo folder.

    Returns:
        The companions by their names.
    """
    listed = sorted(names)
    owners = _Owners(listed)
    found = {}
    for name in listed:
        companion = _companion(PurePosixPath(name), owners)
        if companion is not None and companion.owner != name:
            found[name] = companion
    return found


class _Owners:
    """Photos by folder and name, without letter case and with or without suffix."""

    def __init__(self, names: Sequence[str]) -> None:
        self._beside: dict[tuple[str, str], str] = {}
        self._stems: dict[str, list[str]] = {}
        for name in names:
            path = PurePosixPath(name)
            for key in {path.name.casefold(), stem_of(path.name)}:
                self._beside.setdefault((str(path.parent), key), name)
            stem = stem_of(path.name)
            self._beside.setdefault((str(path.parent), _COLOUR.sub("", stem, count=1)), name)
            self._stems.setdefault(stem, []).append(name)

    def beside(self, folder: PurePosixPath, key: str) -> str | None:
        """The photo of a name in a folder."""
        return self._beside.get((str(folder), key))

    def below(self, folder: PurePosixPath, stem: str, but: str) -> str | None:
        """The photo of a name in a folder or below it, but in no folder of companions; else that of another name."""
        for name in self._stems.get(stem, []):
            inner = PurePosixPath(name).parent
            if folder in (inner, *inner.parents) and not any(map(_folder_tag, inner.relative_to(folder).parts)):
                return name
        return None if stem == but else self.below(folder, but, but)


def _companion(path: PurePosixPath, owners: _Owners) -> Companion | None:
    stem = stem_of(path.name)
    for pattern in (_AFTER, _BEFORE):
        found = pattern.fullmatch(stem)
        owner = owners.beside(path.parent, found["owner"]) if found is not None else None
        if found is not None and owner is not None:
            return Companion(TAGS[found["tag"]], owner)
    for depth, part in enumerate(path.parent.parts):
        kind = _folder_tag(part)
        owner = owners.below(PurePosixPath(*path.parts[:depth]), stem, stem_of(stem)) if kind else None
        if owner is not None:
            return Companion(kind, owner)
    return Companion(PREVIEW, "") if path.suffix.casefold() == PREVIEW_SUFFIX else None


def _folder_tag(name: str) -> str:
    """The kind of files in a folder by its name; empty where it says none."""
    folded = name.casefold()
    return PREVIEW if folded in REDUCED_FOLDERS else TAGS.get(folded, "")


def stem_of(name: str) -> str:
    """A file's name in lower case without a photo's suffix."""
    folded = name.casefold()
    stem, dot, suffix = folded.rpartition(".")
    return stem if dot and stem and suffix in (*PHOTO_SUFFIXES, PREVIEW_SUFFIX[1:]) else folded


def reason_of(companion: Companion) -> str:
    """Why a companion is no photo: the end of a sentence that starts with its name."""
    return f"is a {companion.kind}" + (" of another photo" if companion.owner else " that a camera wrote")


def other_formats(names: Iterable[str], photos: Iterable[str]) -> Mapping[str, str]:
    """Which files are other formats of photos: raw files and the like of the same name in the same folder.

    Args:
        names: Of the files.
        photos: Of the photos.

    Returns:
        The photo by the file's name.
    """
    by_place = {_place(name): name for name in sorted(photos, reverse=True)}
    return {name: by_place[_place(name)] for name in names if _place(name) in by_place}


def _place(name: str) -> tuple[str, str]:
    path = PurePosixPath(name)
    return str(path.parent), path.stem.casefold()
