"""Sharded stages: any process makes any shard in any order, a kill costs only its shard, the bits are the same."""

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import sharded
from command import splatpipe
from sharded_runs import NUMBERS, SHARDS, make_shard, request_of, statuses, walk

from splatpipe.pipeline.app.report.facts.run_history import read_history
from splatpipe.pipeline.app.view.log import RunLog
from splatpipe.pipeline.engine.errors import SplatpipeError, StageError, UsageError
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.runs.line import line_status
from splatpipe.pipeline.engine.runs.needs import Need, used_and_forecast
from splatpipe.pipeline.engine.runs.session import open_session, status_of
from splatpipe.pipeline.engine.stage import Summary, shards_first

pytestmark = pytest.mark.usefixtures("lines")


TOTAL = sum(number**2 for number in NUMBERS)


@pytest.fixture
def numbers(tmp_path: Path) -> Path:
    folder = tmp_path / "numbers"
    folder.mkdir()
    for at, number in enumerate(NUMBERS):
        (folder / f"{at}.txt").write_text(str(number))
    return folder


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def test_a_run_makes_the_shards_and_merges_them_and_a_second_one_reuses_them(numbers: Path, out: Path) -> None:
    first, events = walk(request_of(numbers, out))
    assert first.ran == ["read", "divide", *SHARDS, "sum", "show"]
    assert (out / "shown.txt").read_text() == str(TOTAL)
    started = {event.stage: event.data["reason"] for event in events if event.kind == "stage_started"}
    assert started["sum.2"] == "shard 2 of 3: not run yet"
    second, events = walk(request_of(numbers, out))
    assert second.ran == [] and [event.stage for event in events if event.stage] == ["read", "divide", "sum", "show"]


def test_a_killed_shard_costs_only_itself(numbers: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(sharded.KILL_VARIABLE, "2")
    with pytest.raises(StageError, match=r"sum\.2 was killed by SIGKILL"):
        walk(request_of(numbers, out))
    history = read_history(out / "events.jsonl", running=False)
    assert history.culprit is not None and history.culprit.name == "sum.2"
    log = RunLog(out, "events.jsonl")
    log.read()
    assert list(history.stages) == list(log.stages) == ["read", "divide", *SHARDS, "sum", "show"]
    assert [log.stages[name].state for name in (*SHARDS, "sum")] == ["done", "failed", "done", "waiting"]
    monkeypatch.delenv(sharded.KILL_VARIABLE)
    outcome, _ = walk(request_of(numbers, out))
    assert outcome.ran == ["sum.2", "sum", "show"]
    assert outcome.artifacts["sum.2"].summary["began_at"] == 1
    assert (out / "shown.txt").read_text() == str(TOTAL)


def test_no_shard_is_made_during_a_run_that_has_exclusive_access(
    numbers: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatpipe.pipeline.engine.runs.lock.PATIENCE_S", 0.2)
    request = request_of(numbers, out)
    walk(request, until="divide")
    with open_session(request, lambda event: None), pytest.raises(UsageError, match="is working in"):
        make_shard(request, 1)
    assert make_shard(request, 1).ran == ["sum.1"]


def test_a_shard_needs_its_stages_inputs_and_a_valid_number(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out), until="read")
    with pytest.raises(UsageError, match="needs the output of divide"):
        make_shard(request_of(numbers, out), 1)
    walk(request_of(numbers, out), until="divide")
    with pytest.raises(UsageError, match="has no shard 4: it has 3 here"):
        make_shard(request_of(numbers, out), 4)
    with (
        pytest.raises(UsageError, match="has no shard 1: it has none"),
        open_session(request_of(numbers, out), lambda event: None) as runner,
    ):
        runner.run_shard("divide", 1)


def test_one_stage_alone_merges_existing_shards_and_a_rerun_makes_all_again(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out), until="divide")
    make_shard(request_of(numbers, out), 2)
    with open_session(request_of(numbers, out), lambda event: None) as runner:
        assert runner.run_alone("sum").ran == ["sum.1", "sum.3", "sum"]
    with open_session(request_of(numbers, out), lambda event: None) as runner:
        assert runner.run_alone("sum").ran == ["sum"]
    assert walk(request_of(numbers, out), rerun=frozenset({"sum"}))[0].ran == [*SHARDS, "sum", "show"]


def test_a_damaged_shard_is_made_again_when_it_is_needed(numbers: Path, out: Path) -> None:
    first, _ = walk(request_of(numbers, out))
    (first.artifacts["sum.3"].folder / "sum.txt").unlink()
    assert walk(request_of(numbers, out))[0].ran == []  # the merged result is intact
    shutil.rmtree(first.artifacts["sum"].folder)
    assert walk(request_of(numbers, out))[0].ran == ["sum.3", "sum"]


