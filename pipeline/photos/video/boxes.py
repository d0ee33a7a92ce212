"""The boxes of an MP4 or MOV film (ISO/IEC 14496-12, QuickTime): what OpenCV does not say, from untrusted bytes.

The whole index (``moov``) is read once and walked within limits; of the media, only the texts of a subtitle track are
read. A film that passes lists every frame, and each lies inside the file.
"""

from __future__ import annotations

import datetime
import math
import os
import re
import shlex
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.photos.files.names import printable

MAX_TOP_BOXES = 10_000  # a camera writes some ten
MAX_CHILDREN = 10_000
MAX_INDEX_BYTES = 128 << 20  # nine hours at 60 frames a second take half
MAX_TRACKS = 64
MAX_SAMPLES = 2_000_000  # frames of a film: nine hours at 60 frames a second
MAX_CUES = 500_000
MAX_CUE_BYTES = 4096
MAX_TAGS_BYTES = 1 << 20
FIRST_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot", b"uuid")
SUBTITLE_HANDLERS = (b"text", b"sbtl", b"subt")
SUBTITLE_FORMATS = (b"tx3g", b"text")
STILLS = ("jpeg", "png ", "mjpa")  # thumbnails, which cameras keep as a track
EPOCH = datetime.datetime(1904, 1, 1)  # zero of an MP4's times, UTC
LOCATION = re.compile(rb"([+-]\d{1,2}\.\d{1,12})([+-]\d{1,3}\.\d{1,12})(?:[+-]\d{1,6}(?:\.\d{1,9})?)?/?")  # ISO 6709
REFILM = "Copy it again from the camera's card; a repair tool may restore a recording that broke off."


@dataclass(frozen=True)
class Cue:
    """A subtitle: when it is shown, seconds from the film's start, and its text."""

    begin_s: float
    end_s: float
    text: str


@dataclass(frozen=True)
class Container:
    """What a film's container states.

    Attributes:
        codec: Four letters, such as ``avc1``.
        width: Of the stored frames, pixels.
        height: Likewise.
        frames: Their number.
        seconds: The film's length.
        turn_deg: By which a player turns the frames clockwise: 0, 90, 180 or 270.
        recorded: When the recording began, UTC; None if it is not stated.
        location: Latitude and longitude in degrees, one for the whole film; None if it is not stated.
        cues: Of its subtitle track.
    """

    codec: str
    width: int
    height: int
    frames: int
    seconds: float
    turn_deg: int
    recorded: datetime.datetime | None
    location: tuple[float, float] | None
    cues: tuple[Cue, ...]


class _BrokenError(Exception):
    """The boxes contradict each other or exceed a limit."""


def read_container(path: Path) -> Container:
    """Read what a film's container states, and check that all of its frames are there.

    Args:
        path: The film.

    Raises:
        SplatpipeError: if it is no MP4 or MOV film, is truncated, or lists no frame from which decoding can begin.
    """
    name = printable(path.name)
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            return _read(file, size, name)
    except OSError as error:
        raise SplatpipeError(f"{name} cannot be read: {error.strerror or error}.", hint="Check the file.") from error
    except (_BrokenError, struct.error, OverflowError) as error:
        raise SplatpipeError(f"{name} is damaged: its index contradicts itself.", hint=REFILM) from error


def _read(file: BufferedReader, size: int, name: str) -> Container:
    top = _top_boxes(file, size, name)
    if b"moof" in top:
        raise SplatpipeError(
            f"{name} is a fragmented MP4, which does not list its frames.",
            hint=f"Convert it: ffmpeg -i {shlex.quote(name)} -c copy whole.mp4",
        )
    start, end = top[b"moov"]
    if end - start > MAX_INDEX_BYTES:
        raise _BrokenError
    file.seek(start)
    index = _Box(file.read(end - start))
    tracks = [box for kind, box in index.children() if kind == b"trak"][:MAX_TRACKS]
    films = [track for track in map(_film_track, tracks) if track is not None]
    if not films:
        raise SplatpipeError(f"{name} has no pictures.", hint="Give a film, MP4 or MOV.")
    film = max(films, key=lambda each: (each.codec not in STILLS, each.samples.count))
    film.require_whole(size, name)
    header = index.first(b"mvhd")
    return Container(
        film.codec,
        film.width,
        film.height,
        film.samples.count,
        film.seconds,
        film.turn_deg,
        None if header is None else _recorded(header),
        _location(index),
        tuple(_subtitles(tracks, file, size)),
    )


