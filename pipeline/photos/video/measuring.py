"""Measure a whole film, and keep what was measured of it, so that a killed run goes on where it was."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.small_file import read_small
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.photos.files.names import printable
from splatpipe.pipeline.photos.video.boxes import REFILM, Container
from splatpipe.pipeline.photos.video.motion import ROW, TRACKED_SIDE, FilmMeter, Measures

MEASURED_FPS = 15.0  # frames per second that are measured: of a faster film every second, third or further one
MIN_DECODED_SHARE = 0.98  # least share of the listed frames that decode in an undamaged film
KEEP_S = 5.0  # seconds of measuring that a kill loses at most
MAX_KEPT_BYTES = 256 << 20  # a film of 2 million frames has 192 MB of measures


@contextmanager
def open_film(film: Path, threads: int) -> Iterator[cv2.VideoCapture]:
    """Open a film; its frames are not turned for display."""
    capture = cv2.VideoCapture(str(film), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, max(1, threads)])
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    try:
        yield capture
    finally:
        capture.release()


def measure_film(film: Path, container: Container, threads: int, report: Reporter, kept: Path | None) -> Measures:
    """Measure a film's frames, at most ``MEASURED_FPS`` a second.

    Args:
        film: The film.
        container: What its container states.
        threads: For decoding.
        report: Receives the progress.
        kept: File of what was measured; one that a killed run left is gone on with. None: nothing is kept.

    Raises:
        SplatpipeError: if it cannot be decoded, or a part of it is damaged.
    """
    name, decoded = printable(film.name), 0
    meter = FilmMeter() if kept is None else load_meter(kept)
    begun, saved_s = meter.begun, time.monotonic()
    fps = container.frames / container.seconds if container.seconds > 0.0 else MEASURED_FPS
    stride = max(1, round(fps / MEASURED_FPS))
    with open_film(film, threads) as capture:
        while decoded < container.frames and capture.grab():  # seeking would land on other frames
            number, decoded = decoded, decoded + 1
            if number % stride:
                continue
            report.progress(decoded, container.frames, "measuring the film", "frames")
            if number < begun:
                continue
            time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
            read, pixels = capture.retrieve()
            if read and pixels is not None and pixels.ndim == 3:
                meter.add(number, time_s, np.asarray(pixels, np.uint8))
            if kept is not None and time.monotonic() - saved_s > KEEP_S:
                save_meter(meter, kept)
                saved_s = time.monotonic()
    if not meter.rows:
        raise SplatpipeError(
            f"None of the {container.frames:,} frames of {name} can be decoded: it has no key frame, or a codec "
            f"({printable(container.codec)}) that OpenCV lacks.",
            hint=f"If it plays, convert it: ffmpeg -i {shlex.quote(name)} -c:v libx264 -crf 16 readable.mp4; "
            "else copy it again.",
        )
    if decoded < MIN_DECODED_SHARE * container.frames:
        raise SplatpipeError(
            f"{name} is damaged: only {decoded:,} of its {container.frames:,} frames can be decoded.", hint=REFILM
        )
    if kept is not None:
        save_meter(meter, kept)
    return meter.measures()


def save_meter(meter: FilmMeter, path: Path) -> None:
    """Write what was measured so far: a line of JSON, the rows as float64, the last picture."""
    table = np.array(meter.rows, "<f8").reshape(-1, ROW)
    picture = np.zeros((0, 0), np.uint8) if meter.last is None else meter.last
    head = {"rows": len(table), "picture": list(picture.shape), "waited": meter.waited}

    def write(file: IO[bytes]) -> None:
        file.write(json.dumps(head).encode() + b"\n" + table.tobytes() + picture.tobytes())

    write_durably(path, write)


def load_meter(path: Path) -> FilmMeter:
    """Read what ``save_meter`` wrote; measuring begins anew if the file is missing or not whole."""
    try:
        line, _, body = read_small(path, MAX_KEPT_BYTES).partition(b"\n")
        head = json.loads(line)
        rows, (height, width), waited = int(head["rows"]), map(int, head["picture"]), int(head["waited"])
    except (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return FilmMeter()
    sound = rows > 0 and 0 < height <= TRACKED_SIDE and 0 < width <= TRACKED_SIDE and waited >= 0
    if not sound or len(body) != 8 * ROW * rows + height * width:
        return FilmMeter()
    table = np.frombuffer(body, "<f8", ROW * rows).reshape(rows, ROW).astype(np.float64)
    picture = np.frombuffer(body, np.uint8, offset=8 * ROW * rows).reshape(height, width)
    numbers = table[:, 0]
    if not (np.isfinite(table[:, :3]).all() and (np.diff(numbers) >= 1.0).all() and numbers[0] >= 0.0):
        return FilmMeter()
    return FilmMeter(list(table), picture.copy(), waited)
