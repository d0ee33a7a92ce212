"""Editing of marks in a control file line by line; everything else in it, including comments, is preserved.

Two comments are our own. ``# not visible:`` records that a photo does not show a point, so that it is not checked
again; ``# unmarked:`` keeps the coordinates of a point in ODM's list, which stores points only with their marks.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.survey.files.control_file import (
    COLUMNS,
    MIN_TABS,
    SurveyedPoint,
    Table,
    fields_of,
    parse_table,
    read_table,
)
from splatpipe.pipeline.survey.files.survey_text import cells_of, find_columns, is_number, titles_of

HIDDEN, UNMARKED = "# not visible:", "# unmarked:"
CSV_TITLES = ("name", "x", "y", "z", "photo", "pixel_x", "pixel_y", "role", "sigma_h", "sigma_v")
CSV_KEYS = ("name", "x", "y", "z", "photo", "px", "py", "role", "sigma_horizontal", "sigma_vertical")
MARKED = ("photo", "px", "py")
BOM = "\ufeff"

FindPhoto = Callable[[str], str | None]


@dataclass(frozen=True)
class ControlText:
    """A control file that is being marked.

    Attributes:
        path: The file, which may not exist yet.
        table: Its contents.
        find: Returns the photo of the capture that a name refers to.
        newline: Its line ending.
        bom: Whether it begins with a byte order mark.
    """

    path: Path
    table: Table
    find: FindPhoto = field(repr=False, compare=False)
    newline: str = "\n"
    bom: bool = False

    @staticmethod
    def read(path: Path, find: FindPhoto) -> ControlText:
        """Read an existing file.

        Raises:
            SplatpipeError: if it is not a control file.
        """
        table = _with_columns(read_table(path), path)
        raw = path.read_bytes()
        return ControlText(path, table, find, "\r\n" if b"\r\n" in raw else "\n", raw.startswith(BOM.encode()))

    @staticmethod
    def begin(path: Path, crs: str, as_csv: bool, find: FindPhoto) -> ControlText:
        """Return the text of a new file: ODM's list or, if ``as_csv``, a CSV, which can state roles and accuracies."""
        lines = [crs, ",".join(CSV_TITLES)] if as_csv else [crs]
        return ControlText(path, Table(tuple(enumerate(lines, 1)), 2 if as_csv else None, crs, ()), find)

    @property
    def marks(self) -> dict[str, dict[str, tuple[float, float]]]:
        """Pixels as written, by point and photo; marks in photos outside the capture are omitted."""
        found: dict[str, dict[str, tuple[float, float]]] = {}
        for name, rows in self.table.groups.items():
            seen = found.setdefault(name, {})
            for row in rows:
                photo = None if row.mark is None else self.find(row.mark.photo)
                if row.mark is not None and photo is not None:
                    seen.setdefault(photo, (row.mark.x, row.mark.y))
        return found

    @property
    def hidden(self) -> set[tuple[str, str]]:
        """Pairs of point and photo that are recorded as not visible."""
        named = (line[len(HIDDEN) :].strip().split("\t") for _, line in self.table.lines if line.startswith(HIDDEN))
        return {(fields[0], fields[1]) for fields in named if len(fields) == 2}

    @property
    def unmarked(self) -> list[SurveyedPoint]:
        """Points of ODM's list whose last mark was removed."""
        found = []
        for _, line in self.table.lines:
            fields = line[len(UNMARKED) :].strip().split("\t") if line.startswith(UNMARKED) else []
            if len(fields) == 4 and all(is_number(text) for text in fields[:2]):
                z = float(fields[2]) if is_number(fields[2]) else None
                found.append(SurveyedPoint(fields[3], float(fields[0]), float(fields[1]), z, (None, None), None, ()))
        return found

    def with_mark(self, point: SurveyedPoint, photo: str, pixel: tuple[float, float]) -> ControlText:
        """Return the text with a mark added or moved; this removes the comment that the point is not visible there."""
        text = self.with_hidden(point.name, photo, hidden=False)
        group = text.table.groups.get(point.name, [])
        here = next((row for row in group if row.mark and self.find(row.mark.photo) == photo), None)
        here = here or next((row for row in group if row.mark is None), None)
        if here is not None:
            return text._put(here.line, text._marked(text._line(here.line), photo, pixel, keep=here.mark is not None))
        text = text._without_comment(lambda line: line.startswith(UNMARKED) and line.endswith(f"\t{point.name}"))
        group = text.table.groups.get(point.name, [])
        like = text._line(group[-1].line) if group else text._new_line(point, photo)
        at = group[-1].line if group else len(text.table.lines)
        return text._insert(at, text._marked(like, photo, pixel, keep=False))

    def without_mark(self, point: SurveyedPoint, photo: str) -> ControlText:
        """Return the text without a mark; the point is kept."""
        group = self.table.groups.get(point.name, [])
        here = next((row for row in group if row.mark and self.find(row.mark.photo) == photo), None)
        if here is None:
            return self
        numbered = any(not row.name for row in self.table.rows)  # named by their first lines, which must stay
        if self.table.header is not None and (numbered or len(group) == 1):
            return self._put(here.line, self._marked(self._line(here.line), "", None, keep=False))
        if numbered:
            return self._named().without_mark(point, photo)
        if len(group) > 1:
            return self._put(here.line, None)
        fields = fields_of(self._line(here.line), self.table.separator)[:3]
        return self._put(here.line, f"{UNMARKED}\t" + "\t".join([*fields, point.name]))

    def with_hidden(self, point: str, photo: str, hidden: bool) -> ControlText:
        """Return the text with, or without, the comment that a photo does not show a point."""
        comment = f"{HIDDEN}\t{point}\t{photo}"
        if not hidden:
            return self._without_comment(lambda line: line.rstrip() == comment)
        return self if (point, photo) in self.hidden else self._insert(len(self.table.lines), comment)

    def save(self) -> None:
        """Replace the file atomically, so that it is complete even after a power cut.

        Raises:
            MachineError: if it cannot be written.
        """
        target = self.path.resolve()  # keep a symbolic link
        text = (BOM if self.bom else "") + "".join(line + self.newline for _, line in self.table.lines)
        try:
            write_durably(target, text)
        except OSError as error:
            raise MachineError(
                f"Cannot write {self.path}: {error.strerror}.", hint="Check its permissions and the free space."
            ) from error

    def _named(self) -> ControlText:
        """Return the text of ODM's list with the implicit names of unnamed points written out."""
        lines = [text for _, text in self.table.lines]
        for name, group in self.table.groups.items():
            for row in group:
                if not row.name:
                    fields = fields_of(lines[row.line - 1], self.table.separator)
                    fields[6:7] = [name]
                    lines[row.line - 1] = _joined(fields, self.table.separator, tabs=True)
        return self._with_lines(lines)

    def _line(self, number: int) -> str:
        return self.table.lines[number - 1][1]

    def _marked(self, line: str, photo: str, pixel: tuple[float, float] | None, keep: bool) -> str:
        """Return an observation's line with a new pixel and, unless ``keep``, a new photo name."""
        pixel_fields = ("", "") if pixel is None else (f"{pixel[0]:.2f}", f"{pixel[1]:.2f}")
        if self.table.header is None:
            fields = fields_of(line, self.table.separator)
            fields[3:5] = pixel_fields
            fields[5] = fields[5] if keep else photo
            return _joined(fields, self.table.separator, tabs=line.count("\t") >= MIN_TABS)
        delimiter, columns = self._columns()
        cells = cells_of(line, delimiter)
        cells += [""] * (max(columns.values()) + 1 - len(cells))
        cells[columns["px"]], cells[columns["py"]] = pixel_fields
        cells[columns["photo"]] = cells[columns["photo"]] if keep else photo
        return _csv_line(cells, delimiter)

    def _new_line(self, point: SurveyedPoint, photo: str) -> str:
        """Return an observation's line for a point that is not in the file yet, without its pixel."""
        height = "NaN" if point.z is None else repr(point.z)
        if self.table.header is None:
            return _joined([repr(point.x), repr(point.y), height, "0", "0", photo, point.name], self.table.separator)
        delimiter, columns = self._columns()
        stated = [point.name, repr(point.x), repr(point.y), height, photo, "", "", point.role or ""]
        stated += ["" if sigma is None else repr(sigma) for sigma in point.sigma_m]
        cells = [""] * (max(columns.values()) + 1)
        for key, text in zip(CSV_KEYS, stated, strict=True):
            if key in columns:
                cells[columns[key]] = text
        if "crs" in columns:
            cells[columns["crs"]] = self.table.crs
        return _csv_line(cells, delimiter)

    def _columns(self) -> tuple[str, Mapping[str, int]]:
        assert self.table.header is not None
        titles, delimiter = titles_of(self._line(self.table.header))
        return delimiter, find_columns(titles, COLUMNS)

    def _without_comment(self, wanted: Callable[[str], bool]) -> ControlText:
        text = self
        for number, line in reversed(self.table.lines):
            if line.startswith("#") and wanted(line):
                text = text._put(number, None)
        return text

    def _put(self, number: int, line: str | None) -> ControlText:
        """Return the text with a line replaced or, for None, removed."""
        lines = [text for _, text in self.table.lines]
        lines[number - 1 : number] = [] if line is None else [line]
        return self._with_lines(lines)

    def _insert(self, after: int, line: str) -> ControlText:
        lines = [text for _, text in self.table.lines]
        lines.insert(after, line)
        return self._with_lines(lines)

    def _with_lines(self, lines: Sequence[str]) -> ControlText:
        return replace(self, table=parse_table(tuple(enumerate(lines, 1)), self.path))


def _with_columns(table: Table, path: Path) -> Table:
    """Return a table of points with the columns for marks added."""
    if table.header is None:
        return table
    lines = [text for _, text in table.lines]
    titles = lines[table.header - 1]
    cells, delimiter = titles_of(titles)
    columns = find_columns(cells, COLUMNS)
    missing = [title for title, key in zip(CSV_TITLES, CSV_KEYS, strict=True) if key in MARKED and key not in columns]
    if not missing:
        return table
    lines[table.header - 1] = delimiter.join([titles, *missing])
    return parse_table(tuple(enumerate(lines, 1)), path)


def _joined(fields: Sequence[str], separator: str, tabs: bool = False) -> str:
    if separator:
        return _csv_line(fields, separator)
    return ("\t" if tabs or any(" " in text for text in fields) else " ").join(fields)


def _csv_line(cells: Sequence[str], delimiter: str) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, delimiter=delimiter, lineterminator="").writerow(cells)
    return buffer.getvalue()