def test_clean_keeps_the_shards_in_use(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out, divide={"piece": 1}))
    request = request_of(numbers, out)
    walk(request, until="divide")
    make_shard(request, 2)
    line, store = status_of(request)
    removed, _ = store.remove_stale(entry for status in line_status(line, store) for entry in status.to_keep)
    assert removed == 1 + 6 + 1 + 1  # the other division, its shards, their merged result, and what was shown of it
    assert walk(request)[0].ran == ["sum.1", "sum.3", "sum", "show"]


def test_an_option_of_the_stage_reaches_its_shards_and_one_after_it_does_not(numbers: Path, out: Path) -> None:
    walk(request_of(numbers, out))
    found = statuses(request_of(numbers, out, sum={"offset": 1}))
    assert [found[name].state for name in (*SHARDS, "sum")] == ["stale"] * 4
    assert found["sum.2"].reason == "sum.offset changed from 0 to 1"
    outcome, _ = walk(request_of(numbers, out, sum={"offset": 1}))
    assert outcome.artifacts["sum"].summary == {"total": TOTAL + len(NUMBERS)}


def test_without_shards_the_stage_does_everything_and_a_missing_count_is_an_error(
    numbers: Path, out: Path, tmp_path: Path
) -> None:
    outcome, _ = walk(request_of(numbers, out, divide={"piece": 0}))
    assert outcome.ran == ["read", "divide", "sum", "show"] and (out / "shown.txt").read_text() == str(TOTAL)
    wrong = replace(sharded.SUM, shards=replace(sharded.SUM.shards, counted_by="read.numbers"))  # type: ignore[type-var]
    request = replace(request_of(numbers, tmp_path / "wrong"), stages=(*sharded.LINE[:2], wrong, sharded.SHOW))
    with pytest.raises(StageError, match="does not say how many shards sum has"):
        walk(request)


def test_manifests_state_what_shards_took_and_their_forecast(numbers: Path, out: Path) -> None:
    def forecast_needs(_summaries: Mapping[str, Summary]) -> Mapping[str, Need]:
        return {"sum": Need(300, 9.0, 600), "sum.3": Need(100, 1.0, 10)}

    outcome, _ = walk(replace(request_of(numbers, out, sum={"step_s": 0.05}), forecast_needs=forecast_needs))
    manifests = {name: artifact.manifest for name, artifact in outcome.artifacts.items()}
    assert manifests["sum.1"]["forecast"] == Need(300, 3.0, 200).as_json()
    assert manifests["sum.3"]["forecast"] == Need(100, 1.0, 10).as_json()
    whole = manifests["sum"]
    assert [shard["key"] for shard in whole["shards"]] == [outcome.artifacts[name].key for name in SHARDS]
    shards_s = sum(shard["seconds"] for shard in whole["shards"])  # each rounded to milliseconds
    assert whole["seconds"] >= shards_s - 1e-3 * len(whole["shards"]) and shards_s > 0.2
    assert whole["peak_memory_bytes"] >= max(shard["peak_memory_bytes"] for shard in whole["shards"])
    manifest = used_and_forecast(whole)
    own = used_and_forecast({**whole, "shards": []})["used"]["disk_bytes"]
    assert manifest["used"]["disk_bytes"] == own + sum(
        used_and_forecast(manifests[name])["used"]["disk_bytes"] for name in SHARDS
    )
    assert manifest["forecast"] == {"memory_bytes": 300, "cpu_seconds": 9.0, "disk_bytes": 600}


def test_an_error_of_the_machines_or_the_inputs_stops_the_run_at_once(
    numbers: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another shard would meet the same full disk; only a failure of its own affects a shard alone."""
    monkeypatch.setenv(sharded.FAIL_VARIABLE, "1")
    with pytest.raises(StageError, match="out of order"):
        walk(request_of(numbers, out))
    assert statuses(request_of(numbers, out))["sum.3"].state == "valid"
    monkeypatch.delenv(sharded.FAIL_VARIABLE)
    shutil.rmtree(out)

    def meddle(event: Event) -> None:
        if (event.kind, event.stage) == ("stage_started", "sum.1"):
            shutil.rmtree(numbers)

    monkeypatch.setenv(sharded.FAIL_VARIABLE, "1")
    with (
        pytest.raises(SplatpipeError, match=r"photo folder .* has disappeared"),
        open_session(request_of(numbers, out), meddle) as runner,
    ):
        runner.walk()
    assert runner.outcome.ran == ["read", "divide"]


def test_shards_are_reported_before_their_stage() -> None:
    assert shards_first(["read", "sum", "show", "sum.1", "sum.2", "x.1"]) == [
        "read", "sum.1", "sum.2", "sum", "show", "x.1",
    ]  # fmt: skip


def test_a_shard_takes_no_options_of_its_own(tmp_path: Path) -> None:
    """Shards of different options would never be merged, without any notice."""
    ended = splatpipe("stage", "train", tmp_path, "--shard", "2", "--set", "train.iterations=9")
    assert ended.returncode == 2 and "same options" in ended.stderr
