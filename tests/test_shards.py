"""Sharded stages: any process makes any shard in any order, a kill costs only its shard, the bits are the same."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from splatpipe.pipeline.app.report.run_history import read_history
from splatpipe.pipeline.app.view.log import RunLog
from splatpipe.pipeline.engine.config import resolve
from splatpipe.pipeline.engine.errors import SplatpipeError, StageError, UsageError
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.line import StageStatus, line_status
from splatpipe.pipeline.engine.lock import is_locked
from splatpipe.pipeline.engine.needs import Need, used_and_forecast
from splatpipe.pipeline.engine.run_folder import shard_events
from splatpipe.pipeline.engine.runner import Outcome
from splatpipe.pipeline.engine.session import Request, open_session, status_of
from splatpipe.pipeline.engine.stage import Machine, Summary, shards_first

LINES = Path(__file__).parent / "lines"
sys.path.insert(0, str(LINES))
import sharded  # noqa: E402

pytestmark = pytest.mark.usefixtures("lines")

NUMBERS = (3, 14, 15, 92, 65, 35)
TOTAL = sum(number**2 for number in NUMBERS)
SHARDS = ("sum.1", "sum.2", "sum.3")
ALONE = """
import json, sys
from pathlib import Path
import sharded
from splatpipe.pipeline.engine.config import resolve
from splatpipe.pipeline.engine.session import Request, open_session
from splatpipe.pipeline.engine.stage import Machine
numbers, out, shard, options = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], json.loads(sys.argv[4])
request = Request(sharded.LINE, resolve(sharded.LineConfig, [options]), numbers, out, Machine("cpu", 1))
def show(event):
    if (event.kind, event.stage[:4], event.data.get("done")) == ("progress", "sum.", 1):
        print("adding", flush=True)
with open_session(request, show, shard=shard, wait="--wait" in sys.argv) as runner:
    runner.run_shard("sum", int(shard.split(".")[1])) if shard else runner.walk()
