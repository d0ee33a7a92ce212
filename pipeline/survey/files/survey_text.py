"""Read surveyors' text tables from untrusted files: everything has a limit, and every error names its line."""

from __future__ import annotations

import codecs
import contextlib
import csv
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.small_file import read_small
from splatpipe.pipeline.engine.files.text_lines import text_lines
from splatpipe.pipeline.photos.files.names import is_photo

MAX_LINE_CHARS = 2000
MAX_COORDINATE = 1e9  # magnitude of a coordinate, metres or pixels: larger ones are neither on the earth nor in a photo
UNKNOWN = ("", "-", "nan", "none", "null", "n/a")
CRS_COMMENT = re.compile(r"#\s*(?:crs|srs|epsg|coordinate[ _]?system)\s*[:=]\s*(\S.*)", re.IGNORECASE)
# EPSG:1, EPSG::1, AUTHORITY["EPSG","1"]
AUTHORITY = re.compile(r'\bEPSG(?:::?\s*|"\s*,\s*")(\d{4,6})\b', re.IGNORECASE)
SEPARATOR_LINE = re.compile(r'"?sep=.?"?', re.IGNORECASE)  # the first line that a spreadsheet writes
UNITS = re.compile(r"[ _]*[(\[][^)\]]*[)\]]$")  # after a title
# titles in German, French, Italian and Spanish
EAST = ("rechtswert", "ostwert", "est", "este")
NORTH = ("hochwert", "nordwert", "nord", "norte")
HEIGHT = ("höhe", "hoehe", "altura", "quota", "cota")
PHOTO = ("bild", "bildname", "foto", "imagen", "immagine")
GEOGRAPHIC = ("lon", "lng", "long", "longitude", "gpslongitude", "gps_longitude", "x/longitude", "longitude_deg")
GEOGRAPHIC_Y = ("lat", "latitude", "gpslatitude", "gps_latitude", "y/latitude", "latitude_deg")
ELLIPSOIDAL_Z = ("ellipsoidal_height", "ellipsoid_height")
SEPARATORS = {"\t": "tabs", ";": "semicolons", ",": "commas", "": "blanks"}
MAX_NAME_WORDS = 20  # words of a photo's name in a list whose fields blanks separate
SAMPLE_LINES = 20  # lines of a list without a header, by which its separator is found
QUOTED, QUOTED_FIELD = re.compile(r'^"([^"]*)"$'), re.compile(r'(?:^|\s)"[^"]*"(?:\s|$)')
DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
CODE = re.compile(r"EPSG\s*:|\+|WGS\s?84\s*/?\s*UTM", re.IGNORECASE)  # how a CRS begins that splatpipe knows by itself
MAX_FOREIGN_SHARE = 0.05  # of letters beyond ASCII in a table of one of Windows' code pages, which none of them names
MISWRITTEN = (  # what a number may have been meant to be, and how to write it
    (re.compile("[°º]|[0-9] *[NSEW]$"), "Write degrees with decimals, negative in the south and west: 13.512690."),
    (re.compile("^[0-9]{1,3}(?:['’,. ][0-9]{3})+"), "Write numbers without signs between thousands: 388710.51."),
)
WHOLE, DECIMALS = re.compile(r"[+-]?\d+"), re.compile(r"\d+")  # a number's parts on both sides of a decimal comma
ORTHOMETRIC = ("elevation", "elev")  # beside a column of ellipsoidal heights called height, in Trimble's tables
CONTROL_CHARACTERS = re.compile(r"[\x00-\x08\x0a-\x1f\x7f]")


class LineError(ValueError):
    """An error in a line (0: in the file as a whole); the text is the end of a sentence."""

    def __init__(self, line: int, text: str, hint: str = "") -> None:
        super().__init__(text)
        self.line, self.hint = line, hint


@dataclass(frozen=True)
class TableKind:
    """A kind of file.

    Attributes:
        what: Its name in messages.
        expected: What such a file looks like, as a hint.
        max_bytes: Largest accepted size.
        max_lines: Largest accepted number of lines.
    """

    what: str
    expected: str
    max_bytes: int
    max_lines: int


