"""Read control files, surveyed points and their marks in photos: ODM's ``gcp_list.txt``, and a CSV with a header.

ODM (docs.opendronemap.org, "Ground Control Points"): the first line names the CRS, then one observation per line,
``geo_x geo_y geo_z im_x im_y image_name [gcp_name] [extra…]``, separated by blanks or tabs. ``#`` begins a comment. The
text is untrusted: everything has a limit, and every error names the line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.photos.files.names import is_photo
from splatpipe.pipeline.survey.crs.crs import Crs, parse_crs
from splatpipe.pipeline.survey.files.survey_text import (
    EAST,
    ELLIPSOIDAL_Z,
    GEOGRAPHIC,
    GEOGRAPHIC_Y,
    HEIGHT,
    MAX_LINE_CHARS,
    NORTH,
    PHOTO,
    SAMPLE_LINES,
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

Role = Literal["control", "check"]
MAX_POINTS = 10_000
MAX_NAME = 255
UNNAMED = "point "  # before the number of a point without a name
MIN_TABS = 5  # a line of ODM's list with at least as many is tab-separated
SAME_PLACE_M = 1e-3  # lines of one point must repeat its coordinates to within a millimetre
SEA_LEVEL_M = 20.0  # a height of exactly 0 counts as measured if another point is this close to 0, else as unknown
SIGMA_BOUNDS_M = (1e-4, 1e3)
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "name": (
        *("name", "label", "point", "point_name", "gcp", "gcp_name", "gcp_label", "marker", "marker_name", "station"),
        *(
            "point_id",
            "pointid",
            "point_number",
            "point_no",
            "pt",
            "id",
            "p",
            "pnt",
        ),  # P,N,E,Z,D: as Trimble names them
        *("punkt", "punktnummer", "punktname", "punkt_id", "punkt_nr", "punktnr", "nom", "nombre", "punto"),
    ),
    "x": ("x", "geo_x", "east", "easting", "e", "x/east", "x/easting", "grid_easting", *EAST, *GEOGRAPHIC),
    "y": ("y", "geo_y", "north", "northing", "n", "y/north", "y/northing", "grid_northing", *NORTH, *GEOGRAPHIC_Y),
    "z": (
        *("z", "geo_z", "height", "h", "up", "alt", "altitude", "elevation", "elev", "z/altitude", "z/height"),
        *HEIGHT,
        *ELLIPSOIDAL_Z,
    ),
    "photo": (
        *("image", "photo", *PHOTO, "image_name", "imagename", "photo_name", "filename", "file_name", "file"),
        "camera",
    ),
    "px": ("px", "pixel_x", "im_x", "image_x", "u", "column", "x_px", "x_pixel"),
    "py": ("py", "pixel_y", "im_y", "image_y", "v", "row", "y_px", "y_pixel"),
    "role": ("role", "type", "kind"),
    "sigma_horizontal": (
        *("sigma_horizontal", "sigma_h", "sigma_xy", "accuracy_xy", "horz_accuracy", "sigma_horizontal_m"),
        *("accuracy_horizontal", "horizontal_accuracy"),
    ),
    "sigma_vertical": (
        *("sigma_vertical", "sigma_v", "sigma_z", "accuracy_z", "vert_accuracy", "sigma_vertical_m"),
        *("accuracy_vertical", "vertical_accuracy"),
    ),
    "crs": ("crs", "epsg", "srs", "cs_name", "coordinate_system"),
}
_NEEDED = ("x", "y", "photo", "px", "py")  # columns of a table
_OF_MARKS = ("photo", "px", "py")
_NEEDED_OF_POINTS = ("name", "x", "y")  # columns of a table without marks
ROLES: Mapping[str, Role] = {
    "control": "control",
    "gcp": "control",
    "check": "check",
    "checkpoint": "check",
    "cp": "check",
    "check point": "check",
    "control point": "control",
    "3d gcp": "control",  # as Pix4D calls it
}


@dataclass(frozen=True)
class Mark:
    """A point's mark in a photo: the file's pixel coordinates in the stored grid, as written."""

    photo: str
    x: float
    y: float


@dataclass(frozen=True)
class SurveyedPoint:
    """A point of the survey.

    Attributes:
        name: As written, or ``point N`` where lines have no name.
        x: Easting or longitude, in the file's CRS.
        y: Northing or latitude.
        z: Height; None where not measured.
        sigma_m: Horizontal (per axis) and vertical standard deviation; None where the file states none.
        role: None where the file does not state it.
        marks: In the file's order.
    """

    name: str
    x: float
    y: float
    z: float | None
    sigma_m: tuple[float | None, float | None]
    role: Role | None
    marks: tuple[Mark, ...]


@dataclass(frozen=True)
class ControlFile:
    """The contents of a control file.

    Attributes:
        name: The file's name, for messages.
        crs: The CRS of its points.
        points: In the order of their first lines.
        zero_heights: Points whose height of 0.0 was treated as unknown.
    """

    name: str
    crs: Crs
    points: tuple[SurveyedPoint, ...]
    zero_heights: tuple[str, ...]


@dataclass(frozen=True)
class Row:
    """One observation; ``name`` is empty where the line has none."""

    line: int
    name: str
    place: tuple[float, float, float | None]
    mark: Mark | None
    role: Role | None
    sigma_m: tuple[float | None, float | None]


@dataclass(frozen=True)
class Table:
    """A control file as written, for editing it line by line.

    Attributes:
        lines: All lines, numbered from 1.
        header: Line number of the header; None in ODM's list.
        crs: As written.
        rows: The observations.
        separator: Between the fields of a line; empty for blanks, or tabs by the line, in ODM's list.
    """

    lines: tuple[tuple[int, str], ...]
    header: int | None
    crs: str
    rows: tuple[Row, ...]
    separator: str = ""

    @property
    def groups(self) -> dict[str, list[Row]]:
        """The rows of each point by its name, ``point N`` where lines have none."""
        groups: dict[object, list[Row]] = {}
        for row in self.rows:
            groups.setdefault(row.name or row.place, []).append(row)
        named: dict[str, list[Row]] = {}
        for number, group in enumerate(groups.values(), 1):
            name = group[0].name or f"{UNNAMED}{number}"
            named[name if name not in named else f"{name} (line {group[0].line})"] = group
        return named


def titled(kind: str, name: str) -> str:
    """A point in a message: ``Control point P1``, and without a kind ``Point P1``; ``Point 12`` if it has no name."""
    bare = name.removeprefix(UNNAMED) if name.removeprefix(UNNAMED).isdigit() else name
    return f"{kind} point {bare}" if kind else f"Point {bare}"


def read_control_file(path: Path) -> ControlFile:
    """Read a file of control and check points.

    Raises:
        SplatpipeError: if it is not such a file, or its CRS is unknown; the message names the line, the hint what is
            expected there.
    """
    table = read_table(path)
    with line_errors(path, _KIND):
        return _assemble(path, table)


def read_points_file(path: Path) -> ControlFile:
    """Read surveyed points that need not be marked yet: a control file, or a CSV with only name,x,y,z.

    Raises:
        SplatpipeError: if it is not such a file, or its CRS is unknown; the message names the line, the hint what is
            expected there.
    """
    table = read_table(path, _NEEDED_OF_POINTS)
    with line_errors(path, _POINTS):
        return _assemble(path, table)


def read_table(path: Path, needed: Sequence[str] = _NEEDED) -> Table:
    """Read a control file's lines; it may have no observations yet.

    Args:
        path: The file.
        needed: Columns that a header must have.

    Raises:
        SplatpipeError: if it is not such a file.
    """
    return parse_table(read_lines(path, _KIND if needed == _NEEDED else _POINTS), path, needed)


def parse_table(lines: Sequence[tuple[int, str]], path: Path, needed: Sequence[str] = _NEEDED) -> Table:
    """Parse numbered lines of a control file; the path is for messages.

    Raises:
        SplatpipeError: if they are not a control file's.
    """
    kind = _KIND if needed == _NEEDED else _POINTS
    written = written_lines(lines, path, kind)
    header = find_header(lines, written, lambda line: _is_header(line, needed))
    with line_errors(path, kind):
        if header is None:
            crs, rows, separator = _odm_rows(written)
        else:
            crs, cells = csv_rows(lines, written, header, COLUMNS)
            rows = [_csv_row(number, row) for number, row in cells]
            separator = titles_of(lines[header - 1][1])[1]
    return Table(tuple(lines), header, crs, tuple(rows), separator)


_EXPECTED = (
    "First a line with the CRS, e.g. EPSG:32633, then lines of `x y z pixel_x pixel_y photo point`, such as"
    " `388710.51 5299705.21 512.01 112.1 514.1 DJI_0005.JPG P01`, separated by blanks, tabs, semicolons or commas;"
    " or a CSV with a header name,x,y,z,pixel_x,pixel_y,photo; omit the last three if targets are to be detected."
)
_TITLES = (
    "Put the CRS and the titles of the columns into two lines above them, in the order of the file, such as EPSG:32633"
    " and then name,north,east,height,code."
)
_KIND = TableKind("control file", _EXPECTED, max_bytes=32 << 20, max_lines=200_000)
_POINTS = TableKind(
    "file of points",
    "A first line with the CRS, e.g. EPSG:32633, then a CSV with a header such as name,x,y,z; or a control file.",
    max_bytes=_KIND.max_bytes,
    max_lines=_KIND.max_lines,
)


def _odm_rows(written: Sequence[tuple[int, str]]) -> tuple[str, list[Row], str]:
    """The CRS, the observations and the separator of ODM's list."""
    first, crs = written[0]
    separator = list_separator(written[1:] or written, range(5))
    fields = fields_of(crs, separator)
    if len(fields) >= 6 and all(is_numeral(field) for field in fields[:5]):
        raise LineError(first, "the first line must state the CRS, but it is an observation", _EXPECTED)
    for number, line in written[:2]:
        _require_no_header(number, line)
    _require_no_points(written)
    rows = []
    for number, line in written[1:]:
        fields = fields_of(line, separator)
        if len(fields) < 6:
            field_count = f"{len(fields)} field{'' if len(fields) == 1 else 's'} separated by {SEPARATORS[separator]}"
            raise LineError(number, f"{field_count}, but at least 6 are needed: x y z pixel_x pixel_y photo")
        place = (number_in(number, "x", fields[0]), number_in(number, "y", fields[1]), _height(number, fields[2]))
        mark = Mark(
            _name(number, fields[5]), number_in(number, "pixel x", fields[3]), number_in(number, "pixel y", fields[4])
        )
        name = _name(number, fields[6]) if len(fields) > 6 and fields[6] else ""
        rows.append(Row(number, name, place, mark, None, (None, None)))
    return crs_text(crs), rows, separator


