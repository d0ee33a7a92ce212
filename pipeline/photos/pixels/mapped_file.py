"""Decoded pixels in an unnamed file: written once, and mapped only while they are in use."""

from __future__ import annotations

import mmap
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from splatpipe.pipeline.photos.pixels.images import Mask, Pixels

SHARE_OF_FREE = 0.5  # largest share of the disk's free space: the files that are made need room too


def whole_pages(size_bytes: int) -> int:
    """A size rounded up to whole pages, bytes."""
    return -(-size_bytes // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY


class MappedFile:
    """An unnamed file of bytes.

    The system frees it when it is closed or the process dies in any way; another run never sees it. Mapped pages count
    as the process's memory, so that only what is in use is mapped.

    Args:
        folder: Folder on the disk to use.

    Attributes:
        room_bytes: Maximum size of the file, from the disk's free space at creation; to be observed by the caller.

    Raises:
        OSError: if the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.room_bytes = int(SHARE_OF_FREE * shutil.disk_usage(folder).free)
        self._file = tempfile.TemporaryFile(dir=folder, prefix="pixels-", buffering=0)  # noqa: SIM115

    def close(self) -> None:
        """Free the disk space. Arrays already read stay valid."""
        self._file.close()

    def write(self, data: Pixels | Mask, offset: int) -> None:
        """Write a contiguous array.

        Raises:
            OSError: if the disk is full or fails.
        """
        rest = data.data.cast("B")
        while rest:
            written = os.pwrite(self._file.fileno(), rest, offset)
            rest, offset = rest[written:], offset + written

    def read(self, offset: int, length: int) -> UInt8[np.ndarray, " n"]:
        """Map bytes, read-only; the mapping ends with the last array that uses it.

        Raises:
            OSError: if they cannot be mapped.
        """
        before = offset % mmap.ALLOCATIONGRANULARITY
        mapped = mmap.mmap(self._file.fileno(), before + length, access=mmap.ACCESS_READ, offset=offset - before)
        return np.frombuffer(mapped, np.uint8, length, before)
