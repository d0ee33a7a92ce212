"""Files that are there whole or as before, even after a power cut: written aside, flushed to the disk, then renamed."""

from __future__ import annotations

import glob
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any


def write_durably(path: Path, content: str | Callable[[IO[bytes]], Any]) -> None:
    """Let a file take ``path``'s place at once, or not at all.

    Args:
        path: Where; an older file there is replaced, and its permissions stay.
        content: Its text, written as UTF-8; or what is called with the open file to fill it.

    Raises:
        OSError: if the disk is full or not writable; what was at ``path`` is still there.
    """
    with _beside(path) as aside:
        with aside.open("wb") as file:
            if isinstance(content, str):
                file.write(content.encode())
            else:
                content(file)
        if path.exists():
            shutil.copymode(path, aside)


def copy_durably(source: Path, path: Path) -> None:
    """Let a copy of a file, with its times and permissions, take ``path``'s place at once, or not at all.

    Raises:
        OSError: if it cannot be read, or the disk is full or not writable; what was at ``path`` is still there.
    """
    with _beside(path) as aside:
        shutil.copy2(source, aside)


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """A file's name to fill beside ``path``, whose place it then takes."""
    aside = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        yield aside
        with aside.open("rb") as file:
            os.fsync(file.fileno())
        aside.replace(path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def remove_unfinished(folder: Path, name: str = "*", process: int | None = None) -> None:
    """Remove what killed processes left of files that they were writing.

    Args:
        folder: Where.
        name: Of the file; of any by default.
        process: Number of the one that was killed; None where nobody else writes these files there now.
    """
    for aside in folder.glob(f".{glob.escape(name) if name != '*' else name}.{process or '*'}.new"):
        aside.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Flush a folder's names to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Flush a folder's files and names, and those of all folders in it, to the disk."""
    for path in folder.rglob("*"):
        if path.is_dir():
            sync_folder(path)
        else:
            with path.open("rb") as file:
                os.fsync(file.fileno())
    sync_folder(folder)
