"""Atomic file replacement that survives a power cut: written beside the target, flushed to disk, then renamed."""

from __future__ import annotations

import glob
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any


def write_durably(path: Path, content: str | Callable[[IO[bytes]], Any]) -> None:
    """Write a file atomically, replacing any existing one.

    Args:
        path: The file; the permissions of an existing one are kept.
        content: Its text, written as UTF-8, or a function called with the open binary file to fill it.

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
    """Copy a file with its times and permissions to ``path`` atomically, replacing any existing file.

    Raises:
        OSError: if ``source`` cannot be read, or the disk is full or not writable; what was at ``path`` is still there.
    """
    with _beside(path) as aside:
        shutil.copy2(source, aside)


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside ``path`` to write to; on success it is flushed and renamed to ``path``."""
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
    """Remove the temporary files of killed processes.

    Args:
        folder: The folder to clean.
        name: Name of the target file; any by default.
        process: ID of the killed process; None if no other process is writing these files now.
    """
    for aside in folder.glob(f".{glob.escape(name) if name != '*' else name}.{process or '*'}.new"):
        aside.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Flush a folder's directory entries to disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Flush a folder's files and directory entries to disk, recursively."""
    for path in folder.rglob("*"):
        if path.is_dir():
            sync_folder(path)
        else:
            with path.open("rb") as file:
                os.fsync(file.fileno())
    sync_folder(folder)
