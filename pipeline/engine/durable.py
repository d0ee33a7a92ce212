"""Files that are there whole or as before, even after a power cut: written aside, flushed to the disk, then renamed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
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
    aside = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        with aside.open("wb") as file:
            if isinstance(content, str):
                file.write(content.encode())
            else:
                content(file)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, aside)
        aside.replace(path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def remove_unfinished(folder: Path, name: str = "*") -> None:
    """Remove what killed processes left of files that they were writing.

    Args:
        folder: Where; nobody else writes these files there now.
        name: Of the file, or a glob pattern.
    """
    for aside in folder.glob(f".{name}.*.new"):
        aside.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Flush a folder's names to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
