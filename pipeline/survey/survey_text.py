"""Read surveyors' text tables from untrusted files: everything has a limit, and every error names its line."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.small_file import read_small
from splatpipe.pipeline.engine.text_lines import text_lines

MAX_LINE_CHARS = 2000
LARGEST = 1e9  # of a coordinate, metres or pixels: larger ones are neither on the earth nor in a photo
UNKNOWN = ("", "-", "nan", "none", "null", "n/a")
CRS_COMMENT = re.compile(r"#\s*(?:crs|srs|epsg)\s*[:=]\s*(\S.*)", re.IGNORECASE)
GEOGRAPHIC = ("lon", "lng", "long", "longitude", "gpslongitude", "x/longitude")  # titles of x that name no other CRS
DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
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
        text = read_small(path, kind.max_bytes).decode("utf-8-sig")
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


def written_lines(lines: Sequence[tuple[int, str]], path: Path, kind: TableKind) -> list[tuple[int, str]]:
    """The lines that are neither blank nor comments.

    Raises:
        SplatpipeError: if there is none.
    """
    written = [(number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]
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
    """Normalize a column's title for comparison with known spellings."""
    return text.strip().casefold().replace(" ", "_")


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
    if not is_number(text) or abs(float(text)) > LARGEST:
        raise LineError(line, f"{what} is {text[:40]!r}, which is not a valid number")
    return float(text)


def csv_rows(
    lines: Sequence[tuple[int, str]],
    written: Sequence[tuple[int, str]],
    header: int,
    columns: Mapping[str, tuple[str, ...]],
) -> tuple[str, list[tuple[int, Mapping[str, str]]]]:
    """The CRS of a table with a header, and its rows by the columns' names, numbered by their lines.

    The CRS is in the line before the header, in a comment, or in a column; without it, degrees are taken as WGS 84.

    Args:
        lines: All lines of the file.
        written: Those that are neither blank nor comments.
        header: Index of the header among them, 0 or 1.
        columns: Titles of each column, in lower case.

    Raises:
        LineError: if a line is broken, or the table names no CRS or two.
    """
    _, line = written[header]
    delimiter = delimiter_of(line)
    titles = next(csv.reader([line], delimiter=delimiter))
    places = find_columns(titles, columns)
    comments = (CRS_COMMENT.match(text.strip()) for _, text in lines)
    crs = written[0][1].strip() if header == 1 else next((found[1].strip() for found in comments if found), "")
    rows: list[tuple[int, Mapping[str, str]]] = []
    for number, text in written[header + 1 :]:
        try:
            cells = next(csv.reader([text], delimiter=delimiter))
        except csv.Error as error:
            raise LineError(number, str(error)) from error
        row = {name: cells[place].strip() if place < len(cells) else "" for name, place in places.items()}
        stated = f"EPSG:{row['crs']}" if row.get("crs", "").isdigit() else row.get("crs", "")
        if stated and crs and crs.casefold() != stated.casefold():
            raise LineError(number, f"another CRS ({stated[:40]}) than before ({crs[:40]})", "Use one CRS a file.")
        crs = stated or crs
        rows.append((number, row))
    if not crs and title_of(titles[places["x"]]) in GEOGRAPHIC:
        crs = "EPSG:4326"
    if not crs:
        raise LineError(0, "it states no CRS", "Put it in the first line, e.g. EPSG:32633, or in a column crs.")
    return crs, rows