"""


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


def request_of(numbers: Path, out: Path, **sections: dict[str, object]) -> Request:
    return Request(sharded.LINE, resolve(sharded.LineConfig, [sections]), numbers, out, Machine("cpu", 1))


def walk(request: Request, **how: object) -> tuple[Outcome, list[Event]]:
    events: list[Event] = []
    with open_session(request, events.append) as runner:
        return runner.walk(**how), events  # type: ignore[arg-type]


def make_shard(request: Request, number: int) -> Outcome:
    with open_session(request, lambda event: None, shard=f"sum.{number}") as runner:
        return runner.run_shard("sum", number)


def alone(numbers: Path, out: Path, shard: str, *more: str, **options: object) -> subprocess.Popen[str]:
    """A process that makes a shard, or with an empty name runs the pipeline."""
    words = [sys.executable, "-c", ALONE, str(numbers), str(out), shard, json.dumps(options), *more]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


def statuses(request: Request) -> dict[str, StageStatus]:
    found = {status.stage.name: status for status in line_status(*status_of(request))}
    return found | {shard.stage.name: shard for status in found.values() for shard in status.shards}


def digests(out: Path) -> dict[str, object]:
    """Digests of every part of every artifact, by its folder, whose name has the key."""
    manifests = {path.parent.name: json.loads(path.read_text()) for path in out.glob("stages/*-*/manifest.json")}
    return {
        name: {part: entry["digest"] for part, entry in manifest["parts"].items()}
        for name, manifest in manifests.items()
    }


def test_a_run_makes_the_shards_and_merges_them_and_a_second_one_reuses_them(numbers: Path, out: Path) -> None:
    first, events = walk(request_of(numbers, out))
    assert first.ran == ["read", "divide", *SHARDS, "sum", "show"]
    assert (out / "shown.txt").read_text() == str(TOTAL)
    started = {event.stage: event.data["reason"] for event in events if event.kind == "stage_started"}
    assert started["sum.2"] == "shard 2 of 3: not run yet"
    second, events = walk(request_of(numbers, out))
    assert second.ran == [] and [event.stage for event in events if event.stage] == ["read", "divide", "sum", "show"]


def test_shards_of_many_processes_each_killed_once_have_the_bits_of_a_single_run(numbers: Path, tmp_path: Path) -> None:
    """Each is killed with -9 between its two numbers, restarted in another order, all three at once; then merged."""
    one, many = tmp_path / "one", tmp_path / "many"
    slow = {"sum": {"step_s": 0.4}}
    walk(request_of(numbers, one, **slow))
    walk(request_of(numbers, many, **slow), until="divide")
    before = {path: path.read_bytes() for path in many.iterdir() if path.is_file()}
    for again in (False, True):
        running = [alone(numbers, many, name, **slow) for name in reversed(SHARDS)]
        for process in running:
            assert process.stdout is not None and process.stdout.readline() == "adding\n"
            if not again:
                os.killpg(process.pid, signal.SIGKILL)
            _, said = process.communicate()
            assert process.returncode == (0 if again else -signal.SIGKILL), said
    assert {path: path.read_bytes() for path in many.iterdir() if path.is_file()} == before  # nothing but their own
    found = statuses(request_of(numbers, many, **slow))
    assert [found[name].state for name in (*SHARDS, "sum")] == ["valid"] * 3 + ["missing"]
    assert all(found[name].artifact.summary["began_at"] == 1 for name in SHARDS)  # type: ignore[union-attr]
    outcome, _ = walk(request_of(numbers, many, **slow))
    assert outcome.ran == ["sum", "show"]
    assert digests(many) == digests(one) and len(digests(one)) == 7
    assert (many / "shown.txt").read_bytes() == (one / "shown.txt").read_bytes()


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


def test_a_run_killed_in_a_shard_keeps_those_before_it(numbers: Path, out: Path) -> None:
    slow = {"sum": {"step_s": 0.4}}
    with alone(numbers, out, "", **slow) as process:
        assert process.stdout is not None
        assert [process.stdout.readline() for _ in range(2)] == ["adding\n"] * 2
        os.killpg(process.pid, signal.SIGKILL)
    outcome, _ = walk(request_of(numbers, out, **slow))
    assert outcome.ran == ["sum.2", "sum.3", "sum", "show"]
    assert outcome.artifacts["sum.2"].summary["began_at"] == 1


def test_two_processes_may_write_two_artifacts_but_not_the_same_one(
    numbers: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatpipe.pipeline.engine.lock.PATIENCE_S", 0.2)
    slow = {"sum": {"step_s": 1.0}}
    walk(request_of(numbers, out, **slow), until="divide")
    with alone(numbers, out, "sum.2", **slow) as process:
        assert process.stdout is not None
        process.stdout.readline()
        request = request_of(numbers, out, **slow)
        with pytest.raises(UsageError, match=f"process {process.pid}\\) is running sum.2 in"):
            make_shard(request, 2)
        with pytest.raises(UsageError, match=f"process {process.pid}\\) is working in"):
            walk(request)
        assert is_locked(out, "sum.2") and not is_locked(out, "sum.1") and not is_locked(out)
        assert statuses(request)["sum.2"].reason == "is running"
        assert make_shard(request, 1).ran == ["sum.1"]
        with alone(numbers, out, "sum.2", "--wait", **slow) as waiting:
            _, said = waiting.communicate()
            assert waiting.returncode == 0 and process.wait() == 0, said
    kinds = [json.loads(line)["kind"] for line in shard_events(out, "sum.2").read_text().splitlines()]
    assert kinds.count("stage_started") == kinds.count("stage_finished") == kinds.count("stage_reused") == 1


def test_no_shard_is_made_during_a_run_that_has_exclusive_access(
    numbers: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatpipe.pipeline.engine.lock.PATIENCE_S", 0.2)
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
    assert whole["seconds"] >= sum(shard["seconds"] for shard in whole["shards"]) > 0.2
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
    words = ["stage", "train", str(tmp_path), "--shard", "2", "--set", "train.iterations=9"]
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli", *words]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2 and "same options" in ended.stderr
