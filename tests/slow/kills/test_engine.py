"""The engine on a small real pipeline: stages that ignore signals, processes that compete."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
from engine_runs import request_of, run_in_background, walk

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.runs.worker import Task
from splatpipe.pipeline.engine.stage import Machine

pytestmark = pytest.mark.usefixtures("lines")


@pytest.fixture
def numbers(tmp_path: Path) -> Path:
    folder = tmp_path / "numbers"
    folder.mkdir()
    for name, value in (("a", 1), ("b", 20), ("c", 300)):
        (folder / f"{name}.txt").write_text(str(value))
    return folder


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def test_interrupt_ends_a_stage_that_ignores_signals(numbers: Path, out: Path) -> None:
    with run_in_background(numbers, out, steps=3, step_s=0.2, fail="deaf") as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) != 0
    assert walk(request_of(numbers, out))[0].ran == ["count", "tell"]


def test_a_worker_that_is_asked_to_end_is_not_waited_for(numbers: Path, tmp_path: Path) -> None:
    """Its stdin stays open: it ends because it was asked to, not because of a timeout."""
    machine, config = asdict(Machine("cpu", 1)), {"steps": 3000, "step_s": 0.1}
    fields = {"parts": {}, "photos_dir": str(numbers), "out": str(tmp_path), "settings": {}, "summaries": {}}
    task = Task("count", "arithmetic:count", "arithmetic:CountConfig", config, machine=machine, **fields)
    command = [sys.executable, "-m", "splatpipe.pipeline.engine.runs.worker", str(os.getpid())]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as worker:
        assert worker.stdin is not None and worker.stdout is not None
        worker.stdin.write(json.dumps({"task": asdict(task)}) + "\n")
        worker.stdin.flush()
        assert "progress" in worker.stdout.readline()
        worker.terminate()
        assert worker.wait(timeout=60) == 143
        assert json.loads(worker.stdout.readlines()[-1]) == {"failed": {"type": "KeyboardInterrupt"}}


def test_a_second_process_is_refused_and_the_message_names_the_first(
    numbers: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatpipe.pipeline.engine.runs.lock.PATIENCE_S", 0.2)
    with run_in_background(numbers, out, steps=600, step_s=0.1) as process:
        assert process.stdout is not None
        process.stdout.readline()
        with pytest.raises(UsageError, match=f"process {process.pid}"):
            walk(request_of(numbers, out))
        process.kill()
