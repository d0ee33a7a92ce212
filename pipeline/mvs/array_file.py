"""Array files for work in progress: complete or absent, however a process ends."""

from __future__ import annotations

from pathlib import Path
from typing import IO

import numpy as np

from splatpipe.pipeline.engine.files.durable import write_durably


def save_arrays(path: Path, **arrays: np.ndarray) -> None:
    """Write named arrays for ``np.load``.

    Args:
        path: An `.npz` in a working folder: a killed process leaves an unfinished file beside it.
        arrays: The arrays, by name.

    Raises:
        OSError: if the disk is full or not writable.
    """

    def write(file: IO[bytes]) -> None:
        np.savez(file, **arrays)  # type: ignore[arg-type]

    write_durably(path, write)
