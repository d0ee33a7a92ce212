"""A batch of captures on Snakemake: each in the right state, nothing repeated or left behind, honest reports."""

import csv
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from batch_captures import call_of, demo, link, planned

from splatpipe.pipeline.app.batch.capture_list import read_captures
from splatpipe.pipeline.app.batch.driver import fresh_call, lock_folder, with_unlisted
from splatpipe.pipeline.app.batch.jobs.attempts import AttemptLog, AttemptResult
from splatpipe.pipeline.app.batch.jobs.plan import BatchPlan
from splatpipe.pipeline.app.batch.jobs.workflow import workflow_text
from splatpipe.pipeline.app.batch.monitor import BatchMonitor
from splatpipe.pipeline.app.batch.pages.publication import COLUMNS, table_text
from splatpipe.pipeline.app.batch.pages.state import BatchState, CaptureState
from splatpipe.pipeline.app.batch.planning import Settings, make_plan
from splatpipe.pipeline.app.library.requests import SPENT_VARIABLE, spent_s
from splatpipe.pipeline.engine.errors import EXIT_INPUT, EXIT_MACHINE, EXIT_STAGE, UsageError
from splatpipe.stages.line import LINE

BAD = AttemptResult(EXIT_STAGE, "The stage train died.", "See the log.")


PERMANENT = AttemptResult(EXIT_INPUT, "No two photos overlap.", "Fly again.", final=True)


FULL = AttemptResult(EXIT_MACHINE, "The disk is full.", "Make room.")


@pytest.mark.parametrize(
    ("tries", "ended", "expected"),
    [
        ([], False, ("waiting", "ingest", 0.0, 0, "")),
        ([], True, ("stopped", "ingest", 0.0, 0, "It was stopped with the batch.")),
        ([("ingest", AttemptResult(0))], False, ("waiting", "train", 0.25, 0, "")),
        ([("ingest", AttemptResult(0)), ("train", None)], False, ("running", "train", 0.25, 1, "")),
        ([("ingest", AttemptResult(0)), ("train", BAD)], False, ("waiting", "train", 0.25, 1, "")),
        (
            [("ingest", AttemptResult(0)), ("train", BAD), ("train", FULL)],
            False,
            ("failed", "train", 0.25, 2, FULL.message),
        ),
        ([("ingest", PERMANENT)], False, ("failed", "ingest", 0.0, 1, PERMANENT.message)),
        ([("ingest", AttemptResult(0)), ("train", BAD), ("train", AttemptResult(0))], True, ("done", "", 1.0, 2, "")),
    ],
)
def test_a_captures_state_follows_from_its_attempts_alone(
    tmp_path: Path, tries: Sequence[tuple[str, AttemptResult | None]], ended: bool, expected: tuple[object, ...]
) -> None:
    call = call_of(tmp_path, planned("house", "ingest", "train"))
    log = AttemptLog(call.attempts_file("0001-house"))
    for stage, ending in tries:
        log.begin(stage)
        if ending is not None:
            log.end(ending)
    if tries:
        with call.attempts_file("0001-house").open("ab") as file:
            file.write(b'{"ended": {"exit_c')  # as after a power cut
    if ended:
        call.write_end(time.time(), 0, "")
    (house,) = BatchMonitor(call).state().captures
    assert (house.state, house.stage, house.progress, house.tries, house.reason) == expected
    assert house.earlier == (("train: The stage train died.",) if ("train", BAD) in tries else ())


def test_the_workflow_has_a_rule_for_each_stage_that_runs_with_its_resources(tmp_path: Path) -> None:
    call = call_of(tmp_path / "a b{c}", planned("house", "georef", "train"), replace(planned("barn"), key="0002-barn"))
    text = workflow_text(call, replace(call.plan(), gpu=True), LINE)
    assert [line for line in text.splitlines() if line.startswith("rule ")] == [
        "rule all:",
        "rule georef:",
        "rule train_shard:",
        "rule train:",
    ]
    assert text.count("gpu=1") == 2 and "0002-barn" not in text  # without blocks the last one trains everything
    assert '"train": [2, 900, 21, 50]' in text
    assert "gpu" not in workflow_text(call, call.plan(), LINE)


