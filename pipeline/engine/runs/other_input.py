"""Files that are given in place of a photo folder and are not read: what they are, and what to do with them."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

FILM_CONTAINERS = (".mkv", ".avi", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".wmv", ".flv", ".webm")
ARCHIVES = (".zip", ".7z", ".rar", ".tar", ".tgz", ".tbz2", ".txz", ".gz", ".bz2", ".xz")
PICTURES = (".jpg", ".jpeg", ".jpe", ".png", ".tif", ".tiff", ".dng", ".heic", ".heif", ".webp")
# VP8 in WebM has no place in an MP4; what WMV and FLV hold rarely has.
ENCODED_ANEW = (".webm", ".wmv", ".flv")


@dataclass(frozen=True)
class OtherInput:
    """A kind of file that is not read: the end of a sentence that begins with its name, and what to do."""

    what: str
    hint: str


def other_input(path: Path) -> OtherInput | None:
    """What a file is by its suffix, if people give it in place of photos; None for any other file."""
    suffix = path.suffix.casefold()
    if suffix in FILM_CONTAINERS:
        return OtherInput("is a film in a container that is not read", _film_hint(path, suffix in ENCODED_ANEW))
    if suffix in ARCHIVES:
        return OtherInput("is an archive", "Unpack it, and give the folder with the photos.")
    if suffix in PICTURES:
        return OtherInput("is a single picture", "Give the folder that has all photos of the capture.")
    return None


def _film_hint(path: Path, anew: bool) -> str:
    """The command that brings a film into an MP4, where positions are looked for, too."""
    codec = "libx264 -crf 16" if anew else "copy"
    how = "makes one" if anew else "makes one without encoding the pictures anew"
    source, target = (shlex.quote(str(name)) for name in (path, path.with_suffix(".mp4")))
    return f"MP4 and MOV are read. This {how}: ffmpeg -i {source} -map 0:v:0 -c:v {codec} {target}"
