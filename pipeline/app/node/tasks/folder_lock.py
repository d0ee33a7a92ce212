"""One node at a time works in a folder."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.files.output_file import open_own

LOCK_FILE = ".node.lock"


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Hold a node's folder; the kernel releases it with the process, and children do not inherit it.

    Raises:
        MachineError: if another node holds it, or it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = open_own(folder / LOCK_FILE, os.O_RDWR)
    except OSError as error:
        raise MachineError(f"{folder} cannot be used: {error.strerror}.", hint="Choose another folder.") from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise MachineError(
                f"Another node works in {folder}.", hint="Stop it, or give this one another folder."
            ) from error
        yield
    finally:
        os.close(descriptor)
