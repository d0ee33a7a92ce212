"""Camera path keyframes from an untrusted file, JSON or CSV, in the frame of `splat.ply`.

JSON is ``{"keyframes": [...]}`` or the list alone; each has ``position`` [east, north, up] and either ``target`` of the
same form or ``heading_deg`` (clockwise from north) and ``pitch_deg`` (0 level, -90 straight down); if all have
``time_s``, they are passed at these times; ``fov_deg`` is the field of view along the image's longer side. CSV has the
columns ``x, y, z`` and either ``target_x, target_y, target_z`` or ``heading, pitch``; ``time`` and ``fov`` are
optional.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.film.camera_path import (
    FINE_STEPS,
    Route,
    centripetal_knots,
    evenly_timed,
    route_of,
    spline,
    towards,
)
from splatpipe.pipeline.survey.files.survey_text import (
    MAX_COORDINATE,
    UNKNOWN,
    LineError,
    TableKind,
    delimiter_of,
    find_columns,
    line_errors,
    number_in,
    read_lines,
    written_lines,
)

KIND = TableKind(
    "path",
    "It is JSON or CSV, e.g. a CSV with the header x,y,z,target_x,target_y,target_z and a keyframe a line.",
    max_bytes=4 << 20,
    max_lines=10_001,
)
MAX_KEYFRAMES = 10_000
MAX_DURATION_S = 3600.0
WIDEST_DEG, NARROWEST_DEG = 150.0, 1.0
STEEPEST_DEG, MIN_TILT_DEG = 90.0, 89.999  # keeps a heading defined when looking straight down
FULL_TURNS_DEG = 36_000.0  # largest heading: no path turns more often
SPELLINGS = {
    "x": ("x", "east", "e"),
    "y": ("y", "north", "n"),
    "z": ("z", "up", "height", "u"),
    "target_x": ("target_x",),
    "target_y": ("target_y",),
    "target_z": ("target_z",),
    "heading": ("heading", "heading_deg", "yaw"),
    "pitch": ("pitch", "pitch_deg"),
    "time": ("time", "time_s", "seconds"),
    "fov": ("fov", "fov_deg"),
}
PLACE, TARGET = ("x", "y", "z"), ("target_x", "target_y", "target_z")
Numbers = dict[str, float]


@dataclass(frozen=True, eq=False)
class Keyframes:
    """The keyframes of a file.

    Attributes:
        route: In the world frame of `splat.ply`, x east.
        targets: Points to look at; None if a keyframe has none.
        times_s: Increasing from 0; None if the file has none.
        angles_deg: Field of view along the image's longer side; None if the file has none.
    """

    route: Route
    targets: Float64[np.ndarray, "n 3"] | None
    times_s: Float64[np.ndarray, " n"] | None
    angles_deg: Float64[np.ndarray, " n"] | None

    def film(self, distance: float, fps: int, seconds: float) -> tuple[Route, Float64[np.ndarray, " frames"] | None]:
        """A smooth path through the keyframes: at their times, otherwise at an even speed.

        If all have targets, the target moves smoothly too; otherwise the viewing direction does.

        Args:
            distance: Distance of what is viewed, world units: see ``Route.steps``.
            fps: Frames per second.
            seconds: Duration, if the file has no times.

        Returns:
            One route position per frame, and the fields of view if the file has them.

        Raises:
            UsageError: if there is no path: a single keyframe, or several identical ones.
        """
        if len(self.route) < 2:
            raise UsageError("A film needs at least two keyframes.", hint="For a single one, use --stills.")
        if self.times_s is not None:
            moments = np.linspace(0.0, self.times_s[-1], max(2, round(float(self.times_s[-1]) * fps)))
            return self._at(self.times_s, moments)
        knots = centripetal_knots(self.route, distance)
        fine = np.linspace(0.0, knots[-1], FINE_STEPS + 1)
        way, _ = self._at(knots, fine)
        at = evenly_timed(way, distance, max(1, round(seconds * fps)), seconds)
        return self._at(knots, np.interp(at, np.arange(len(fine)), fine))

    def _at(
        self, knots: Float64[np.ndarray, " n"], at: Float64[np.ndarray, " m"]
    ) -> tuple[Route, Float64[np.ndarray, " m"] | None]:
        angles = None if self.angles_deg is None else np.interp(at, knots, self.angles_deg)
        if self.targets is None:
            return route_of(spline(self.route.values(), knots, at)), angles
        values = spline(np.hstack((self.route.places, self.targets)), knots, at)
        return towards(values[:, :3], values[:, 3:]), angles


def read_keyframes(path: Path) -> Keyframes:
    """Read a file of keyframes.

    Raises:
        SplatpipeError: if it is not a valid file; names the faulty line, or the keyframe in JSON.
    """
    lines = read_lines(path, KIND)
    with line_errors(path, KIND):
        text = "\n".join(line for _, line in lines)
        if text.lstrip()[:1] in ("{", "["):
            return _keyframes(list(enumerate(_of_json(text), 1)))
        return _keyframes(_of_csv(written_lines(lines, path, KIND)))


def _of_json(text: str) -> list[Numbers]:
    try:
        value = json.loads(text)
    except RecursionError as error:
        raise LineError(0, "it is nested too deeply") from error
    except ValueError as error:
        raise LineError(getattr(error, "lineno", 0), "it is not valid JSON") from error
    listed = value.get("keyframes") if isinstance(value, dict) else value
    if not isinstance(listed, list) or not all(isinstance(item, dict) for item in listed):
        raise LineError(0, "it has no list of keyframes")
    return [_of_item(number, item) for number, item in enumerate(listed, 1)]


def _of_item(number: int, item: Mapping[str, Any]) -> Numbers:
    found: Numbers = {}
    for key, names in (("position", PLACE), ("target", TARGET)):
        if item.get(key) is not None:
            values = item[key]
            if not isinstance(values, list) or len(values) != 3:
                raise LineError(0, f"{key} of keyframe {number} is not three numbers")
            found |= {name: _finite(number, key, part) for name, part in zip(names, values, strict=True)}
    for key in ("heading", "pitch", "time", "fov"):
        said = next((item[name] for name in SPELLINGS[key] if item.get(name) is not None), None)
        if said is not None:
            found[key] = _finite(number, key, said)
    return found


def _finite(number: int, what: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_COORDINATE:
        raise LineError(0, f"{what} of keyframe {number} is {str(value)[:40]!r}, which is not a valid number")
    return float(value)


def _of_csv(lines: Sequence[tuple[int, str]]) -> list[tuple[int, Numbers]]:
    delimiter = delimiter_of(lines[0][1])
    rows = [next(csv.reader([line], delimiter=delimiter), []) for _, line in lines]
    places = find_columns(rows[0], SPELLINGS)
    return [
        (
            number,
            {
                key: number_in(number, key, row[at])
                for key, at in places.items()
                if at < len(row) and row[at].strip().casefold() not in UNKNOWN
            },
        )
        for (number, _), row in zip(lines[1:], rows[1:], strict=True)
    ]


def _keyframes(items: Sequence[tuple[int, Numbers]]) -> Keyframes:
    """Keyframes from numbers; the first of each pair is the line, or the number in JSON, for messages."""
    if not 1 <= len(items) <= MAX_KEYFRAMES:
        raise LineError(0, f"it has {len(items):,} keyframes, and there are 1 to {MAX_KEYFRAMES:,} in a path")
    places = np.array([_place(number, item) for number, item in items])
    targets = np.array([_target(number, item) for number, item in items])
    ahead = np.array([_ahead(number, item) for number, item in items])
    route = towards(places, places + ahead)
    times, angles = _all_or_none(items, "time"), _all_or_none(items, "fov")
    if times is not None:
        if not (np.diff(times) > 0.0).all() or times[0] < 0.0 or times[-1] > MAX_DURATION_S:
            raise LineError(0, f"its times do not rise from 0 to at most {MAX_DURATION_S:.0f} seconds")
        times = times - times[0]
    if angles is not None and not ((angles >= NARROWEST_DEG) & (angles <= WIDEST_DEG)).all():
        raise LineError(0, f"a fov is not between {NARROWEST_DEG:.0f} and {WIDEST_DEG:.0f} degrees")
    return Keyframes(route, None if np.isnan(targets).any() else targets, times, angles)


def _place(number: int, item: Numbers) -> list[float]:
    if not all(name in item for name in PLACE):
        raise LineError(number, "a keyframe has no position of three numbers")
    return [item[name] for name in PLACE]


def _target(number: int, item: Numbers) -> list[float]:
    """The target of a keyframe; NaN without one."""
    found = [item.get(name, math.nan) for name in TARGET]
    if 0 < sum(math.isnan(value) for value in found) < 3:
        raise LineError(number, "a keyframe has an incomplete target")
    return found


def _ahead(number: int, item: Numbers) -> list[float]:
    """The viewing direction of a keyframe, of any length."""
    if TARGET[0] in item:
        ahead = [item[target] - item[place] for target, place in zip(TARGET, PLACE, strict=True)]
        if not any(ahead):
            raise LineError(number, "a keyframe's target is its position")
        return ahead
    if "heading" not in item or "pitch" not in item:
        raise LineError(number, "a keyframe has neither a target nor heading and pitch")
    heading, pitch = math.radians(item["heading"]), math.radians(item["pitch"])
    if abs(item["pitch"]) > STEEPEST_DEG or abs(item["heading"]) > FULL_TURNS_DEG:
        raise LineError(number, "a pitch is not between -90 and 90 degrees, or a heading is out of range")
    flat = math.cos(min(abs(pitch), math.radians(MIN_TILT_DEG)))
    return [flat * math.sin(heading), flat * math.cos(heading), math.sin(pitch)]


def _all_or_none(items: Sequence[tuple[int, Numbers]], key: str) -> Float64[np.ndarray, " n"] | None:
    stated = [item[key] for _, item in items if key in item]
    if stated and len(stated) < len(items):
        number = next(number for number, item in items if key not in item)
        raise LineError(number, f"a keyframe has no {key}, and others have")
    return np.array(stated) if stated else None
