"""Reading a small file that somebody else may have made: without waiting, and never more than is allowed."""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path

KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFLNK: "a link",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
READ_BYTES = 1 << 18


def kind_of(mode: int) -> str:
    """What a file is that is not a regular one, from its ``st_mode``."""
    return KINDS.get(stat.S_IFMT(mode), "no file")


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file for reading; a pipe is not waited for, and a device is not even opened.

    Args:
        path: The file; a link is followed.

    Raises:
        OSError: if it cannot be opened or is not a regular file; ``strerror`` says which.
    """
    _require_regular(path, path.stat())
    return open(path, "rb", opener=_open_without_waiting)


def _open_without_waiting(path: str, flags: int) -> int:
    descriptor = os.open(path, flags | os.O_NONBLOCK)
    try:
        _require_regular(path, os.fstat(descriptor))  # it may have been replaced
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def read_small(path: Path, max_bytes: int) -> bytes:
    """Read a file, whatever size its folder states: pseudo files state none.

    Args:
        path: The file; a link is followed.
        max_bytes: The most it may have.

    Raises:
        OSError: if it cannot be read, is not a regular file, or is larger; ``strerror`` says which.
    """
    found = bytearray()
    with open_regular(path) as file:
        while block := file.read(min(READ_BYTES, max_bytes + 1 - len(found))):
            found += block
    if len(found) <= max_bytes:
        return bytes(found)
    raise OSError(errno.EOVERFLOW, f"it is too large: more than {_size(max_bytes)}", str(path))


def read_end(path: Path, max_bytes: int) -> bytes:
    """Read the last bytes of a file, such as a log.

    Raises:
        OSError: if it cannot be read or is not a regular file.
    """
    with open_regular(path) as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - max_bytes))
        return file.read(max_bytes)


def _require_regular(path: str | Path, status: os.stat_result) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, f"it is {kind_of(status.st_mode)}, not a file", str(path))


def _size(count: int) -> str:
    return f"{count >> 20} MiB" if count >= 1 << 20 else f"{count >> 10} KiB"
