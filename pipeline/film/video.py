"""Video files that browsers play, written through OpenCV: VP8 in WebM, or VP9 in MP4.

Both are patent-free. OpenCV sets a bit rate of one bit per pixel for either and offers no effort setting: VP9 then
takes four times as long as VP8 for a file a fifth smaller at the same quality.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.files.output_file import open_own, token, write_file
from splatpipe.pipeline.photos.pixels.images import Pixels

CODECS = {".webm": "VP80", ".mp4": "vp09"}
HEADER_BYTES = 4096  # start of a WebM that contains its track number
TRACK_NUMBERS = (b"\x73\xc5\x88", b"\x63\xc5\x88")  # Matroska's TrackUID and TagTrackUID, each of eight bytes


class VideoWriter:
    """Writes frames to a video file; a context manager. The file appears complete at the end, or not at all.

    Frames are encoded on a separate thread while the caller makes the next one. The same frames give the same bytes.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: int) -> None:
        """Begin a film.

        Args:
            path: Ends in `.webm` or `.mp4`; its folder exists. An existing file is replaced at the end.
            size: Width and height, pixels, both even.
            fps: Frames per second.

        Raises:
            ValueError: if a side is odd, or the suffix is not supported.
            MachineError: if the file cannot be written.
        """
        if size[0] % 2 or size[1] % 2:
            raise ValueError(f"a film of {size[0]} × {size[1]} pixels: its colours have half of each side")
        if path.suffix not in CODECS:
            raise ValueError(f"{path.name} is not a film file")
        self._path, self._size, self._fps = path.absolute(), size, fps
        for left in self._path.parent.glob(f".{glob.escape(self._path.stem)}.{'?' * 16}.part{path.suffix}"):
            left.unlink()  # left by a killed process
        self._partial = self._path.with_name(f".{self._path.stem}.{token()}.part{path.suffix}")
        self._frames = 0
        try:
            write_file(self._partial, b"")  # OpenCV would not report why it cannot
        except OSError as error:
            raise MachineError(
                f"Cannot write {path}: {error.strerror}.", hint="Check the folder, its permissions and the free space."
            ) from error
        codec = cv2.VideoWriter.fourcc(*CODECS[path.suffix])
        with _silent():  # suppresses a warning about WebM's tag for VP8
            self._writer = cv2.VideoWriter(str(self._partial), cv2.CAP_FFMPEG, codec, float(fps), size)
        if not self._writer.isOpened():
            self._partial.unlink()
            raise MachineError(
                f"This OpenCV cannot write {path.suffix} films.", hint="Install opencv-contrib-python-headless."
            )
        self._thread = ThreadPoolExecutor(1)
        self._waiting: Future[None] | None = None

    def write(self, pixels: Pixels) -> None:
        """Add a frame, (h, w, 3) RGB, 8 bits, of the film's size."""
        assert pixels.shape == (self._size[1], self._size[0], 3), pixels.shape
        ordered = np.ascontiguousarray(pixels[:, :, ::-1])
        if self._waiting is not None:
            self._waiting.result()
        self._waiting = self._thread.submit(self._writer.write, ordered)
        self._frames += 1

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _error: BaseException | None, _traceback: TracebackType | None
    ) -> None:
        self._thread.shutdown()
        self._writer.release()
        if kind is not None:
            with suppress(OSError):
                self._partial.unlink()
            return
        self._check()
        if self._path.suffix == ".webm":
            self._number_track()
        self._partial.replace(self._path)

    def _check(self) -> None:
        """Decode the film once, because OpenCV does not report a full disk; takes a thirtieth of the writing time."""
        film = cv2.VideoCapture(str(self._partial), cv2.CAP_FFMPEG)
        size = (round(film.get(cv2.CAP_PROP_FRAME_WIDTH)), round(film.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        frames = 0
        while film.grab():
            frames += 1
        film.release()
        if (size, frames) != (self._size, self._frames):
            with suppress(OSError):
                self._partial.unlink()
            raise MachineError(
                f"The film {self._path.name} could not be written completely.",
                hint="Is the disk full? Free some space and run again.",
            )

    def _number_track(self) -> None:
        """Replace the random track number by 1, so that the same frames give the same bytes."""
        with os.fdopen(open_own(self._partial, os.O_RDWR), "r+b") as file:
            head = file.read(HEADER_BYTES)
            for element in TRACK_NUMBERS:
                at = head.find(element)
                if at >= 0:
                    file.seek(at + len(element))
                    file.write((1).to_bytes(8, "big"))


@contextmanager
def _silent() -> Iterator[None]:
    """Suppress stderr, including output from C."""
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("wb") as nothing:
            os.dup2(nothing.fileno(), 2)
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
