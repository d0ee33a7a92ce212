"""A run's cloud, read in pieces."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import laspy
import lazrs

from splatpipe.pipeline.engine.errors import SplatpipeError

ROWS = 1 << 18  # points read at a time


@contextmanager
def open_cloud(path: Path) -> Iterator[laspy.LasReader]:
    """Open a LAS or LAZ file for reading.

    Raises:
        SplatpipeError: if it cannot be read, also while it is.
    """
    try:
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
            yield reader
    except (laspy.errors.LaspyException, lazrs.LazrsError, EOFError) as error:
        raise SplatpipeError(f"{path} cannot be read: {error}", "Make it again with --rerun cloud.") from error


def cloud_pieces(path: Path) -> Iterator[laspy.ScaleAwarePointRecord]:
    """The points of a file, ``ROWS`` at a time.

    Raises:
        SplatpipeError: as ``open_cloud``.
    """
    with open_cloud(path) as reader:
        yield from reader.chunk_iterator(ROWS)
