"""A COLMAP-style folder: ``images/`` beside ``sparse/``, which holds one model or several that could not be joined."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.engine.files.text_lines import open_text

MODEL_FILES = ("cameras.bin", "cameras.txt")
PHOTOS_FILE, PHOTOS_TEXT = "images.bin", "images.txt"
LONGEST_LINE = 64 << 20  # characters; a line has all keypoints of a photo, which would be two millions here
MODELS_SHOWN = 5  # models that a message names one by one
_COUNT = struct.Struct("<Q")
_LEAST_PHOTO_BYTES = 73  # of a photo in images.bin: id, pose, camera, an empty name, no keypoints


@dataclass(frozen=True)
class SparseModels:
    """The sparse models of a folder.

    Attributes:
        used: The one with the most photos; of equals, the first.
        photos: Number of photos by model, first the one that is used, then by number; empty if there is only one
            model, whose photos are not counted.
    """

    used: Path
    photos: tuple[tuple[Path, int], ...] = ()

    @property
    def note(self) -> str:
        """Which of several models is used; empty if there is only one."""
        if not self.photos:
            return ""
        (used, most), *others = ((f"sparse/{path.name}", count) for path, count in self.photos)
        listed = ", ".join(f"{name} has {count}" for name, count in others[:MODELS_SHOWN])
        more = f", {len(others) - MODELS_SHOWN} more have fewer" if len(others) > MODELS_SHOWN else ""
        return (
            f"There are {len(self.photos)} models in sparse/, which were not joined: {used} with {most} "
            f"photo{'' if most == 1 else 's'} is used; {listed}{more}. To use another one, move the others elsewhere."
        )


def has_model(folder: Path) -> bool:
    """Whether a folder is COLMAP-style: ``images/`` beside a model in ``sparse/0``, ``sparse/1``, … or ``sparse``."""
    return bool(_models(folder))


def find_models(folder: Path) -> SparseModels | None:
    """Find the models of a COLMAP-style folder, and choose the one with the most photos; None without any.

    COLMAP numbers models as it begins them: 0 may have two photos, and 1 all others.
    """
    models = _models(folder)
    if len(models) < 2:  # nothing to choose from
        return SparseModels(models[0]) if models else None
    counted = [(model, _photos_of(model)) for model in models]
    used = max(counted, key=lambda entry: entry[1])  # the first of equals
    return SparseModels(used[0], (used, *(entry for entry in counted if entry is not used)))


def photo_lines(path: Path) -> Iterator[tuple[int, str, str]]:
    """Step through COLMAP's ``images.txt``: each photo has a line, and one of keypoints, which may be empty.

    Yields:
        The number of the photo's line, from 1; the line; the next one, empty only at the file's end.

    Raises:
        OSError: if it cannot be read.
        ValueError: if a line is too long, or the text is not in the encoding that it states.
    """
    with open_text(path) as file:
        number = 0
        while line := _line(path, file.readline(LONGEST_LINE)):
            number += 1
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            yield number, line.strip(), _line(path, file.readline(LONGEST_LINE))
            number += 1


def _line(path: Path, line: str) -> str:
    if len(line) == LONGEST_LINE:
        raise ValueError(f"{path.name} has a line of more than {LONGEST_LINE >> 20} million characters")
    return line


def _models(folder: Path) -> list[Path]:
    """The folders of models, by number."""
    sparse = folder / "sparse"
    if not (folder / "images").is_dir() or not sparse.is_dir():
        return []
    numbered = []
    with suppress(OSError), os.scandir(sparse) as entries:
        numbered = [sparse / entry.name for entry in entries if entry.name.isascii() and entry.name.isdigit()]
    found = [path for path in sorted(numbered, key=lambda path: (int(path.name), path.name)) if _is_model(path)]
    return found or [sparse] * _is_model(sparse)


def _is_model(folder: Path) -> bool:
    return any((folder / name).is_file() for name in MODEL_FILES)


def _photos_of(model: Path) -> int:
    """The number of photos that a model states; 0 if its file cannot be read or is too short for them."""
    try:
        if (model / PHOTOS_FILE).is_file():
            with open_regular(model / PHOTOS_FILE) as file:
                (count,) = _COUNT.unpack(file.read(_COUNT.size))
                fits = count * _LEAST_PHOTO_BYTES <= os.fstat(file.fileno()).st_size
            return int(count) if fits else 0
        return sum(1 for _ in photo_lines(model / PHOTOS_TEXT))
    except (OSError, ValueError, struct.error):
        return 0