def read_lines(path: Path, kind: TableKind) -> list[tuple[int, str]]:
    """Read a file's lines, numbered from 1.

    Raises:
        SplatpipeError: if the file is not text, or too large.
    """
    name = f"The {kind.what} {path.name}"
    try:
        text = _text_of(read_small(path, kind.max_bytes))
    except UnicodeDecodeError as error:
        raise SplatpipeError(f"{name} is not UTF-8 text.", "Save it as plain text in UTF-8.") from error
    except OSError as error:
        raise SplatpipeError(f"The {kind.what} {path} cannot be read: {error.strerror}.", "Check the path.") from error
    lines = text_lines(text)
    long = next(
        (at for at, line in enumerate(lines, 1) if len(line) > MAX_LINE_CHARS or CONTROL_CHARACTERS.search(line)), None
    )
    if len(lines) > kind.max_lines or long is not None:
        what = f"more than {kind.max_lines:,} lines" if long is None else f"no plain text in line {long}"
        raise SplatpipeError(f"{name} has {what}.", kind.expected)
    return list(enumerate(lines, 1))


def _text_of(data: bytes) -> str:
    """A file's text: UTF-8 or UTF-16, else Windows' western code page, in which spreadsheets save a CSV.

    Raises:
        UnicodeDecodeError: if it is none of these.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        foreign = sum(byte > 0x7F for byte in data)
        if b"\0" in data or foreign > MAX_FOREIGN_SHARE * len(data):
            raise
        return data.decode("cp1252")


def written_lines(lines: Sequence[tuple[int, str]], path: Path, kind: TableKind) -> list[tuple[int, str]]:
    """The lines that are neither blank nor comments.

    Raises:
        SplatpipeError: if there is none.
    """
    written = [(number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]
    if written and SEPARATOR_LINE.fullmatch(written[0][1].strip()):
        del written[0]
    if not written:
        raise SplatpipeError(f"The {kind.what} {path.name} is empty.", kind.expected)
    return written


@contextmanager
def line_errors(path: Path, kind: TableKind) -> Iterator[None]:
    """Turn a ``LineError`` into the message for the user, which names the file and the line."""
    try:
        yield
    except LineError as error:
        where = f"Line {error.line} of" if error.line else f"The {kind.what}"
        raise SplatpipeError(f"{where} {path.name}: {error}.", error.hint or kind.expected) from error


def delimiter_of(line: str) -> str:
    """The delimiter between the cells of a header."""
    return max(",;\t", key=line.count)


def cells_of(line: str, delimiter: str) -> list[str]:
    """The cells of a table's line; of several blanks between them, one counts.

    Raises:
        csv.Error: if it has no such cells.
    """
    line = line.replace("\t", " ").strip() if delimiter == " " else line
    return next(csv.reader([line], delimiter=delimiter, skipinitialspace=delimiter == " "), [])


def titles_of(line: str) -> tuple[list[str], str]:
    """The titles of a header, which may be a comment as in Metashape's files, and its delimiter; none if it is none."""
    line = line.strip().lstrip("#").strip() if line.lstrip().startswith("#") else line
    delimiter = delimiter_of(line)
    if delimiter not in line and " " in line:
        delimiter = " "
    try:
        return cells_of(line, delimiter), delimiter
    except csv.Error:
        return [], delimiter


def find_header(
    lines: Sequence[tuple[int, str]], written: Sequence[tuple[int, str]], is_header: Callable[[str], bool]
) -> int | None:
    """The line number of a table's header: one of the first two written lines, or a comment before the first row."""
    header = next((number for number, line in written[:2] if is_header(line)), None)
    if header is not None:
        return header
    last = written[0][0] if len(written) == 1 else written[1][0]
    comments = [(number, line) for number, line in lines if number < last and line.lstrip().startswith("#")]
    # Not by blanks: such a comment may explain the fields of ODM's list.
    return next((at for at, line in comments if titles_of(line)[1] != " " and is_header(line)), None)


def crs_text(text: str) -> str:
    """The CRS that a file states: its EPSG code wherever one is named, without a spreadsheet's empty cells."""
    text = text.strip().rstrip(",;\t ").strip('"').strip()
    if text.isdigit():
        return f"EPSG:{text}"
    codes = AUTHORITY.findall(text)
    return f"EPSG:{codes[-1]}" if codes and not re.match(r"EPSG\s*:\s*\d", text, re.IGNORECASE) else text


