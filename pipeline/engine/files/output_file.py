"""The one way to write a file: never through a link, into a pipe or a device that somebody left in a received folder.

A file that is written anew replaces what bears its name, so that a link is removed and its target untouched. A file
that is appended to must be a regular one, and so must the folders of ours above it. Libraries that write a file by
its path do so in a working folder that was made here, or in which ``require_own_files`` has found no link.
"""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterable
from io import BufferedWriter
from pathlib import Path, PurePath
from typing import IO

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.files.small_file import kind_of

MODE = 0o666  # less the user's umask, as for any other program's files
SAFE = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
UNFINISHED = ".new"  # the ending of temporary names
HINT = "An OUT from somebody else is not to be trusted: remove that file, or choose another OUT."


def new_file(path: Path) -> BufferedWriter:
    """Open a new file for writing; whatever file or link bears its name is removed first.

    Raises:
        OSError: if it cannot be created.
    """
    path.unlink(missing_ok=True)
    return open(path, "wb", opener=_create)


def write_file(path: Path, content: str | bytes) -> None:
    """Write a new file (not atomically); whatever file or link bears its name is removed first.

    Args:
        path: The file.
        content: Its bytes, or its text, written as UTF-8.

    Raises:
        OSError: if it cannot be written.
    """
    with new_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def open_own(path: Path, flags: int) -> int:
    """Open a file of ours in place, created if it is missing.

    One with a second name elsewhere (a hard link) is replaced by a copy first, so that only OUT changes: copies of an
    OUT made by ``cp -al`` have such files, and somebody else's may be yours.

    Args:
        path: The file.
        flags: As for ``os.open``, for reading or writing; that it is created and not followed is added.

    Returns:
        Its file descriptor.

    Raises:
        UsageError: if it is a link, or not a regular file.
        OSError: if it cannot be opened.
    """
    _require(path, files=True, folders=False)
    descriptor = os.open(path, flags | os.O_CREAT | SAFE, MODE)
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode):  # it has been replaced meanwhile
        os.close(descriptor)
        raise _refusal(path, status.st_mode)
    if status.st_nlink > 1:
        os.close(descriptor)
        _separate(path)
        return open_own(path, flags)
    return descriptor


def _separate(path: Path) -> None:
    """Replace a file that has further names by a copy that has none."""
    aside = path.with_name(f".{path.name}.{os.getpid()}.{token()}{UNFINISHED}")
    try:
        new_file(aside).close()
        shutil.copy2(path, aside, follow_symlinks=False)
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def appended_file(path: Path) -> IO[bytes]:
    """Open a file of ours to append to it, created if it is missing; nothing is buffered.

    Raises:
        UsageError: if it is a link, or not a regular file.
        OSError: if it cannot be opened.
    """
    return os.fdopen(open_own(path, os.O_WRONLY | os.O_APPEND), "ab", buffering=0)


def own_folder(root: Path, *below: str | PurePath) -> Path:
    """Make a folder of ours, and those above it up to an OUT; those that exist are kept.

    Args:
        root: The OUT, which may be a link, or a folder of ours in it.
        below: The folder, relative to it.

    Raises:
        UsageError: if one of them is a link, or not a folder; ``root`` itself may be a link, but not to nothing.
        OSError: if it cannot be made.
    """
    for place in (root, *root.parents):
        if place.is_symlink() and not place.exists():
            raise UsageError(
                f"{place} is a link to {place.readlink()}, which does not exist.",
                hint="Make that folder, or remove the link.",
            )
    root.mkdir(parents=True, exist_ok=True)
    folder = root
    for name in PurePath(*below).parts:
        folder = folder / name
        _require(folder, files=False, folders=True)
        folder.mkdir(exist_ok=True)
    return folder


def is_inside(root: Path, relative: PurePath) -> bool:
    """Whether no folder between an OUT and a path in it is a link, so that the path is one of OUT's own.

    Args:
        root: The OUT.
        relative: The path, relative to it.
    """
    return not any((root / above).is_symlink() for above in relative.parents if above.parts)


def require_own_files(paths: Iterable[Path]) -> None:
    """Check that paths are files and folders: ours are never links, pipes, sockets or devices.

    Raises:
        UsageError: naming the first that is not.
    """
    for path in paths:
        _require(path, files=True, folders=True)


def require_replaceable(path: Path) -> None:
    """Check that a path which a user named is no device: root could remove it, which breaks the machine.

    Raises:
        UsageError: if it is a device, pipe or socket, or a link to one.
    """
    try:
        mode = path.stat().st_mode
    except OSError:  # nothing, or a link to nothing; what else is wrong shows when it is written
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise UsageError(f"{path} is {kind_of(mode)}, which splatpipe does not replace.", hint="Choose another name.")


def token() -> str:
    """An unpredictable part of a temporary file's name: nobody can make such a file or link before we do."""
    return os.urandom(8).hex()


def _create(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_EXCL | SAFE, MODE)


def _require(path: Path, *, files: bool, folders: bool) -> None:
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not ((files and stat.S_ISREG(mode)) or (folders and stat.S_ISDIR(mode))):
        raise _refusal(path, mode)


def _refusal(path: Path, mode: int) -> UsageError:
    what = "a file" if stat.S_ISREG(mode) else kind_of(mode)
    return UsageError(f"{path} is {what}, which splatpipe does not write to.", hint=HINT)