def fields_of(line: str, separator: str) -> list[str]:
    """The fields of a line of ODM's list; a photo's name with blanks is one of them, up to its suffix."""
    fields = list_fields(line, separator, MIN_TABS)
    return fields if separator or line.count("\t") >= MIN_TABS else with_whole_name(fields, 5)


def _require_no_points(written: Sequence[tuple[int, str]]) -> None:
    """Reject points without titles, of name and coordinates as receivers write them: their order is not known.

    Raises:
        LineError: if the lines are such points.
    """
    for separator in filter(None, SEPARATORS):
        looked = [list_fields(line, separator, MIN_TABS) for _, line in written[:SAMPLE_LINES]]
        points = [each for each in looked if len(each) >= 4 and all(map(is_numeral, each[1:4]))]
        if points and 2 * len(points) >= len(looked) and not any(is_photo(PurePosixPath(cell)) for cell in points[0]):
            what = f"points separated by {SEPARATORS[separator]} without titles"
            raise LineError(written[0][0], f"{what}: their order (x, y or north, east) is not known", _TITLES)


def _is_header(line: str, needed: Sequence[str]) -> bool:
    columns = find_columns(titles_of(line)[0], COLUMNS)
    if set(needed) <= set(columns) or set(_NEEDED) <= set(columns):
        return True
    # Points only: targets are to be detected in the photos, or marks made by hand.
    return set(_NEEDED_OF_POINTS) <= set(columns) and not set(_OF_MARKS) & set(columns)


