"""Decoded photos in an unnamed temporary file: each is decoded once, however many tiles need it."""

from __future__ import annotations

import mmap
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource, load_pixels

SHARE_OF_FREE = 0.5  # share of the disk's free space that it may take: the files that are made need room, too


@contextmanager
def pixels_on_disk(sources: Sequence[PhotoSource], folder: Path, held_bytes: int) -> Iterator[list[PhotoSource]]:
    """Photos that are decoded on first use and memory-mapped from a file afterwards.

    A tile sees dozens of photos and memory holds a few: without this, all would be decoded again for each tile. The
    file has no name, so it disappears with its process, however that ends.

    Args:
        sources: The photos.
        folder: A folder on the disk to use.
        held_bytes: Memory for photos: if all fit into it, or the disk has no room, the photos are returned unchanged.

    Raises:
        OSError: if the disk is not writable; on loading, if it is full.
        ValueError: on loading, if pixels do not have their photo's size.
    """
    starts = list(accumulate((_pages(source) for source in sources), initial=0))
    if not held_bytes < starts[-1] <= SHARE_OF_FREE * shutil.disk_usage(folder).free:
        yield list(sources)
        return
    with tempfile.TemporaryFile(dir=folder, prefix="pixels-", buffering=0) as file:
        yield [
            replace(source, load=_PhotoSlot(source, file.fileno(), start, threading.Lock()).load)
            for source, start in zip(sources, starts, strict=False)
        ]


def _pages(source: PhotoSource) -> int:
    """A photo's size in the file, in bytes: whole pages, as memory mapping requires."""
    width, height = source.size
    return -(-width * height * 3 // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY


@dataclass
class _PhotoSlot:
    """A photo's place in the file.

    Attributes:
        source: The photo.
        file: Descriptor of the open file.
        start: Offset of its first byte.
        lock: Held while it is written.
        written: Whether it has been written.
    """

    source: PhotoSource
    file: int
    start: int
    lock: threading.Lock
    written: bool = False

    def load(self) -> UInt8[np.ndarray, "h w 3"]:
        """Map the photo, after writing it the first time."""
        with self.lock:
            if not self.written:
                self._write(load_pixels(self.source)[0])
                self.written = True
        width, height = self.source.size
        mapped = mmap.mmap(self.file, width * height * 3, offset=self.start, access=mmap.ACCESS_READ)
        return np.frombuffer(mapped, np.uint8).reshape(height, width, 3)

    def _write(self, pixels: UInt8[np.ndarray, "h w 3"]) -> None:
        rest = memoryview(np.ascontiguousarray(pixels).data).cast("B")
        at = self.start
        while rest:
            done = os.pwrite(self.file, rest, at)
            at, rest = at + done, rest[done:]
