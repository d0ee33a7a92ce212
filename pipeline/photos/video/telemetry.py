"""Positions along a film: from DJI's subtitles, in a file beside the film or in a track of it; untrusted.

They come several times a second or once, in several forms::

    [latitude: 47.84119] [longitude: 13.51269] [rel_alt: 32.100 abs_alt: 547.213]
    [latitude : 47.84119] [longtitude : 13.51269] [altitude: 547.2]
    HOME(13.5126,47.8411) 2017.08.05 14:11:51 GPS(13.5126,47.8411,16) BAROMETER:32.1
    F/2.8, SS 206, ISO 150, EV 0, GPS (13.5126, 47.8411, 10), D 2.80m, H 32.10m, H.S 0.00m/s
    F/6.3, RTK (13.512690, 47.841190, 28), HOME (13.5127, 47.8412, 515.00m), D 75.36m, H 32.19m

In ``GPS(…)`` longitude comes first, and the third number counts satellites in some models and is an altitude in others:
it is not used.
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.photos.video.boxes import MAX_CUE_BYTES, MAX_CUES, Cue

NUMBER = r"([-+]?\d{1,6}(?:\.\d{1,12})?)(?![\d.eE])"
VALUE = r"([-+]?\d{1,6}(?:[.,]\d{1,12})?)(?![\d.eE])"  # alone, so that a comma before digits is a decimal one
LATITUDE = re.compile(rf"\blatitude\s{{0,3}}:\s{{0,3}}{VALUE}", re.IGNORECASE)
LONGITUDE = re.compile(rf"\blongt?itude\s{{0,3}}:\s{{0,3}}{VALUE}", re.IGNORECASE)  # DJI writes both
GPS = re.compile(
    rf"\b(?:GPS|RTK)\s{{0,3}}\(\s{{0,3}}([NSEW])?[\s:]{{0,3}}{NUMBER}\s{{0,3}},\s{{0,3}}([NSEW])?[\s:]{{0,3}}{NUMBER}",
    re.IGNORECASE,
)
ALTITUDE = re.compile(rf"\b(?:abs_alt|altitude)\s{{0,3}}:\s{{0,3}}{VALUE}", re.IGNORECASE)
HEIGHT = re.compile(
    rf"\b(?:rel_alt|BAROMETER)\s{{0,3}}:\s{{0,3}}{VALUE}|(?<![\w.])H\s{{1,3}}([-+]?\d{{1,6}}(?:\.\d{{1,6}})?)m", re.I
)
FOCAL = re.compile(rf"\bfocal_len\s{{0,3}}:\s{{0,3}}{VALUE}", re.IGNORECASE)
DATE = re.compile(r"\b(\d{4})[-.](\d{2})[-.](\d{2})[ T](\d{1,2}):(\d{2}):(\d{2})(?:[.,](\d{1,3}))?")
SHOWN = re.compile(r"(\d{1,3}):(\d{2}):(\d{2})[,.](\d{1,3})\s{0,9}-->\s{0,9}(\d{1,3}):(\d{2}):(\d{2})[,.](\d{1,3})")
MAX_FILE_BYTES = 512 << 20  # an hour at 60 frames a second takes 80 MB
MAX_LINE_BYTES = 4096
FOCAL_MM = (10.0, 200.0)  # 35 mm equivalents of drones' cameras; ten times as much is tenths
STALE_S = 2.0  # a position that is repeated longer is one where the drone stood
MAX_GAP_S = 5.0  # between a frame and the nearest position
MAX_ROUNDED_DECIMALS = 4  # decimals of degrees, 11 m, up to which positions are noticeably rounded
METRES_PER_DEGREE = 111_320.0
RECEIVER_M = 3.0  # as for photos of a drone without RTK


@dataclass(frozen=True)
class Fix:
    """A position on the way.

    Attributes:
        time_s: From the film's start.
        latitude: Degrees north, WGS84.
        longitude: Degrees east, WGS84.
        altitude_m: As stated, in an unknown datum; None without one.
        height_m: Above the take-off point; None without one.
        decimals: Of its degrees.
        recorded: Local time; None without one.
        focal_mm: 35 mm equivalent; None without one.
    """

    time_s: float
    latitude: float
    longitude: float
    altitude_m: float | None = None
    height_m: float | None = None
    decimals: int = 6
    recorded: datetime.datetime | None = None
    focal_mm: float | None = None


@dataclass(frozen=True)
class Place:
    """Where a frame was taken; attributes as of ``Fix``, and the standard deviation if it is not a receiver's usual."""

    latitude: float
    longitude: float
    altitude_m: float | None
    height_m: float | None
    sigma_m: float | None


