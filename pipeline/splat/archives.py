"""NumPy archives that may be broken."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatpipe.pipeline.engine.small_file import open_regular


def read_archive(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Read all arrays of an `.npz` file, by name.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if it is damaged or not an archive.
    """
    with open_regular(path) as file:
        try:
            with np.load(file, allow_pickle=False) as archive:  # a bare `.npy` is not a context manager: TypeError
                return {name: archive[name] for name in archive.files}
        except OSError:
            raise
        except Exception as error:  # the zip, header and array readers raise almost anything on broken files
            raise ValueError(f"incomplete or damaged archive: {' '.join(str(error).split())[:120]}") from error