def list_separator(rows: Sequence[tuple[int, str]], numbers: Sequence[int]) -> str:
    """The separator of a list without a header: a semicolon or a comma; empty where blanks or tabs separate the fields.

    Args:
        rows: Its lines.
        numbers: The fields that are numbers in most lines, if the separator is the right one.
    """
    looked = [line for _, line in rows[:SAMPLE_LINES]]

    def fits(line: str, separator: str) -> bool:
        fields = line.split(separator)
        return len(fields) > max(numbers) and all(is_numeral(fields[at].strip()) for at in numbers)

    good = {sign: sum(fits(line, sign) for line in looked) for sign in ";,"}
    best = max(good, key=lambda sign: good[sign])
    return best if good[best] > len(looked) / 2 else ""


def list_fields(line: str, separator: str, tabs: int) -> list[str]:
    """The fields of a list's line; a name with blanks is one field where something else separates the fields.

    Args:
        line: The line.
        separator: Of the list.
        tabs: With so many tabs, they separate the fields of this line.
    """
    if separator:
        with contextlib.suppress(csv.Error):
            return [cell.strip() for cell in cells_of(line, separator)]
    if line.count("\t") >= tabs:
        return [QUOTED.sub(r"\1", field.strip()) for field in line.split("\t")]
    if QUOTED_FIELD.search(line):
        with contextlib.suppress(csv.Error):
            return cells_of(line, " ")
    return line.split()


def with_whole_name(fields: Sequence[str], at: int) -> list[str]:
    """Fields that blanks separate, with those of a photo's name joined: up to the first that ends in its suffix."""
    ends = (end for end in range(at, min(len(fields), at + MAX_NAME_WORDS)) if is_photo(PurePosixPath(fields[end])))
    end = next(ends, at)
    return [*fields[:at], " ".join(fields[at : end + 1]), *fields[end + 1 :]] if at < len(fields) else list(fields)


def find_columns(titles: Sequence[str], spellings: Mapping[str, Sequence[str]]) -> dict[str, int]:
    """The index of each known column, by our name for it; the first of several."""
    spelled = {spelling: key for key, each in spellings.items() for spelling in each}
    places: dict[str, int] = {}
    for place, title in enumerate(titles):
        key = spelled.get(title_of(title))
        if key is not None:
            places.setdefault(key, place)
    return places


def title_of(text: str) -> str:
    """Normalize a column's title for comparison with known spellings: without units in brackets."""
    return UNITS.sub("", text.strip().strip('"').lstrip("#").strip().casefold()).replace(" ", "_").replace("-", "_")


def is_numeral(text: str) -> bool:
    """Whether a text is a finite number, perhaps with a decimal comma."""
    return is_number(text.replace(",", ".") if DECIMAL_COMMA.fullmatch(text) else text)


def is_number(text: str) -> bool:
    """Whether a text is a finite number."""
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def number_in(line: int, what: str, text: str) -> float:
    """Parse a finite number that can be a coordinate; a decimal comma is accepted.

    Raises:
        LineError: if it is not such a number.
    """
    text = text.replace(",", ".") if DECIMAL_COMMA.fullmatch(text) else text
    if not is_number(text) or abs(float(text)) > MAX_COORDINATE:
        hint = next((hint for form, hint in MISWRITTEN if form.search(text)), "")
        raise LineError(line, f"{what} is {text[:40]!r}, which is not a valid number", hint)
    return float(text)


