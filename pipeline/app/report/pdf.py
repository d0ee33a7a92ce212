"""The report as PDF: the content of the page, shortened to what fits on a few pages, set by Typst.

The same content gives the same bytes: no date but the run's, no fonts but those that Matplotlib brings along.
"""

from __future__ import annotations

import base64
import importlib.util
import json
import math
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from splatpipe.pipeline.app.page_file import one_line
from splatpipe.pipeline.app.path_labels import PathLabels
from splatpipe.pipeline.engine.files.output_file import write_file

TEMPLATE = Path(__file__).resolve().parent / "templates" / "report.typ"
FONTS = Path("mpl-data", "fonts", "ttf")
MAX_MARKS = 14  # cuttings, the worst mark of each of the worst points
MAX_VIEWS = 3  # held-out photos with pictures: the worst ones, and the best
# Most entries of each list, by chapter; how many are left out is stated.
MAX_ENTRIES = {
    "capture": {"cameras": 10, "left_out": 15},
    "registration": {"unregistered": 40, "cameras": 10, "charts": 2},
    "georeferencing": {"left_out": 40, "points": 20},
    "views": {"rows": 12},
    "surfaces": {"facades": 8},
    "messages": {"warnings": 15, "notes": 15},
    "processing": {"rows": 30},
    "files": {"files": 30},
}
MAX_LENSES, MAX_LENS_CHARTS = 3, 2
MAX_SECTIONS, MAX_VOLUMES = 8, 20
MAX_PICTURES = 4  # of façades, and of sections
LETTERS = 600  # at most of one text, of which a whole log may come as a message

Chapter = dict[str, Any]


def report_pdf(content: Mapping[str, Any], places: PathLabels) -> bytes:
    """The report as a PDF, A4.

    Args:
        content: The report's content, as for the page.
        places: Folders of this machine, which the PDF must not reveal.

    Raises:
        RuntimeError: if it cannot be set.
        OSError: if there is no room for temporary files.
    """
    import typst

    with tempfile.TemporaryDirectory(prefix="splatpipe-report-") as name:
        folder = Path(name)
        values = _Files(folder, places).plain(shortened(content))
        write_file(folder / "report.json", json.dumps(values))
        template = folder / TEMPLATE.name
        write_file(template, TEMPLATE.read_bytes())
        fonts = [str(place / FONTS) for place in _folders_of("matplotlib")]
        compiler = typst.Compiler(str(template), str(folder), fonts, ignore_system_fonts=True)
        pdf = compiler.compile(format="pdf")
    assert isinstance(pdf, bytes)
    return pdf


def _folders_of(package: str) -> list[Path]:
    """The folders of a package, without importing it: that would take longer than the whole PDF."""
    found = importlib.util.find_spec(package)
    return [] if found is None else [Path(place) for place in found.submodule_search_locations or ()]


