"""A report made with the pictures of the last one is the same as one drawn anew."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from finished_run import linked_copy, write_apart

from splatpipe.pipeline.app.report import PICTURES_FILE, write_report
from splatpipe.pipeline.app.report.charts.gallery import Gallery
from splatpipe.pipeline.app.report.facts.report_inputs import read_report_inputs
from splatpipe.pipeline.app.report.page import report_content


@pytest.fixture
def out(demo_run: Path, tmp_path: Path) -> Path:
    return linked_copy(demo_run, tmp_path / "out")


def files(out: Path) -> tuple[bytes, bytes]:
    write_report(out)
    return (out / "report.html").read_bytes(), (out / "report.pdf").read_bytes()


def redrawn(out: Path) -> list[str]:
    """What the next report draws again."""
    gallery = Gallery.read(out)
    report_content(read_report_inputs(out), drawn=True, gallery=gallery)
    names = set(json.loads((out / PICTURES_FILE).read_text()))
    return sorted(names - set(gallery.reused))


def test_kept_pictures_give_the_same_bytes(out: Path) -> None:
    (out / PICTURES_FILE).unlink(missing_ok=True)
    fresh = files(out)
    assert redrawn(out) == []
    assert files(out) == fresh


def test_content_that_no_template_can_show_is_drawn_again(out: Path) -> None:
    fresh = files(out)
    entries = json.loads((out / PICTURES_FILE).read_text())
    for entry in entries.values():
        entry["content"] = '{"a": 1}'
        entry["digest"] = "f9d86028c6e0d64e225186f96acb69338b2c59764df79162107f5c4bb34d1310"  # of that
    write_apart(out / PICTURES_FILE, json.dumps(entries))
    assert files(out) == fresh
    assert redrawn(out) == []


def part(out: Path, name: str) -> Path:
    path = read_report_inputs(out).part(name)
    assert path is not None
    return path


@pytest.mark.parametrize(
    ("changed", "again"),
    [
        (lambda out: next(part(out, "evaluate.views").glob("*.render.png")), ["views"]),
        (lambda out: part(out, "georef.control"), ["georeferencing"]),
        (lambda out: part(out, "matches.pairs"), ["registration"]),
        (
            lambda out: part(out, "georef.frame"),
            ["capture", "geometry", "georeferencing", "registration", "views"],
        ),
    ],
)
def test_only_what_shows_a_changed_file_is_drawn_again(
    out: Path, changed: Callable[[Path], Path], again: list[str]
) -> None:
    write_report(out)
    path = changed(out)
    data = path.read_bytes()
    path.unlink()  # the copy shares it with the run
    path.write_bytes(data[:-1] + b" ")  # of another size, the whole stage would not count
    assert redrawn(out) == again