def read_subtitles(path: Path) -> Iterator[Cue]:
    """Read a subtitle file (SRT), line by line.

    Raises:
        OSError: if it cannot be read.
    """
    interval: tuple[float, float] | None = None
    lines: list[str] = []
    read = cues = kept = 0
    with open_regular(path) as file:
        while line := file.readline(MAX_LINE_BYTES):
            read += len(line)
            text = line.decode("utf-8", errors="replace").strip()
            found = SHOWN.search(text)
            if found is None:
                if kept < MAX_CUE_BYTES:
                    lines.append(text)
                    kept += len(text) + 1
                continue
            if interval is not None:
                yield Cue(*interval, "\n".join(lines))
                cues += 1
            if read > MAX_FILE_BYTES or cues >= MAX_CUES:
                return
            numbers = [int(each) for each in found.groups()]
            interval, lines = (_seconds(numbers[:4], found[4]), _seconds(numbers[4:], found[8])), []
            kept = 0
    if interval is not None:
        yield Cue(*interval, "\n".join(lines))


def _seconds(numbers: Sequence[int], decimals: str) -> float:
    hours, minutes, seconds, fraction = numbers
    return 3600.0 * hours + 60.0 * minutes + seconds + fraction / 10.0 ** len(decimals)


def read_fixes(cues: Iterable[Cue], near: tuple[float, float] | None = None) -> list[Fix]:
    """The positions that subtitles state, in order of time; none of (0, 0), which a receiver without a fix states.

    Args:
        cues: The subtitles.
        near: The film's one location, latitude and longitude; it decides which of two coordinates is the latitude.
    """
    found = sorted((fix for cue in cues if (fix := _fix(cue)) is not None), key=lambda fix: fix.time_s)
    if near is not None and found and _is_swapped(found[0], near):
        found = [_with_place(fix, fix.longitude, fix.latitude) for fix in found]
    return [fix for fix in found if abs(fix.latitude) <= 90.0]


def _is_swapped(fix: Fix, near: tuple[float, float]) -> bool:
    as_read = math.hypot(fix.latitude - near[0], fix.longitude - near[1])
    return math.hypot(fix.longitude - near[0], fix.latitude - near[1]) < as_read


def _with_place(fix: Fix, latitude: float, longitude: float) -> Fix:
    return Fix(fix.time_s, latitude, longitude, fix.altitude_m, fix.height_m, fix.decimals, fix.recorded, fix.focal_mm)


def _fix(cue: Cue) -> Fix | None:
    text = cue.text[:MAX_CUE_BYTES]
    place = _degrees(text)
    if place is None:
        return None
    latitude, longitude, decimals = place
    if abs(latitude) > 90.0 >= abs(longitude):
        latitude, longitude = longitude, latitude
    if abs(latitude) > 180.0 or abs(longitude) > 180.0 or (latitude, longitude) == (0.0, 0.0):
        return None
    height = HEIGHT.search(text)
    return Fix(
        cue.begin_s,
        latitude,
        longitude,
        _number(ALTITUDE.search(text)),
        None if height is None else _float(height[1] or height[2]),
        decimals,
        _date(text),
        _focal(_number(FOCAL.search(text))),
    )


