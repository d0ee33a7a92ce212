"""The one way to open a NumPy archive: it may be damaged, or somebody else's, and 3 MB of it may be 3 GB of zeros."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib.npyio import NpzFile

from splatpipe.pipeline.engine.files.small_file import open_regular

MAX_EXPANSION = 20.0  # maps, the only arrays that are stored compressed, have noise
FREE_BYTES = 1 << 29  # expansion allowed for files of any size: the map of a large photo may be empty


@contextmanager
def open_archive(path: Path) -> Iterator[NpzFile]:
    """Open an `.npz` file, whose arrays are read one by one.

    Raises:
        OSError: if it cannot be opened or is not a regular file.
        ValueError: if its arrays would take far more memory than its size justifies.
        TypeError: if it is a bare `.npy`; other errors of the readers of broken files pass through.
    """
    with open_regular(path) as file, np.load(file, allow_pickle=False) as archive:
        expanded = sum(member.file_size for member in archive.zip.infolist())  # zipfile reads no more than that
        if expanded > FREE_BYTES + MAX_EXPANSION * path.stat().st_size:
            raise ValueError(f"its arrays would take {expanded:,} bytes")
        yield archive


def read_archive(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Read all arrays of an `.npz` file, by name.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if it is damaged or not an archive.
    """
    try:
        with open_archive(path) as archive:
            return {name: archive[name] for name in archive.files}
    except OSError:
        raise
    except Exception as error:  # the zip, header and array readers raise almost anything on broken files
        raise ValueError(f"incomplete or damaged archive: {' '.join(str(error).split())[:120]}") from error