def _top_boxes(file: BufferedReader, size: int, name: str) -> Mapping[bytes, tuple[int, int]]:
    """Where the content of each box begins and ends; of equal ones, the first."""
    found: dict[bytes, tuple[int, int]] = {}
    at = 0
    for _ in range(MAX_TOP_BOXES):
        if at >= size:
            break
        file.seek(at)
        head = file.read(16)
        length, kind, begin = int.from_bytes(head[:4], "big"), head[4:8], 8
        if length == 1:
            length, begin = int.from_bytes(head[8:16], "big"), 16
        elif length == 0 and kind in FIRST_BOXES:
            length = size - at  # it reaches to the end
        if at == 0 and (kind not in FIRST_BOXES or length < begin):
            raise SplatpipeError(f"{name} is no MP4 or MOV film, whatever its name says.", hint="Give an MP4 or MOV.")
        if len(kind) < 4 or length < begin or at + length > size:
            raise SplatpipeError(f"{name} is truncated: it ends before its last frame.", hint=REFILM)
        found.setdefault(kind, (at + begin, at + length))
        at += length
    if b"moov" not in found:
        raise SplatpipeError(f"{name} is truncated: it has no index of its frames (moov).", hint=REFILM)
    return found


@dataclass(frozen=True)
class _Box:
    """The content of a box."""

    data: bytes

    def children(self, begin: int = 0) -> Iterator[tuple[bytes, _Box]]:
        at = begin
        for _ in range(MAX_CHILDREN):
            if at + 8 > len(self.data):
                return
            length, kind = struct.unpack_from(">I4s", self.data, at)
            if length < 8 or at + length > len(self.data):
                return  # QuickTime ends a list with four zeros; anything else is not needed
            yield kind, _Box(self.data[at + 8 : at + length])
            at += length

    def first(self, *kinds: bytes) -> _Box | None:
        """The first box of a kind, down a path of kinds."""
        found: _Box | None = self
        for kind in kinds:
            assert found is not None
            found = next((box for each, box in found.children() if each == kind), None)
            if found is None:
                return None
        return found

    def table(self, begin: int, dtype: str, columns: int, limit: int) -> Int64[np.ndarray, "rows columns"]:
        """The rows of a table that a count precedes.

        Raises:
            _BrokenError: if there are more than fit into the box or than the limit.
        """
        (count,) = struct.unpack_from(">I", self.data, begin)
        width = np.dtype(dtype).itemsize * columns
        if count > limit or begin + 4 + count * width > len(self.data):
            raise _BrokenError
        return np.frombuffer(self.data, dtype, count * columns, begin + 4).astype(np.int64).reshape(count, columns)


@dataclass(frozen=True, eq=False)
class _Samples:
    """Where the samples of a track lie in the file, bytes."""

    offsets: Int64[np.ndarray, " n"]
    sizes: Int64[np.ndarray, " n"]

    @property
    def count(self) -> int:
        return len(self.sizes)


@dataclass(frozen=True, eq=False)
class _FilmTrack:
    codec: str
    width: int
    height: int
    samples: _Samples
    keys: int | None
    seconds: float
    turn_deg: int

    def require_whole(self, size: int, name: str) -> None:
        """Check that all frames lie in the file, and that decoding can begin at one of them."""
        ends = self.samples.offsets + self.samples.sizes
        if self.samples.count == 0 or self.keys == 0:
            what = "frames" if self.samples.count == 0 else "key frames: none of its frames can be decoded"
            raise SplatpipeError(f"{name} has no {what}.", hint=REFILM)
        if int(ends.max()) > size:
            raise SplatpipeError(f"{name} is truncated: it ends before its last frame.", hint=REFILM)


def _film_track(track: _Box) -> _FilmTrack | None:
    handler, table = track.first(b"mdia", b"hdlr"), track.first(b"mdia", b"minf", b"stbl")
    if handler is None or handler.data[8:12] != b"vide" or table is None:
        return None
    described = table.first(b"stsd")
    if described is None:
        raise _BrokenError
    codec = described.data[12:16].decode("latin-1")
    width, height = struct.unpack_from(">HH", described.data, 40)
    keys = table.first(b"stss")
    scale, length = _clock(track)
    return _FilmTrack(
        codec,
        width,
        height,
        _samples(table),
        None if keys is None else len(keys.table(4, ">u4", 1, MAX_SAMPLES)),
        length / scale,
        _turn(track.first(b"tkhd")),
    )


def _clock(track: _Box) -> tuple[int, int]:
    """Ticks per second, and the track's length in ticks."""
    header = track.first(b"mdia", b"mdhd")
    if header is None:
        raise _BrokenError
    scale, length = struct.unpack_from(
        *((">IQ", header.data, 20) if header.data[:1] == b"\1" else (">II", header.data, 12))
    )
    if scale == 0:
        raise _BrokenError
    return scale, length


