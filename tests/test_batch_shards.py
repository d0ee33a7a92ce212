"""A batch whose pipeline has a sharded stage: one job per shard counted by the stage before it."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from splatpipe.pipeline.app.batch.attempts import Attempt, AttemptLog, AttemptResult, read_attempts, spent_s
from splatpipe.pipeline.app.batch.driver import fresh_call
from splatpipe.pipeline.app.batch.job import command_of
from splatpipe.pipeline.app.batch.monitor import BatchMonitor
from splatpipe.pipeline.app.batch.plan import BatchPlan, Call, PlannedCapture, StageJob
from splatpipe.pipeline.app.batch.workflow import workflow_text
from splatpipe.pipeline.engine.errors import EXIT_STAGE

LINES = Path(__file__).parent / "lines"
sys.path.insert(0, str(LINES))
import sharded  # noqa: E402

NORTH, SOUTH = (3, 14, 15, 92), (2, 71)
TOTALS = {name: sum(number**2 for number in numbers) for name, numbers in (("north", NORTH), ("south", SOUTH))}
BAD = AttemptResult(EXIT_STAGE, "The stage sum.2 died.", "See the log.")


def captures(folder: Path) -> Path:
    for name, numbers in (("north", NORTH), ("south", SOUTH)):
        (folder / name).mkdir(parents=True)
        for at, number in enumerate(numbers):
            (folder / name / f"{at}.txt").write_text(str(number))
    listed = folder / "list.toml"
    listed.write_text('[[capture]]\nphotos = "north"\n[[capture]]\nphotos = "south"\n')
    return listed


def batch(listed: Path, out: Path, *more: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """The whole program with the pipeline of `sharded`."""
    path = os.pathsep.join([str(LINES / "sharded_site"), str(LINES), os.environ.get("PYTHONPATH", "")])
    words = [sys.executable, "-m", "splatpipe.pipeline.app.cli", "batch", str(listed), str(out), *more]
    return subprocess.run(
        words, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": path, **variables}
    )


def test_captures_run_in_shards_and_a_killed_shard_costs_only_its_own_job(tmp_path: Path) -> None:
    """Their number is known once the stage that counts them has run; in later runs, before anything runs."""
    listed, out = captures(tmp_path), tmp_path / "night"
    output = batch(listed, out, "--dry-run")
    assert output.returncode == 0 and "sum_shard" not in output.stderr
    assert "north: read, divide, sum, show (" in output.stderr and len(output.stderr.splitlines()) < 40
    done = batch(listed, out, "--until", "sum", "--threads", "1", "--json", SHARDED_KILL="2")
    assert done.returncode == 0, done.stderr
    sums = {path.parts[-4]: json.loads(path.read_text())["total"] for path in out.glob("*/stages/sum-*/total.json")}
    assert sums == TOTALS
    tries = {
        name: [each.stage for each in read_attempts(Call(out / ".batch" / "call").attempts_files(f"000{at}-{name}"))]
        for at, name in enumerate(TOTALS, 1)
    }
    assert sorted(tries["north"]) == ["divide", "read", "sum", "sum.1", "sum.2", "sum.2", "sum.2"]
    assert sorted(tries["south"]) == ["divide", "read", "sum", "sum.1"]
    assert not list(out.glob("*/stages/.partial/*"))
    changed = batch(listed, out, "--until", "sum", "--set", "sum.offset=1", "--dry-run")
    counts = dict(line.split() for line in changed.stderr.splitlines() if len(line.split()) == 2 and "sum" in line)
    assert counts["sum_shard"] == "3" and counts["sum"] == "2"
    # A shard's command reads the options in its OUT: a job before it writes them, even if everything is valid.
    listed.write_text('[[capture]]\nphotos = "south"\n')
    assert batch(listed, out, "--until", "sum", "--set", "sum.offset=1").returncode == 0
    totals = sorted(json.loads(path.read_text())["total"] for path in out.glob("south/stages/sum-*/total.json"))
    assert totals == [TOTALS["south"], TOTALS["south"] + len(SOUTH)]


def job(stage: str, seconds: float = 60.0) -> StageJob:
    return StageJob(stage, 2, 900_000_000, seconds, 50_000_000)


def call_of(out: Path) -> Call:
    weights = {"divide": 1.0, "sum": 6.0, "show": 1.0}
    jobs = (job("divide"), job("sum", 300.0), job("show"))
    call = fresh_call(out)
    capture = PlannedCapture("house", "0001-house", "/photos", "preview", jobs, weights)
    call.write_plan(BatchPlan(str(out), time.time(), (capture,), retries=1))
    return call


def test_the_workflow_has_a_job_per_shard_and_a_checkpoint_that_counts_them(tmp_path: Path) -> None:
    call = call_of(tmp_path)
    text = workflow_text(call, call.plan(), sharded.LINE)
    kinds = [line for line in text.splitlines() if line.startswith(("rule ", "checkpoint "))]
    assert kinds == ["rule all:", "checkpoint divide:", "rule sum_shard:", "rule sum:", "rule show:"]
    (house,) = call.plan().captures
    words = command_of(call, call.plan(), house, job("sum.2"), 3)
    assert words[3:] == [
        "stage", "sum", str(tmp_path / "house"), "--shard", "2", "--device", "auto", "--threads", "3", "--json",
    ]  # fmt: skip


def test_shards_have_their_own_share_of_a_stages_resources(tmp_path: Path) -> None:
    call = call_of(tmp_path)
    (house,) = call.plan().captures
    assert [each.stage for each in call.jobs(house)] == ["divide", "sum", "show"]
    call.write_shards(house.key, {"sum": [job("sum.1", 100.0), job("sum.2", 150.0)]})
    call.write_shards(house.key, {"sum": [job("sum.1", 1.0)]})  # known values are kept
    assert [(each.stage, each.seconds) for each in call.jobs(house)] == [
        ("divide", 60.0), ("sum.1", 100.0), ("sum.2", 150.0), ("sum", 50.0), ("show", 60.0),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("tries", "ended", "expected"),
    [
        ((), False, ("waiting", "sum.1", 0.125)),
        ((("sum.2", None),), False, ("running", "sum.2", 0.125)),
        ((("sum.1", AttemptResult(0)), ("sum.2", BAD)), False, ("waiting", "sum.2", 0.375)),
        ((("sum.2", BAD), ("sum.2", BAD)), False, ("waiting", "sum.1", 0.125)),
        ((("sum.2", BAD), ("sum.2", BAD), ("sum.1", None)), False, ("running", "sum.1", 0.125)),
        ((("sum.2", BAD), ("sum.2", BAD), ("sum.1", AttemptResult(0))), False, ("failed", "sum.2", 0.375)),
        ((("sum.2", BAD), ("sum.2", BAD)), True, ("failed", "sum.2", 0.125)),
        ((("sum.2", BAD),), True, ("stopped", "sum.1", 0.125)),
        ((("sum.1", AttemptResult(0)), ("sum.2", AttemptResult(0))), False, ("waiting", "sum", 0.625)),
    ],
)
def test_the_state_of_concurrent_shards_is_that_of_the_most_active(
    tmp_path: Path, tries: Sequence[tuple[str, AttemptResult | None]], ended: bool, expected: tuple[object, ...]
) -> None:
    call = call_of(tmp_path)
    call.write_shards("0001-house", {"sum": [job("sum.1"), job("sum.2")]})
    for stage, ending in (("divide", AttemptResult(0)), *tries):
        log = AttemptLog(call.attempts_file("0001-house", stage))
        log.begin(stage)
        if ending is not None:
            log.end(ending)
    if ended:
        call.write_end(time.time(), 0, "")
    (house,) = BatchMonitor(call).state().captures
    assert (house.state, house.stage, house.progress) == expected
    failed = house.state == "failed"
    assert house.reason == (BAD.message if failed else house.reason) and house.tries == (2 if failed else house.tries)


def test_time_of_concurrent_shards_counts_once() -> None:
    spans = ((0.0, 10.0), (12.0, 20.0), (13.0, 15.0), (14.0, 26.0), (30.0, None))
    assert spent_s([Attempt("sum.1", began, "here", 1, ended) for began, ended in reversed(spans)]) == 24.0
