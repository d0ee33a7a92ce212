"""Why a folder gives no reconstruction at all: what lies there in place of photos, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splatpipe.pipeline.engine.runs.other_input import other_input
from splatpipe.pipeline.engine.runs.source import is_film
from splatpipe.pipeline.photos.files.names import list_names, printable

MIN_PHOTOS = 2
GIVE_PHOTOS = "Give the folder that has the JPEG, PNG or TIFF photos."


def explain_too_few(
    folder: Path, shown: Path, photos: Sequence[str], left_out: int, others: int
) -> tuple[str, str] | None:
    """Explain why there are not enough photos; None if there are.

    Args:
        folder: The user's folder or film.
        shown: Its path in messages.
        photos: Names of the usable photos.
        left_out: Number of the pictures that cannot be used.
        others: Number of the other files.

    Returns:
        A sentence, and what to do.
    """
    if len(photos) >= MIN_PHOTOS:
        return None
    if photos:
        return (
            f"There is only one usable photo in {shown}: {printable(photos[0])}.",
            "A reconstruction needs many overlapping photos of the same scene, at least three.",
        )
    if left_out:
        return f"None of the {left_out} pictures in {shown} can be used.", "Give JPEG, PNG or TIFF photos."
    names = sorted(path.name for path in folder.iterdir() if path.is_file()) if folder.is_dir() else []
    if films := [name for name in names if is_film(folder / name)]:
        return (
            f"There are no photos in {shown}, but {'films' if len(films) > 1 else 'a film'}: {list_names(films)}.",
            f"Give the film itself: splatpipe run {printable(str(shown / films[0]))} OUT",
        )
    for name in names:
        if (other := other_input(shown / name)) is not None:
            return f"There are no photos in {shown}, and {printable(name)} {other.what}.", other.hint
    if others:
        return f"There are no photos in {shown}, only {others} other file{'s' if others > 1 else ''}.", GIVE_PHOTOS
    if folder.is_dir() and any(folder.iterdir()):  # other folders
        return f"There are no photos in {shown}.", GIVE_PHOTOS
    return f"The folder {shown} is empty.", GIVE_PHOTOS
