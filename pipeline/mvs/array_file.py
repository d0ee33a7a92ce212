"""Arrays in a file, as work under way is kept: there whole or not at all, however a process ends."""

from __future__ import annotations

from pathlib import Path
from typing import IO

import numpy as np

from splatpipe.pipeline.engine.durable import write_durably


def save_arrays(path: Path, **arrays: np.ndarray) -> None:
    """Write arrays by their names, for ``np.load``.

    Args:
        path: An `.npz` in a working folder: a killed process leaves an unfinished one beside it.
        arrays: What it holds.

    Raises:
        OSError: if the disk is full or not writable.
    """

    def write(file: IO[bytes]) -> None:
        np.savez(file, **arrays)  # type: ignore[arg-type]

    write_durably(path, write)
