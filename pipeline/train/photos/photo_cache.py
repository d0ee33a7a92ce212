"""Decoded photos on the disk, read through windows."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.images import Mask, Pixels
from splatpipe.pipeline.photos.pixels.mapped_file import MappedFile, whole_pages
from splatpipe.pipeline.train.plan.windows import PixelRectangle


@dataclass(frozen=True)
class _CachedPhoto:
    offset: int
    camera: Camera
    has_mask: bool
    valid_pixels: int


def stored_bytes(camera: Camera, has_mask: bool) -> int:
    """Bytes that a photo takes in the file: three per pixel, one more with a mask, rounded up to whole pages."""
    return whole_pages(camera.width * camera.height * (4 if has_mask else 3))


class PhotoCache:
    """8-bit photos in a ``MappedFile``, each stored once and read any number of times.

    Args:
        folder: Folder on the disk to use.

    Attributes:
        room_bytes: Maximum file size, from the disk's free space at creation.

    Raises:
        MachineError: if the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._slots: dict[tuple[int, int], _CachedPhoto] = {}
        self._end = 0
        with self._explained():
            self._file = MappedFile(folder)
        self.room_bytes = self._file.room_bytes

    def close(self) -> None:
        """Free the disk space. Arrays already read stay valid."""
        self._file.close()

    def put(self, key: tuple[int, int], camera: Camera, colour: Pixels, mask: Mask | None) -> None:
        """Store a photo if it fits in ``room_bytes``; otherwise nothing happens.

        Args:
            key: Key of the photo.
            camera: The photo's camera, at this size.
            colour: (h, w, 3), contiguous.
            mask: (h, w), contiguous.

        Raises:
            MachineError: if the disk is full nevertheless, or fails.
        """
        valid_pixels = camera.width * camera.height if mask is None else int(np.count_nonzero(mask))
        slot = _CachedPhoto(self._end, camera, mask is not None, valid_pixels)
        if not self.has_room(camera, slot.has_mask):
            return
        with self._explained():
            self._file.write(colour, slot.offset)
            if mask is not None:
                self._file.write(mask, slot.offset + colour.nbytes)
        self._slots[key] = slot
        self._end = slot.offset + stored_bytes(camera, slot.has_mask)

    def has_room(self, camera: Camera, has_mask: bool) -> bool:
        """Whether there is room for a photo."""
        return self._end + stored_bytes(camera, has_mask) <= self.room_bytes

    def __contains__(self, key: tuple[int, int]) -> bool:
        """Whether a photo is stored."""
        return key in self._slots

    def valid_pixels(self, key: tuple[int, int]) -> int:
        """How many pixels of a stored photo count."""
        return self._slots[key].valid_pixels

    def get(self, key: tuple[int, int], frame: PixelRectangle) -> tuple[Pixels, Mask | None]:
        """A window of a stored photo.

        The arrays are read-only views of the file, of which only the window's rows are mapped; the mapping ends with
        the last of them.

        Args:
            key: Key of a stored photo.
            frame: The window, in the photo's pixels.

        Raises:
            MachineError: if the file cannot be mapped.
        """
        slot = self._slots[key]
        height, width = slot.camera.height, slot.camera.width
        columns = slice(frame.left, frame.right)
        colour = self._rows(slot.offset, frame, 3 * width).reshape(frame.height, width, 3)[:, columns]
        if not slot.has_mask:
            return colour, None
        return colour, self._rows(slot.offset + 3 * width * height, frame, width).view(np.bool_)[:, columns]

    def _rows(self, offset: int, frame: PixelRectangle, row_bytes: int) -> UInt8[np.ndarray, "rows bytes"]:
        """A frame's rows of the plane at ``offset`` in the file."""
        with self._explained():
            rows = self._file.read(offset + frame.top * row_bytes, frame.height * row_bytes)
        return rows.reshape(frame.height, row_bytes)

    @contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise MachineError(
                f"The decoded photos cannot be kept in {self._folder}: {error.strerror}.",
                hint="Free some space or check the permissions, then run again: it resumes from here.",
            ) from error
