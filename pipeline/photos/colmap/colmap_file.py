"""Step through COLMAP's binary files, which somebody else may have written.

The format is that of COLMAP's documentation ("Output format", binary): little-endian, lengths first. Lengths
are checked against the file's size before memory is allocated.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

CAMERAS, IMAGES, POINTS = "cameras.bin", "images.bin", "points3D.bin"
LONGEST_NAME_BYTES = 4096
COUNT = struct.Struct("<Q")
CAMERA = struct.Struct("<IiQQ")
IMAGE = struct.Struct("<I4d3dI")
POINT = struct.Struct("<Q3d3BdQ")  # ends with the length of the track
XYZ_AT, XYZ_BYTES = 8, 24  # offset and size, in bytes, of a point's coordinates in its record
_TRACK_LENGTH = struct.Struct("<43xQ")  # reads a point's track length, the last 8 of its 51 bytes
OBSERVATION = np.dtype([("xy", "<f8", (2,)), ("point", "<i8")])
ELEMENT_BYTES = 8  # bytes of a track's element: image and keypoint number, 32 bits each
POINTS_AT_ONCE = 1 << 16


class ModelFile:
    """Sequential reader of an untrusted file.

    Raises:
        OSError: if it cannot be read.
        ValueError: from here and from all methods: if it is broken.
    """

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            self._data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        self._name, self._at = path.name, 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Read one entry."""
        start = self._at
        self.skip(layout.size)
        return layout.unpack_from(self._data, start)

    def skip(self, length: int) -> None:
        """Go on by so many bytes."""
        if length > len(self._data) - self._at:
            raise ValueError(f"{self._name} ends too early")
        self._at += length

    def count(self, least_bytes: int) -> int:
        """Read a number of entries, each of which takes at least ``least_bytes``."""
        (number,) = self.take(COUNT)
        if number * least_bytes > len(self._data) - self._at:
            raise ValueError(f"{self._name} claims {number} entries, more than it has bytes for")
        return int(number)

    def array(self, kind: np.dtype[np.void]) -> np.ndarray:
        """Read an array of entries, preceded by their number."""
        number = self.count(kind.itemsize)
        start = self._at
        self.skip(number * kind.itemsize)
        return np.frombuffer(self._data, kind, number, start)

    def name(self) -> str:
        """Read a zero-terminated text."""
        window = bytes(self._data[self._at : self._at + LONGEST_NAME_BYTES])
        length = window.find(0)
        if length < 0:
            raise ValueError(f"{self._name} has a name without an end")
        self._at += length + 1
        return window[:length].decode("utf-8")  # UnicodeDecodeError is a ValueError

    def positions(self) -> Iterator[Float64[np.ndarray, "n 3"]]:
        """Step over the points of `points3D.bin`; yields the positions of many at a time."""
        left = self.count(POINT.size)
        if left == 0:
            return
        at, data, length_of = self._at, self._data, _TRACK_LENGTH.unpack_from
        windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), XYZ_BYTES)
        while left > 0:
            starts = []
            try:
                for _ in range(min(left, POINTS_AT_ONCE)):  # a large file's time is spent here
                    starts.append(at)
                    at += POINT.size + ELEMENT_BYTES * length_of(data, at)[0]
            except (struct.error, OverflowError) as error:  # beyond the end
                raise ValueError(f"{self._name} ends too early") from error
            left -= len(starts)
            yield windows[np.array(starts) + XYZ_AT].view("<f8")
        self.skip(at - self._at)

    def end(self) -> None:
        """Check that nothing is left."""
        if self._at != len(self._data):
            raise ValueError(f"{self._name} goes on after its last entry")