def _degrees(text: str) -> tuple[float, float, int] | None:
    """Latitude, longitude, and how many decimals they have."""
    latitude, longitude = LATITUDE.search(text), LONGITUDE.search(text)
    if latitude is not None and longitude is not None:
        return _float(latitude[1]), _float(longitude[1]), max(map(_decimals, (latitude[1], longitude[1])))
    found = GPS.search(text)
    if found is None:
        return None
    first, second = (
        -float(number) if (letter or "").upper() in ("S", "W") else float(number)
        for letter, number in ((found[1], found[2]), (found[3], found[4]))
    )
    decimals = max(map(_decimals, (found[2], found[4])))
    return (
        (first, second, decimals) if (found[1] or "").upper() in ("N", "S") and found[1] else (second, first, decimals)
    )


def _decimals(number: str) -> int:
    return len(number.replace(",", ".").partition(".")[2])


def _float(number: str) -> float:
    return float(number.replace(",", "."))


def _number(found: re.Match[str] | None) -> float | None:
    return None if found is None else _float(found[1])


def _focal(stated: float | None) -> float | None:
    if stated is None:
        return None
    focal = stated / 10.0 if stated > FOCAL_MM[1] else stated
    return focal if FOCAL_MM[0] <= focal <= FOCAL_MM[1] else None


def _date(text: str) -> datetime.datetime | None:
    found = DATE.search(text)
    if found is None:
        return None
    try:
        date = datetime.datetime(*(int(part) for part in found.groups()[:6]))  # type: ignore[arg-type]
    except ValueError:
        return None
    return date + datetime.timedelta(seconds=float(f"0.{found[7] or 0}"))


class FlightPath:
    """Positions between fixes, by straight lines.

    A position that is repeated in the next cues, as its receiver is slower than the film, counts once.

    Args:
        fixes: In order of time.
    """

    def __init__(self, fixes: Sequence[Fix]) -> None:
        kept: list[Fix] = []
        for fix in fixes:
            again = bool(kept) and (kept[-1].latitude, kept[-1].longitude) == (fix.latitude, fix.longitude)
            if not again or fix.time_s - kept[-1].time_s > STALE_S:
                kept.append(fix)
        self.fixes = tuple(kept)
        self._times = np.array([fix.time_s for fix in kept])
        self._degrees: Float64[np.ndarray, "n 2"] = np.array([[fix.latitude, fix.longitude] for fix in kept]).reshape(
            -1, 2
        )
        self._degrees[:, 1] = np.unwrap(self._degrees[:, 1], period=360.0)
        self._altitudes = _column([fix.altitude_m for fix in kept])
        self._heights = _column([fix.height_m for fix in kept])
        decimals = max((fix.decimals for fix in kept), default=6)
        step_m = METRES_PER_DEGREE / 10.0**decimals
        self._sigma_m = math.hypot(RECEIVER_M, step_m / math.sqrt(12.0)) if decimals <= MAX_ROUNDED_DECIMALS else None

    def at(self, time_s: float) -> Place | None:
        """Where the camera was; None further than ``MAX_GAP_S`` from all fixes."""
        if len(self._times) == 0 or float(np.abs(self._times - time_s).min()) > MAX_GAP_S:
            return None
        latitude, longitude = (_between(time_s, self._times, self._degrees[:, axis]) for axis in (0, 1))
        return Place(
            latitude,
            (longitude + 180.0) % 360.0 - 180.0,
            None if self._altitudes is None else _between(time_s, self._times, self._altitudes),
            None if self._heights is None else _between(time_s, self._times, self._heights),
            self._sigma_m,
        )


def _column(values: Sequence[float | None]) -> Float64[np.ndarray, " n"] | None:
    """The values as an array; None unless all are stated."""
    stated = [value for value in values if value is not None]
    return np.array(stated) if stated and len(stated) == len(values) else None


def _between(time_s: float, times: Float64[np.ndarray, " n"], values: Float64[np.ndarray, " n"]) -> float:
    """The value at a time; past the ends, as far as the next value would be, the last step goes on."""
    if len(times) > 1 and not times[0] <= time_s <= times[-1]:
        near, far = (0, 1) if time_s < times[0] else (-1, -2)
        step = float(times[near] - times[far])
        share = min(1.0, (time_s - float(times[near])) / step) if step else 0.0
        return float(values[near] + share * (values[near] - values[far]))
    return float(np.interp(time_s, times, values))
