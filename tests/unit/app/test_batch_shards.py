"""A batch whose pipeline has a sharded stage: one job per shard counted by the stage before it."""

import time
from collections.abc import Sequence
from pathlib import Path

import pytest
import sharded

from splatpipe.pipeline.app.batch.driver import fresh_call
from splatpipe.pipeline.app.batch.jobs.attempts import Attempt, AttemptLog, AttemptResult, spent_s
from splatpipe.pipeline.app.batch.jobs.job import command_of
from splatpipe.pipeline.app.batch.jobs.plan import BatchPlan, Call, PlannedCapture, StageJob
from splatpipe.pipeline.app.batch.jobs.workflow import workflow_text
from splatpipe.pipeline.app.batch.monitor import BatchMonitor
from splatpipe.pipeline.engine.errors import EXIT_STAGE

BAD = AttemptResult(EXIT_STAGE, "The stage sum.2 died.", "See the log.")


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
    assert words[4:] == [
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