def shortened(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content for a few pages: the worst points, marks and photos, and in ``more`` how many others there are.

    Args:
        content: The report's content; it is not changed.
    """
    short = dict(content)
    for name in MAX_ENTRIES:
        chapter = content[name]
        if chapter is not None and "trouble" not in chapter:
            short[name] = _shortened_chapter(name, chapter)
    return short


def _shortened_chapter(name: str, chapter: Chapter) -> Chapter:
    chapter = {**chapter, "more": {}}
    change: Callable[[Chapter], Chapter] | None = _CHANGES.get(name)
    if change is not None:
        chapter = change(chapter)
    for key, most in MAX_ENTRIES[name].items():
        entries = list(chapter.get(key) or [])
        chapter["more"][key] = max(0, len(entries) - most) + int(chapter.pop(f"{key}_more", 0) or 0)
        chapter[key] = entries[:most]
    return chapter


def _georeferencing(chapter: Chapter) -> Chapter:
    chapter["points"] = sorted(chapter["points"], key=lambda point: -_length(point["residual"]))
    marks = [{**point["chips"][0], "point": point["name"], "role": point["role"]} for point in chapter["marks"]]
    marks = sorted(marks, key=lambda mark: -_length([mark["off"]]))[:MAX_MARKS]
    total = sum(len(point["chips"]) for point in chapter["marks"]) + chapter["marks_left_out"]
    chapter["more"] |= {"marks": total - len(marks), "lenses": 0}
    adjustment = chapter["adjustment"]
    if adjustment is not None:
        lenses = adjustment["lenses"]
        chapter["more"]["lenses"] = max(0, len(lenses) - MAX_LENSES) + adjustment["lenses_more"]
        chart_list = [*((adjustment["heights"] or {}).get("charts") or []), *adjustment["charts"]]
        adjustment = {**adjustment, "lenses": lenses[:MAX_LENSES], "charts": chart_list[:MAX_LENS_CHARTS]}
    return {**chapter, "marks": marks, "adjustment": adjustment, "charts": chapter.get("charts", [])}


def _views(chapter: Chapter) -> Chapter:
    shown = chapter["shown"]
    return {**chapter, "shown": shown if len(shown) <= MAX_VIEWS else [*shown[: MAX_VIEWS - 1], shown[-1]]}


def _surfaces(chapter: Chapter) -> Chapter:
    measured = chapter["measured"]
    sections, volumes = measured["sections"], measured["volumes"]
    chapter["more"] |= {
        "sections": max(0, len(sections) - MAX_SECTIONS),
        "volumes": max(0, len(volumes) - MAX_VOLUMES) + measured["more"],
    }
    measured = {**measured, "sections": _few_pictures(sections[:MAX_SECTIONS]), "volumes": volumes[:MAX_VOLUMES]}
    return {**chapter, "measured": measured, "facades": _few_pictures(chapter["facades"])}


def _files(chapter: Chapter) -> Chapter:
    files = chapter["files"]
    folders = Counter(file["name"].rpartition("/")[0] for file in files if "/" in file["name"])
    return {**chapter, "files": [file for file in files if "/" not in file["name"]], "inside": sorted(folders.items())}


def _few_pictures(rows: Sequence[Chapter]) -> list[Chapter]:
    """The rows, of which only the first keep their pictures."""
    return [
        row if number < MAX_PICTURES else {key: value for key, value in row.items() if key != "source"}
        for number, row in enumerate(rows)
    ]


_CHANGES: dict[str, Callable[[Chapter], Chapter]] = {
    "georeferencing": _georeferencing,
    "views": _views,
    "surfaces": _surfaces,
    "files": _files,
}


def _length(texts: Sequence[str]) -> float:
    """The length of a vector of formatted numbers; those that are unknown count as 0."""
    values = []
    for text in texts:
        try:
            values.append(float(text.replace(",", "").replace("−", "-")))
        except ValueError:
            values.append(0.0)
    return math.hypot(*values)


class _Files:
    """Turns content into what JSON can say; charts and pictures become files beside it.

    Args:
        folder: Receives the files.
        places: Folders of this machine, which are removed from all texts.
    """

    def __init__(self, folder: Path, places: PathLabels) -> None:
        self._folder, self._places = folder, places
        self._names: dict[str, str] = {}

    def plain(self, value: Any) -> Any:
        """A value without our types; a chart or picture as its file's name."""
        if isinstance(value, Markup):
            return self._file(str(value))
        if isinstance(value, str):
            text = one_line(self._places.plain(value))
            return text if len(text) <= LETTERS else f"{text[:LETTERS]} …"
        if is_dataclass(value) and not isinstance(value, type):
            return self.plain({field.name: getattr(value, field.name) for field in fields(value)})
        if isinstance(value, Mapping):
            return {str(key): self.plain(each) for key, each in value.items()}
        if isinstance(value, Sequence):
            return [self.plain(each) for each in value]
        if isinstance(value, float) and not math.isfinite(value):
            return None
        return value if isinstance(value, bool | int | float) else None if value is None else self.plain(str(value))

    def _file(self, markup: str) -> str:
        if markup not in self._names:
            head, _, body = markup.partition(",")
            is_picture = head.startswith("data:image/")
            ending = "svg" if not is_picture else "png" if "png" in head else "jpg"
            name = f"{len(self._names)}.{ending}"
            write_file(self._folder / name, base64.b64decode(body) if is_picture else markup)
            self._names[markup] = name
        return self._names[markup]