def _require_no_header(number: int, line: str) -> None:
    """Reject a CSV header that lacks columns: it would pass for a line of ODM's list."""
    columns = find_columns(titles_of(line)[0], COLUMNS)
    missing = [name for name in _NEEDED if name not in columns]
    if missing and len(columns) >= len(_NEEDED) - 2:
        titles = ", ".join(COLUMNS[name][1] for name in missing)
        raise LineError(number, f"a header without the columns {titles}", _EXPECTED)


def _csv_row(number: int, row: Mapping[str, str]) -> Row:
    role = row.get("role", "").casefold()
    if role and role not in ROLES:
        raise LineError(number, f"the role {role[:40]!r} is neither control nor check")
    place = (number_in(number, "x", row["x"]), number_in(number, "y", row["y"]), _height(number, row.get("z", "")))
    mark = None
    if row.get("photo"):  # a point may be listed without being marked
        photo = _name(number, row["photo"])
        mark = Mark(photo, *(number_in(number, f"pixel {key[1]}", row.get(key, "")) for key in ("px", "py")))
    sigmas = (_sigma(number, row.get("sigma_horizontal", "")), _sigma(number, row.get("sigma_vertical", "")))
    return Row(number, _name(number, row["name"]) if row.get("name") else "", place, mark, ROLES.get(role), sigmas)


