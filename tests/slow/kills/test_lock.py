"""One splatpipe at a time in an OUT, when holders are killed or wait."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.runs import lock as engine_lock
from splatpipe.pipeline.engine.runs.lock import LOCK_FILE, is_locked, locked

ELSEWHERE = {"process": 4711, "host": "node7", "boot": "another", "turn": "first"}


TIMEOUT_S = 60.0


HOLDS = """
import sys
from pathlib import Path
from splatpipe.pipeline.engine.runs.lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An OUT's folder; silence expires a signature soon."""
    monkeypatch.setattr(engine_lock, "PATIENCE_S", 0.2)
    monkeypatch.setattr(engine_lock, "SILENCE_S", 1.5)
    monkeypatch.setattr(engine_lock, "HEARTBEAT_S", 0.1)
    monkeypatch.setattr(engine_lock, "POLL_S", 0.02)
    (tmp_path / "stages").mkdir()
    return tmp_path


@contextmanager
def holder(out: Path) -> Iterator[subprocess.Popen[str]]:
    """Run another process that holds the lock until it is released or killed."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(out)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_a_second_holder_is_refused_and_a_killed_one_does_not_block(out: Path) -> None:
    with holder(out) as process:
        assert is_locked(out)
        with pytest.raises(UsageError, match=f"process {process.pid}\\) is working") as refused, locked(out):
            pass
        assert "--wait" in refused.value.hint
        process.kill()
        process.wait()
        assert (out / "stages" / LOCK_FILE).read_text()  # still signed
        messages: list[str] = []
        with locked(out, notify=messages.append):
            assert messages == []  # the kernel knows that it is dead: nothing to look for


def test_a_waiting_process_names_the_holder_and_continues_when_it_ends(out: Path) -> None:
    messages: list[str] = []

    def notify(text: str) -> None:
        messages.append(text)
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()

    with holder(out) as process, locked(out, wait=True, notify=notify):
        assert process.wait(TIMEOUT_S) == 0
    assert len(messages) == 1 and f"process {process.pid}" in messages[0]


def test_the_message_says_how_to_break_a_dead_machines_lock_kept_by_a_server(out: Path) -> None:
    """NFS 3 holds it until that machine is back."""
    path = out / "stages" / LOCK_FILE
    with holder(out) as process:
        path.write_text(json.dumps(ELSEWHERE))
        with pytest.raises(UsageError, match="node7") as refused, locked(out):
            pass
        assert str(path) in refused.value.hint
        path.unlink()
        with locked(out) as hold:  # as the hint advises; a holder that is still alive notices it and ends
            hold.confirm()
        assert process.poll() is None
