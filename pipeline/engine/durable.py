"""Atomic file replacement that survives a power cut: written beside the target, flushed to disk, then renamed."""

from __future__ import annotations

import errno
import glob
import os
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from splatpipe.pipeline.engine.output_file import UNFINISHED, new_file, token
from splatpipe.pipeline.engine.small_file import kind_of


def write_durably(path: Path, content: str | Callable[[IO[bytes]], Any]) -> None:
    """Write a file atomically, replacing any existing one; a link is replaced, too, and its target untouched.

    Args:
        path: The file; the permissions of an existing one are kept.
        content: Its text, written as UTF-8, or a function called with the open binary file to fill it.

    Raises:
        OSError: if the disk is full or not writable; what was at ``path`` is still there.
    """
    with beside(path) as aside:
        with new_file(aside) as file:
            if isinstance(content, str):
                file.write(content.encode())
            else:
                content(file)
        with suppress(FileNotFoundError):
            if stat.S_ISREG(mode := path.lstat().st_mode):
                aside.chmod(stat.S_IMODE(mode))


def copy_durably(source: Path, path: Path) -> None:
    """Copy a regular file with its times and permissions to ``path`` atomically, replacing any existing file or link.

    Raises:
        OSError: if ``source`` cannot be read or is a link, or the disk is full or not writable; what was at ``path``
            is still there.
    """
    if not stat.S_ISREG(mode := source.lstat().st_mode):
        raise OSError(errno.EINVAL, f"it is {kind_of(mode)}, not a file", str(source))
    with beside(path) as aside:
        new_file(aside).close()
        shutil.copy2(source, aside, follow_symlinks=False)


@contextmanager
def beside(path: Path) -> Iterator[Path]:
    """Yield an unpredictable temporary path beside ``path`` for a new file or folder.

    On success, what was written there is flushed and renamed to ``path``; otherwise it is removed.
    """
    aside = _aside(path)
    try:
        yield aside
        if aside.is_dir():
            sync_tree(aside)
            if path.is_dir() and not path.is_symlink():
                path.rmdir()  # it must be empty, or this fails
            aside.replace(path)
            sync_folder(path.parent)
        else:
            _move(aside, path)
    except BaseException:
        _remove(aside)
        raise


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path in a folder of its own; the file is moved to ``path`` once it is complete.

    The folder also holds what libraries write beside their own files (GDAL's temporary overviews). Only one process at
    a time may write a file: unfinished files of killed ones are removed.

    Args:
        path: Final path; an older file there is replaced.

    Raises:
        OSError: if the disk is full or not writable; what was at ``path`` is still there.
    """
    remove_unfinished(path.parent, path.name)
    folder = _aside(path)
    folder.mkdir()
    try:
        yield folder / path.name
        _move(folder / path.name, path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _aside(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.{token()}{UNFINISHED}")


def _move(aside: Path, path: Path) -> None:
    """Flush a complete file to disk and give it its name."""
    with aside.open("rb") as file:
        os.fsync(file.fileno())
    aside.replace(path)
    sync_folder(path.parent)


def remove_unfinished(folder: Path, name: str = "*", process: int | None = None) -> None:
    """Remove the temporary files of killed processes.

    Args:
        folder: The folder to clean.
        name: Name of the target file; any by default.
        process: ID of the killed process; None if no other process is writing these files now.
    """
    pattern = f".{glob.escape(name) if name != '*' else name}.{process or '*'}"
    for ending in (f".*{UNFINISHED}", UNFINISHED):  # the latter of versions up to 0.2
        for aside in folder.glob(f"{pattern}{ending}"):
            _remove(aside)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


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