def _assemble(path: Path, table: Table) -> ControlFile:
    crs, groups = table.crs, table.groups
    if not crs or len(crs) > MAX_LINE_CHARS:
        raise LineError(0, "it states no CRS")
    if not groups:
        raise LineError(0, "it has no observations")
    if len(groups) > MAX_POINTS:
        raise LineError(0, f"it has more than {MAX_POINTS:,} points")
    heights = [group[0].place[2] for group in groups.values()]
    at_sea = any(height and abs(height) < SEA_LEVEL_M for height in heights)
    points, zero = [], []
    for name, group in groups.items():
        point = _point(name, group, keep_zero=at_sea)
        points.append(point)
        if point.z is None and group[0].place[2] == 0.0:
            zero.append(name)
    return ControlFile(path.name, crs_of(path, table), tuple(points), tuple(zero))


def crs_of(path: Path, table: Table) -> Crs:
    """The CRS that a control file states.

    Raises:
        SplatpipeError: if it is unknown; the message names the file.
    """
    try:
        return parse_crs(table.crs)
    except SplatpipeError as error:
        raise SplatpipeError(f"The CRS of {path.name}: {error}", error.hint) from error


def _point(name: str, rows: Sequence[Row], keep_zero: bool) -> SurveyedPoint:
    first = rows[0]
    marks: dict[str, Mark] = {}
    for row in rows:
        _require_same(name, first, row)
        if row.mark is not None:
            if row.mark.photo in marks and row.mark != marks[row.mark.photo]:
                raise LineError(
                    row.line,
                    f"a second mark of {name} in {row.mark.photo}",
                    "A point can be marked only once in a photo.",
                )
            marks[row.mark.photo] = row.mark
    x, y, z = first.place
    role = next((row.role for row in rows if row.role is not None), None)
    sigmas = tuple(next((row.sigma_m[k] for row in rows if row.sigma_m[k] is not None), None) for k in (0, 1))
    height = None if z == 0.0 and not keep_zero else z
    return SurveyedPoint(name, x, y, height, (sigmas[0], sigmas[1]), role, tuple(marks.values()))


def _require_same(name: str, first: Row, row: Row) -> None:
    for have, want in zip(row.place, first.place, strict=True):
        if (have is None) != (want is None) or (
            have is not None and want is not None and abs(have - want) > SAME_PLACE_M
        ):
            raise LineError(
                row.line,
                f"{name} has other coordinates than in line {first.line}",
                "Each name must be one point: correct the coordinates, or give the points different names.",
            )
    if row.role is not None and first.role is not None and row.role != first.role:
        raise LineError(row.line, f"{name} is {row.role} here and {first.role} in line {first.line}")


def _height(line: int, text: str) -> float | None:
    return None if text.casefold() in UNKNOWN else number_in(line, "height", text)


def _sigma(line: int, text: str) -> float | None:
    if text.casefold() in UNKNOWN:
        return None
    value = number_in(line, "the standard deviation", text)
    if not SIGMA_BOUNDS_M[0] <= value <= SIGMA_BOUNDS_M[1]:
        raise LineError(line, f"a standard deviation of {value:g} m")
    return value


def _name(line: int, text: str) -> str:
    if not text or len(text) > MAX_NAME:
        raise LineError(line, "a name that is empty or too long")
    return text