def _samples(table: _Box) -> _Samples:
    sized, chunked, near = table.first(b"stsz"), table.first(b"stsc"), table.first(b"stco")
    far = table.first(b"co64")
    if sized is None or chunked is None or (near is None and far is None):
        raise _BrokenError
    (equal, count) = struct.unpack_from(">II", sized.data, 4)
    if count > MAX_SAMPLES:
        raise _BrokenError
    sizes = np.full(count, equal, np.int64) if equal else sized.table(8, ">u4", 1, MAX_SAMPLES)[:, 0]
    if near is not None:
        chunks = near.table(4, ">u4", 1, MAX_SAMPLES)[:, 0]
    else:
        assert far is not None
        chunks = far.table(4, ">i8", 1, MAX_SAMPLES)[:, 0]
    if count == 0:
        return _Samples(sizes, sizes)
    runs = chunked.table(4, ">u4", 3, MAX_SAMPLES)
    first = runs[:, 0] - 1
    if len(chunks) == 0 or len(runs) == 0 or first[0] != 0 or (np.diff(first) <= 0).any() or first[-1] >= len(chunks):
        raise _BrokenError
    if (chunks < 0).any():
        raise _BrokenError
    each = np.minimum(np.repeat(runs[:, 1], np.diff([*first, len(chunks)])), count)
    ends = np.cumsum(each)
    if ends[-1] < count:
        raise _BrokenError
    chunk = np.searchsorted(ends, np.arange(count), side="right")
    before = np.cumsum(sizes) - sizes
    return _Samples(chunks[chunk] + before - before[(ends - each)[chunk]], sizes)


def _turn(header: _Box | None) -> int:
    """The quarter turns of a track's matrix, degrees clockwise."""
    if header is None:
        return 0
    a, b = struct.unpack_from(">ii", header.data, 52 if header.data[:1] == b"\1" else 40)
    return 90 * round(math.degrees(math.atan2(b, a)) / 90.0) % 360


def _recorded(header: _Box) -> datetime.datetime | None:
    (seconds,) = struct.unpack_from(">Q" if header.data[:1] == b"\1" else ">I", header.data, 4)
    try:
        return EPOCH + datetime.timedelta(seconds=seconds) if seconds else None
    except OverflowError:
        return None


def _location(index: _Box) -> tuple[float, float] | None:
    """The first location in the film's tags."""
    for kind, box in index.children():
        found = LOCATION.search(box.data[:MAX_TAGS_BYTES]) if kind in (b"udta", b"meta") else None
        if found is not None:
            latitude, longitude = float(found[1]), float(found[2])
            if abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and (latitude, longitude) != (0.0, 0.0):
                return latitude, longitude
    return None


def _subtitles(tracks: list[_Box], file: BufferedReader, size: int) -> Iterator[Cue]:
    """The texts of the first subtitle track; a broken one has none."""
    for track in tracks:
        handler, table = track.first(b"mdia", b"hdlr"), track.first(b"mdia", b"minf", b"stbl")
        if handler is None or handler.data[8:12] not in SUBTITLE_HANDLERS or table is None:
            continue
        described, timed = table.first(b"stsd"), table.first(b"stts")
        if described is None or timed is None or described.data[12:16] not in SUBTITLE_FORMATS:
            continue
        try:
            scale, _ = _clock(track)
            samples, runs = _samples(table), timed.table(4, ">u4", 2, MAX_CUES)
            if samples.count > MAX_CUES or int(np.minimum(runs[:, 0], MAX_CUES).sum()) != samples.count:
                raise _BrokenError
        except (_BrokenError, struct.error):
            continue
        times = np.concatenate([[0], np.cumsum(np.repeat(runs[:, 1], runs[:, 0]))]) / scale
        for at in range(samples.count):
            begin, length = int(samples.offsets[at]), int(min(samples.sizes[at], MAX_CUE_BYTES))
            if begin + length > size:
                break
            file.seek(begin)
            text = _text(file.read(length))
            if text:
                yield Cue(float(times[at]), float(times[at + 1]), text)
        return


def _text(sample: bytes) -> str:
    """A sample's text, which its length precedes (3GPP TS 26.245)."""
    text = sample[2 : 2 + int.from_bytes(sample[:2], "big")]
    coding = "utf-16" if text[:2] in (b"\xfe\xff", b"\xff\xfe") else "utf-8"
    return text.decode(coding, errors="replace").strip()
