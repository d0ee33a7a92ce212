"""Read files of photo positions: ODM's ``geo.txt``, and a CSV with a header.

ODM (docs.opendronemap.org, "Image geolocation files"): the first line names the CRS, then a photo a line, ``image_name
geo_x geo_y [geo_z] [yaw pitch roll] [horz_accuracy vert_accuracy]``, strictly by position: angles count with at least
seven fields, accuracies are the eighth and the ninth, and angles 0 0 0 mean unknown. ``#`` begins a comment. The text
is untrusted: everything has a limit, and every error names the line.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.survey.survey_text import (
    UNKNOWN,
    LineError,
    TableKind,
    csv_rows,
    delimiter_of,
    find_columns,
    is_number,
    line_errors,
    number_in,
    read_lines,
    written_lines,
)

MAX_NAME_CHARS = 1000
LARGEST_ANGLE_DEG = 720.0
SIGMA_BOUNDS_M = (1e-4, 1e4)
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "name": ("name", "image", "image_name", "photo", "filename", "file", "label", "sourcefile"),
    "x": ("x", "geo_x", "east", "easting", "e", "lon", "lng", "long", "longitude", "gpslongitude", "x/longitude"),
    "y": ("y", "geo_y", "north", "northing", "n", "lat", "latitude", "gpslatitude", "y/latitude"),
    "z": ("z", "geo_z", "height", "h", "alt", "altitude", "elevation", "gpsaltitude", "z/altitude"),
    "yaw": ("yaw", "yaw_deg", "heading"),
    "pitch": ("pitch", "pitch_deg"),
    "roll": ("roll", "roll_deg"),
    "sigma_horizontal": (
        "sigma_horizontal",
        "sigma_horizontal_m",
        "sigma_h",
        "sigma_xy",
        "horz_accuracy",
        "accuracy_xy",
    ),
    "sigma_vertical": ("sigma_vertical", "sigma_vertical_m", "sigma_v", "sigma_z", "vert_accuracy", "accuracy_z"),
    "crs": ("crs", "epsg", "srs"),
}
NUMBERS = ("x", "y", "z", "yaw", "pitch", "roll", "sigma_horizontal", "sigma_vertical")
ODM_ORDER = ("name", *NUMBERS)
ANGLES_FROM = 7  # fields of a line of geo.txt
EXPECTED = (
    "First a line with the CRS, e.g. EPSG:4326, then lines of `photo x y z`, east (or longitude) first; or a CSV with a"
    " header name,longitude,latitude,altitude."
)

KIND = TableKind("file of positions", EXPECTED, max_bytes=64 << 20, max_lines=1_000_000)


@dataclass(frozen=True)
class PhotoPlace:
    """A photo's entry in the file.

    Attributes:
        line: Line number in the file, from 1.
        name: The photo, as written.
        x: Easting or longitude, in the file's CRS.
        y: Northing or latitude.
        z: Height; None where there is none.
        angles_deg: Yaw, pitch and roll, as written; None where they are unknown.
        sigma_m: Horizontal (per axis) and vertical standard deviation; None where the file states none.
    """

    line: int
    name: str
    x: float
    y: float
    z: float | None
    angles_deg: tuple[float, float, float] | None
    sigma_m: tuple[float | None, float | None]


@dataclass(frozen=True)
class PositionFile:
    """A file's CRS, as written, and its photos in its order, each once."""

    crs: str
    photos: tuple[PhotoPlace, ...]


def read_position_file(path: Path) -> PositionFile:
    """Read a file of photos' positions.

    Raises:
        SplatpipeError: if it is not such a file; the message names the line, the hint what is expected there.
    """
    lines = read_lines(path, KIND)
    written = written_lines(lines, path, KIND)
    header = next((at for at, (_, line) in enumerate(written[:2]) if _header(line)), None)
    with line_errors(path, KIND):
        if header is None:
            crs, rows = _odm_rows(written)
        else:
            crs, rows = csv_rows(lines, written, header, COLUMNS)
        photos = [_photo(number, row) for number, row in rows]
        _require_once(photos)
    if not photos:
        raise SplatpipeError(f"The file of positions {path.name} lists no photos.", EXPECTED)
    return PositionFile(crs, tuple(photos))


def _odm_rows(written: Sequence[tuple[int, str]]) -> tuple[str, list[tuple[int, Mapping[str, str]]]]:
    first, crs = written[0]
    fields = crs.split()
    if len(fields) >= 3 and all(is_number(field) for field in fields[1:3]):
        raise LineError(first, "the first line must state the CRS, but it is a photo's")
    rows: list[tuple[int, Mapping[str, str]]] = []
    for number, line in written[1:]:
        # A name with blanks is one field where tabs separate the fields.
        fields = [field.strip() for field in line.split("\t")] if line.count("\t") >= 2 else line.split()
        if len(fields) < 3:
            raise LineError(number, f"{len(fields)} fields, but at least 3 are needed")
        row = dict(zip(ODM_ORDER, fields, strict=False))
        if len(fields) < ANGLES_FROM:
            row = {key: row[key] for key in ("name", "x", "y", "z") if key in row}
        rows.append((number, row))
    return crs.strip(), rows


def _header(line: str) -> dict[str, int]:
    """The columns of a header; empty where the line is not a header."""
    columns = find_columns(next(csv.reader([line], delimiter=delimiter_of(line))), COLUMNS)
    return columns if {"name", "x", "y"} <= set(columns) else {}


def _photo(number: int, row: Mapping[str, str]) -> PhotoPlace:
    name = row["name"]
    if not name or len(name) > MAX_NAME_CHARS:
        raise LineError(number, "a name that is empty or too long")
    values = {key: _number(number, key, row.get(key, "")) for key in NUMBERS}
    x, y = values["x"], values["y"]
    if x is None or y is None:
        raise LineError(number, f"{name[:80]} has no x or no y")
    angles = values["yaw"], values["pitch"], values["roll"]
    sigmas = _sigma(number, values["sigma_horizontal"]), _sigma(number, values["sigma_vertical"])
    return PhotoPlace(number, name, x, y, values["z"], _angles(number, *angles), sigmas)


def _angles(
    number: int, yaw: float | None, pitch: float | None, roll: float | None
) -> tuple[float, float, float] | None:
    if yaw is None or pitch is None or yaw == pitch == (roll or 0.0) == 0.0:
        return None
    if max(abs(yaw), abs(pitch), abs(roll or 0.0)) > LARGEST_ANGLE_DEG:
        raise LineError(number, "angles that are out of range in degrees")
    return yaw, pitch, roll or 0.0


def _sigma(number: int, value: float | None) -> float | None:
    """A standard deviation; programs write 0 where they have none."""
    if value is None or value == 0.0:
        return None
    if not SIGMA_BOUNDS_M[0] <= value <= SIGMA_BOUNDS_M[1]:
        raise LineError(number, f"an accuracy of {value:g} m")
    return value


def _number(number: int, what: str, text: str) -> float | None:
    return None if text.casefold() in UNKNOWN else number_in(number, what, text)


def _require_once(photos: Sequence[PhotoPlace]) -> None:
    lines: dict[str, int] = {}
    for photo in photos:
        if photo.name in lines:
            raise LineError(photo.line, f"{photo.name[:80]} was in line {lines[photo.name]} already")
        lines[photo.name] = photo.line
