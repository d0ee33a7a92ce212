"""A report that takes chapters over from the last one is the same as one drawn anew."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from command import answered
from finished_run import linked_copy, write_apart

from splatpipe.pipeline.app.report import RECORD_FILE, write_report
from splatpipe.pipeline.app.report.facts.last_report import SEEN, LastReport
from splatpipe.pipeline.app.report.facts.report_inputs import read_report_inputs
from splatpipe.pipeline.app.report.page import report_content


@pytest.fixture
def out(demo_run: Path, tmp_path: Path) -> Path:
    out = linked_copy(demo_run, tmp_path / "out")
    write_report(out)
    return out


def files(out: Path) -> tuple[bytes, bytes]:
    return (out / "report.html").read_bytes(), (out / "report.pdf").read_bytes()


def last_report(out: Path) -> LastReport:
    return LastReport.read(read_report_inputs(out), out / "report.html", out / RECORD_FILE)


def drawn(out: Path) -> set[str]:
    """The chapters that the next report does not take over."""
    last = last_report(out)
    report_content(last.inputs, drawn=True, last=last)
    return {name for name in SEEN if last.kept[name][0] != last.shown[name][0]}


def change(path: Path) -> None:
    """Write a file's bytes into a new one in its place."""
    data = path.read_bytes()
    path.unlink()  # the copy shares it with the run
    path.write_bytes(data)


def test_after_an_export_it_has_the_bytes_of_one_drawn_anew_and_needs_no_library_that_draws(out: Path) -> None:
    answered("export", str(out), "--format", "spz")
    taken_over = files(out)
    assert b"export/splat.spz" in taken_over[0] and b"<svg role=" in taken_over[0]
    code = (
        "import sys; from pathlib import Path; from splatpipe.pipeline.app.report import write_report\n"
        f"write_report(Path({str(out)!r}))\n"
        "print([name for name in ('matplotlib', 'torch', 'pycolmap', 'cv2', 'numpy') if name in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"
    assert files(out) == taken_over
    write_report(out, anew=True)
    assert files(out) == taken_over


def test_only_what_shows_a_changed_artifact_is_drawn_again(out: Path) -> None:
    parts = read_report_inputs(out).contents.parts
    (out / "linked.ply").hardlink_to(parts["clean.model"].path)  # as every command does with its deliverables
    assert drawn(out) == set()
    expected: set[str] = set()
    for path, more in (
        (next(parts["undistort.dataset"].path.rglob("*.bin")), set()),
        (parts["train.history"].path, {"training"}),
        (parts["matches.pairs"].path, {"registration"}),
        (next(parts["evaluate.views"].path.glob("*.render.png")), {"views", "georeferencing"}),
        (parts["georef.frame"].path, {"capture"}),
    ):
        change(path)
        expected |= more
        assert drawn(out) == expected


def test_nothing_is_taken_over_from_elsewhere_from_a_changed_page_or_a_damaged_record(
    out: Path, tmp_path: Path
) -> None:
    before, record = files(out), json.loads((out / RECORD_FILE).read_text())
    assert last_report(out).kept
    for copied in (shutil.copytree(out, tmp_path / "a" / "out"), linked_copy(out, tmp_path / "b" / "out")):
        assert files(copied) == before
        assert not last_report(copied).kept
    write_report(out)  # links have changed its ctime
    damaged: tuple[dict[str, Any], ...] = ({}, {**record, "chapters": 1}, {**record, "sha256": "0"})
    for other in damaged:
        write_apart(out / RECORD_FILE, json.dumps(other))
        assert not last_report(out).kept
    write_report(out)
    assert drawn(out) == set()
    record = json.loads((out / RECORD_FILE).read_text())
    places = [{"picture-at": ["a"]}, {"picture-at": 1}, {"picture-at": [0]}]
    for chapter, place in zip(record["chapters"].values(), places, strict=False):
        chapter[1] = place
    record["chapters"]["views"] = []
    write_apart(out / RECORD_FILE, json.dumps(record))
    write_report(out)
    assert files(out) == before
    page = out / "report.html"
    page.write_bytes(before[0].replace(b"<path", b"<evil", 1))
    assert not last_report(out).kept