def test_an_unreadable_control_file_is_reported_without_a_job_until_it_is_corrected(tmp_path: Path) -> None:
    house = link(tmp_path / "captures" / "house", demo()[:2])
    (house / "gcp_list.txt").write_text("EPSG:4326\n1 2 three 4 5 a.jpg\n")
    call = fresh_call(tmp_path / "out")
    for settings in (Settings("preview"), Settings("preview", retry_failed=True)):
        (planned,) = make_plan(read_captures(tmp_path / "captures", call.out), call, settings).captures
        assert "three" in planned.message and planned.jobs == () and planned.photo_count == 2
    (house / "gcp_list.txt").unlink()
    (planned,) = make_plan(read_captures(tmp_path / "captures", call.out), call, Settings("preview")).captures
    assert planned.message == "" and len(planned.jobs) == len(LINE) - 2  # nobody reads depths


def test_a_cell_of_the_table_is_never_a_formula() -> None:
    state = BatchState("night", (CaptureState("=1+1", reason="@SUM(A1)"),), as_of_s=0.0, began_s=0.0)
    (row,) = csv.DictReader(table_text(state).splitlines())
    assert tuple(row) == COLUMNS and row["capture"] == "'=1+1" and row["reason"] == "'@SUM(A1)"


def test_a_time_budget_includes_the_captures_earlier_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    for value, expected in (("90.5", 90.5), ("-3", 0.0), ("soon", 0.0)):
        monkeypatch.setenv(SPENT_VARIABLE, value)
        assert spent_s() == expected


@pytest.mark.parametrize("name", [".batch", ".batch/call", ".batch/dry-run", ".batch/pictures"])
def test_a_link_below_the_folder_is_refused_and_its_target_kept(tmp_path: Path, name: str) -> None:
    precious = tmp_path / "precious" / "call"
    precious.mkdir(parents=True)
    (tmp_path / "out").mkdir()
    link = tmp_path / "out" / name
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(precious.parent)
    for called in ("call", "dry-run"):
        with pytest.raises(UsageError, match=f"out/{name} is a link"):
            fresh_call(tmp_path / "out", called)
    with pytest.raises(UsageError, match=f"out/{name} is a link"), lock_folder(tmp_path / "out"):
        pass
    assert precious.is_dir()


def test_the_folder_of_a_batch_may_be_a_link_and_that_of_a_capture_not(tmp_path: Path) -> None:
    link_photos = link(tmp_path / "captures" / "house", demo()[:2])
    disk = tmp_path / "disk"
    disk.mkdir()
    (tmp_path / "out").symlink_to(disk)
    call = fresh_call(tmp_path / "out")
    assert call.folder == disk / ".batch/call"
    (disk / "house").symlink_to(link_photos.parent)
    (planned,) = make_plan(read_captures(tmp_path / "captures", call.out), call, Settings("preview")).captures
    assert "house is a link" in planned.message and planned.jobs == ()


@pytest.mark.parametrize(
    "listed", ['["../elsewhere", "/ABSOLUTE", "linked", "..", "\\u0000", 7, [1], null]', "7", "{}", "["]
)
def test_only_runs_in_the_batchs_folder_are_named_as_unlisted(tmp_path: Path, listed: str) -> None:
    out = tmp_path / "out"
    for folder in (out / ".batch", out / "earlier/stages", tmp_path / "elsewhere/stages"):
        folder.mkdir(parents=True)
    (out / "linked").symlink_to(tmp_path / "elsewhere")
    plan = BatchPlan(str(out), 0.0, ())
    names = out / ".batch/captures.json"
    names.write_text(listed.replace("/ABSOLUTE", str(tmp_path / "elsewhere")))
    assert with_unlisted(plan).unlisted == ()
    names.write_text('["earlier"]')
    assert with_unlisted(plan).unlisted == ("earlier",)
