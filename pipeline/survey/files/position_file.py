"""Read files of photo positions: ODM's ``geo.txt``, and a CSV with a header.

ODM (docs.opendronemap.org, "Image geolocation files"): the first line names the CRS, then a photo a line, ``image_name
geo_x geo_y [geo_z] [yaw pitch roll] [horz_accuracy vert_accuracy]``, strictly by position: angles count with at least
seven fields, accuracies are the eighth and the ninth, and angles 0 0 0 mean unknown. ``#`` begins a comment. The text
is untrusted: everything has a limit, and every error names the line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.photos.files.names import NameFinder, is_photo
from splatpipe.pipeline.survey.files.survey_text import (
    EAST,
    ELLIPSOIDAL_Z,
    GEOGRAPHIC,
    GEOGRAPHIC_Y,
    HEIGHT,
    MAX_NAME_WORDS,
    NORTH,
    PHOTO,
    SEPARATORS,
    UNKNOWN,
    LineError,
    TableKind,
    crs_text,
    csv_rows,
    find_columns,
    find_header,
    is_numeral,
    line_errors,
    list_fields,
    list_separator,
    number_in,
    read_lines,
    titles_of,
    with_whole_name,
    written_lines,
)

MAX_NAME_CHARS = 1000
LARGEST_ANGLE_DEG = 720.0
SIGMA_BOUNDS_M = (1e-4, 1e4)
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "name": (
        *("name", "image", "image_name", "imagename", "photo", "photo_name", "filename", "file_name", "file", "label"),
        *("sourcefile", "picture", *PHOTO),
    ),
    "x": ("x", "geo_x", "east", "easting", "e", "x/easting", "x/east", *EAST, *GEOGRAPHIC),
    "y": ("y", "geo_y", "north", "northing", "n", "y/northing", "y/north", *NORTH, *GEOGRAPHIC_Y),
    "z": (
        *("z", "geo_z", "height", "h", "alt", "altitude", "elevation", "elev", "gpsaltitude", "gps_altitude"),
        *("z/altitude", "z/height", "altitude_m", "height_m", *HEIGHT, *ELLIPSOIDAL_Z),
    ),
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
        "accuracy_horizontal",
        "horizontal_accuracy",
    ),
    "sigma_vertical": (
        *("sigma_vertical", "sigma_vertical_m", "sigma_v", "sigma_z", "vert_accuracy", "accuracy_z"),
        *("accuracy_vertical", "vertical_accuracy"),
    ),
    "crs": ("crs", "epsg", "srs", "cs_name", "coordinate_system"),
}
NUMBERS = ("x", "y", "z", "yaw", "pitch", "roll", "sigma_horizontal", "sigma_vertical")
ODM_ORDER = ("name", *NUMBERS)
ANGLES_FROM = 7  # fields of a line of geo.txt
EXPECTED = (
    "First a line with the CRS, e.g. EPSG:4326, then lines of `photo x y z`, east (or longitude) first, such as"
    " `DJI_0001.JPG 13.5127 47.8412 512.3`, separated by blanks, tabs, semicolons or commas; or a CSV with a header"
    " name,longitude,latitude,altitude."
)

_NO_CRS = (
    "Put a line above it: titles in the order of the file, such as name,latitude,longitude,altitude (which is Pix4D's),"
    " or the CRS, e.g. EPSG:4326, if east (or longitude) comes first."
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


def read_position_file(path: Path, photos: Sequence[str] = ()) -> PositionFile:
    """Read a file of photos' positions.

    Args:
        path: The file.
        photos: Names of the capture's photos, by which names with blanks are told where blanks separate the fields.

    Raises:
        SplatpipeError: if it is not such a file; the message names the line, the hint what is expected there.
    """
    lines = read_lines(path, KIND)
    written = written_lines(lines, path, KIND)
    header = find_header(lines, written, _is_header)
    with line_errors(path, KIND):
        if header is None:
            crs, rows = _odm_rows(written, photos)
        else:
            crs, rows = csv_rows(lines, written, header, COLUMNS)
            rows = [(number, row) for number, row in rows if row["x"] or row["y"]]  # without a position: as Metashape
        places = [_photo(number, row) for number, row in rows]
        _require_once(places)
    if not places:
        raise SplatpipeError(f"The file of positions {path.name} lists no photos.", EXPECTED)
    return PositionFile(crs, tuple(places))


def _odm_rows(
    written: Sequence[tuple[int, str]], photos: Sequence[str]
) -> tuple[str, list[tuple[int, Mapping[str, str]]]]:
    first, crs = written[0]
    separator = list_separator(written[1:] or written, (1, 2))
    fields = _fields(crs, separator, None)
    if len(fields) >= 3 and all(is_numeral(field) for field in fields[1:3]):
        raise LineError(first, "the first line must state the CRS, but it is a photo's", _NO_CRS)
    find = NameFinder(photos) if photos else None
    rows: list[tuple[int, Mapping[str, str]]] = []
    for number, line in written[1:]:
        fields = _fields(line, separator, find)
        if len(fields) < 3:
            raise LineError(number, f"{_field_count(len(fields), separator)}, but at least 3 are needed: photo x y")
        row = dict(zip(ODM_ORDER, fields, strict=False))
        if len(fields) < ANGLES_FROM:
            row = {key: row[key] for key in ("name", "x", "y", "z") if key in row}
        rows.append((number, row))
    return crs_text(crs), rows


def _fields(line: str, separator: str, find: NameFinder | None) -> list[str]:
    """The fields of a line of ODM's list; blanks in a photo's name do not count where its end can be told."""
    fields = list_fields(line, separator, tabs=2)
    if separator or line.count("\t") >= 2:
        return fields
    whole = with_whole_name(fields, 0)
    if len(whole) < len(fields) or is_photo(PurePosixPath(fields[0])):
        return whole
    for end in range(min(len(fields) - 2, MAX_NAME_WORDS)):  # a name without a suffix
        name = " ".join(fields[: end + 1])
        is_place = all(map(is_numeral, fields[end + 1 : end + 3]))
        if is_place and (find is None or find(name) is not None):
            return [name, *fields[end + 1 :]]
    return fields


def _field_count(count: int, separator: str) -> str:
    return f"{count} field{'' if count == 1 else 's'} separated by {SEPARATORS[separator]}"


def _is_header(line: str) -> bool:
    return {"name", "x", "y"} <= set(find_columns(titles_of(line)[0], COLUMNS))


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
            text = f"{photo.name[:80]} was in line {lines[photo.name]} already"
            raise LineError(photo.line, text, "A photo has one position: remove the other lines.")
        lines[photo.name] = photo.line