def csv_rows(
    lines: Sequence[tuple[int, str]],
    written: Sequence[tuple[int, str]],
    header: int,
    columns: Mapping[str, tuple[str, ...]],
) -> tuple[str, list[tuple[int, Mapping[str, str]]]]:
    """The CRS of a table with a header, and its rows by the columns' names, numbered by their lines.

    The CRS is in the line before the header, in a comment, or in a column. Without it, degrees are taken as WGS 84:
    those of their own columns, if the table has other coordinates, too.

    Args:
        lines: All lines of the file.
        written: Those that are neither blank nor comments.
        header: Line number of the header.
        columns: Titles of each column, in lower case.

    Raises:
        LineError: if a line is broken, or the table names no CRS or two.
    """
    titles, delimiter = titles_of(lines[header - 1][1])
    places = find_columns(titles, columns)
    comments = (CRS_COMMENT.match(text.strip()) for _, text in lines)
    above = next((text for number, text in written if number < header), "")
    crs = crs_text(above or next((found[1] for found in comments if found), ""))
    rows: list[tuple[int, list[str]]] = []
    for number, text in written:
        if number <= header:
            continue
        try:
            cells = cells_of(text, delimiter)
        except csv.Error as error:
            raise LineError(number, str(error)) from error
        if delimiter == "," and len(cells) >= len(titles) + 2:
            _require_decimal_points(number, cells, places)
        place = places.get("crs", len(cells))
        stated = crs_text(cells[place]) if place < len(cells) else ""
        if stated and crs and crs.casefold() != stated.casefold():
            raise LineError(number, f"another CRS ({stated[:40]}) than before ({crs[:40]})", "Use one CRS a file.")
        crs = stated or crs
        rows.append((number, _whole(cells, titles, places) if delimiter == " " else cells))
    places, crs = _with_degrees(titles, places, crs)
    places = _with_grid(titles, places, crs, columns)
    if not crs:
        raise LineError(0, "it states no CRS", "Put it in the first line, e.g. EPSG:32633, or in a column crs.")
    named: list[tuple[int, Mapping[str, str]]] = [
        (number, {name: cells[at].strip() if at < len(cells) else "" for name, at in places.items()})
        for number, cells in rows
    ]
    return crs, named


def _require_decimal_points(number: int, cells: Sequence[str], places: Mapping[str, int]) -> None:
    """Reject coordinates with decimal commas in a table that commas separate: their halves would be read as numbers.

    Raises:
        LineError: if all coordinates are two whole numbers each.
    """
    of_coordinates = [places[name] for name in ("x", "y", "z") if name in places]
    halves = [cell.strip() for cell in cells[min(of_coordinates, default=0) :][: 2 * len(of_coordinates)]]
    whole = all(map(WHOLE.fullmatch, halves[::2])) and all(map(DECIMALS.fullmatch, halves[1::2]))
    if halves and whole:
        raise LineError(
            number,
            "commas separate both the columns and the decimals",
            "Separate the columns by semicolons, or write decimals with points.",
        )


def _with_grid(
    titles: Sequence[str], places: Mapping[str, int], crs: str, columns: Mapping[str, tuple[str, ...]]
) -> dict[str, int]:
    """The columns of a table of both degrees and a projected CRS's coordinates: these, if it states such a CRS."""
    if not crs or title_of(titles[places["x"]]) not in GEOGRAPHIC:
        return dict(places)
    degrees = {*GEOGRAPHIC, *GEOGRAPHIC_Y, *ELLIPSOIDAL_Z}
    grid = find_columns(titles, {name: [each for each in columns[name] if each not in degrees] for name in "xyz"})
    if "x" not in grid or "y" not in grid or _is_geographic(crs):
        return dict(places)
    heights = [at for at, title in enumerate(titles) if title_of(title) in ORTHOMETRIC]
    return {**places, **grid, **({"z": heights[0]} if heights else {})}


def _is_geographic(text: str) -> bool:
    from splatpipe.pipeline.survey.crs.crs_names import parse_crs  # loads PROJ, which few tables need here

    try:
        return parse_crs(text).is_geographic
    except SplatpipeError:
        return True  # unknown: the message says so, once the table is read


def _whole(cells: Sequence[str], titles: Sequence[str], places: Mapping[str, int]) -> list[str]:
    """Cells that blanks separate, with those of a photo's name joined if there are more than titles."""
    at = places.get("photo", places.get("name", 0))
    return with_whole_name(cells, at) if len(cells) > len(titles) else list(cells)


def _with_degrees(titles: Sequence[str], places: Mapping[str, int], crs: str) -> tuple[dict[str, int], str]:
    """The columns and the CRS of a table: without a CRS, or with one by a name alone, degrees count if it has any."""
    known = [title_of(title) for title in titles]
    x, y, z = (
        next((at for at, title in enumerate(known) if title in each), None)
        for each in (GEOGRAPHIC, GEOGRAPHIC_Y, ELLIPSOIDAL_Z)
    )
    if x is None or y is None or (crs and (known[places["x"]] in GEOGRAPHIC or CODE.match(crs))):
        return dict(places), crs or ("EPSG:4326" if known[places["x"]] in GEOGRAPHIC else "")
    if z is not None:
        return {**places, "x": x, "y": y, "z": z}, "EPSG:4979"
    return {**places, "x": x, "y": y}, "EPSG:4326"
