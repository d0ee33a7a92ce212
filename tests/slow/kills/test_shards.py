"""Sharded stages made by many processes, each killed once."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import sharded
from sharded_runs import NUMBERS, SHARDS, make_shard, request_of, statuses, walk

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.runs.lock import is_locked
from splatpipe.pipeline.engine.runs.run_folder import shard_events

pytestmark = pytest.mark.usefixtures("lines")


ALONE = """
import json, sys
from pathlib import Path
import sharded
from splatpipe.pipeline.engine.config import resolve
from splatpipe.pipeline.engine.runs.session import Request, open_session
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


@pytest.fixture
def hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder: a file of a shard's number in it holds the shard before its second number, however slow the machine."""
    folder = tmp_path / "hold"
    folder.mkdir()
    monkeypatch.setenv(sharded.HOLD_VARIABLE, str(folder))
    return folder


def alone(numbers: Path, out: Path, shard: str, *more: str, **options: object) -> subprocess.Popen[str]:
    """A process that makes a shard, or with an empty name runs the pipeline."""
    words = [sys.executable, "-c", ALONE, str(numbers), str(out), shard, json.dumps(options), *more]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


def digests(out: Path) -> dict[str, object]:
    """Digests of every part of every artifact, by its folder, whose name has the key."""
    manifests = {path.parent.name: json.loads(path.read_text()) for path in out.glob("stages/*-*/manifest.json")}
    return {
        name: {part: entry["digest"] for part, entry in manifest["parts"].items()}
        for name, manifest in manifests.items()
    }


def test_shards_of_many_processes_each_killed_once_have_the_bits_of_a_single_run(
    numbers: Path, tmp_path: Path, hold: Path
) -> None:
    """Each is killed with -9 between its two numbers, restarted in another order, all three at once; then merged."""
    one, many = tmp_path / "one", tmp_path / "many"
    slow = {"sum": {"step_s": 0.4}}
    walk(request_of(numbers, one, **slow))
    walk(request_of(numbers, many, **slow), until="divide")
    before = {path: path.read_bytes() for path in many.iterdir() if path.is_file()}
    for again in (False, True):
        for number in range(1, 4):
            held = hold / str(number)
            held.unlink() if again else held.touch()
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


def test_a_run_killed_in_a_shard_keeps_those_before_it(numbers: Path, out: Path, hold: Path) -> None:
    (hold / "2").touch()
    slow = {"sum": {"step_s": 0.4}}
    with alone(numbers, out, "", **slow) as process:
        assert process.stdout is not None
        assert [process.stdout.readline() for _ in range(2)] == ["adding\n"] * 2
        os.killpg(process.pid, signal.SIGKILL)
    (hold / "2").unlink()
    outcome, _ = walk(request_of(numbers, out, **slow))
    assert outcome.ran == ["sum.2", "sum.3", "sum", "show"]
    assert outcome.artifacts["sum.2"].summary["began_at"] == 1


def test_two_processes_may_write_two_artifacts_but_not_the_same_one(
    numbers: Path, out: Path, hold: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatpipe.pipeline.engine.runs.lock.PATIENCE_S", 0.2)
    slow = {"sum": {"step_s": 0.4}}
    walk(request_of(numbers, out, **slow), until="divide")
    (hold / "2").touch()
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
            (hold / "2").unlink()
            _, said = waiting.communicate()
            assert waiting.returncode == 0 and process.wait() == 0, said
    kinds = [json.loads(line)["kind"] for line in shard_events(out, "sum.2").read_text().splitlines()]
    assert kinds.count("stage_started") == kinds.count("stage_finished") == kinds.count("stage_reused") == 1
