"""Decoded photos on the disk: each is decoded once, however many tiles need it."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from itertools import accumulate
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from splatpipe.pipeline.photos.pixels.mapped_file import MappedFile, whole_pages
from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource, load_pixels


@contextmanager
def pixels_on_disk(sources: Sequence[PhotoSource], folder: Path, held_bytes: int) -> Iterator[list[PhotoSource]]:
    """Photos that are decoded on first use and mapped from a file afterwards.

    A tile sees dozens of photos and memory holds a few: without this, all would be decoded again for each tile.

    Args:
        sources: The photos.
        folder: A folder on the disk to use.
        held_bytes: Memory for photos: if all fit into it, or the disk has no room, the photos are returned unchanged.

    Raises:
        OSError: if the disk is not writable; on loading, if it is full.
        ValueError: on loading, if pixels do not have their photo's size.
    """
    starts = list(accumulate((_stored_bytes(source) for source in sources), initial=0))
    with closing(MappedFile(folder)) as file:
        if not held_bytes < starts[-1] <= file.room_bytes:
            yield list(sources)
            return
        yield [
            replace(source, load=_PhotoSlot(source, file, start).load)
            for source, start in zip(sources, starts, strict=False)
        ]


def _stored_bytes(source: PhotoSource) -> int:
    """A photo's size in the file, in whole pages: no two photos share one."""
    width, height = source.size
    return whole_pages(width * height * 3)


@dataclass
class _PhotoSlot:
    """A photo's place in the file.

    Attributes:
        source: The photo.
        file: The file.
        start: Offset of its first byte.
        lock: Held while it is written.
        written: Whether it has been written.
    """

    source: PhotoSource
    file: MappedFile
    start: int
    lock: threading.Lock = field(default_factory=threading.Lock)
    written: bool = False

    def load(self) -> UInt8[np.ndarray, "h w 3"]:
        """Map the photo, after writing it the first time."""
        with self.lock:
            if not self.written:
                self.file.write(np.ascontiguousarray(load_pixels(self.source)[0]), self.start)
                self.written = True
        width, height = self.source.size
        return self.file.read(self.start, width * height * 3).reshape(height, width, 3)
