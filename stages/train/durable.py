"""Files that are whole or not there: written aside, flushed to the disk, then renamed."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any


def write_durably(path: Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Let ``write`` fill a file that takes ``path``'s place at once, or not at all.

    Args:
        path: Where; an older file there is replaced.
        write: Called with the open file.

    Raises:
        OSError: if the disk is full or not writable; what was at ``path`` is still there.
    """
    aside = path.with_name(path.name + ".tmp")
    try:
        with aside.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
