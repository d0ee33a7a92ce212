"""A GPU session continues after failures: a part that fails, hangs or is late is reported with its results so far."""

import os
import time
from pathlib import Path

import gpu_parts
import pytest
from gpu_parts import GpuPart, PartOutcome

PIECES = """
import os, subprocess, sys, time

def well(count):
    for number in range(count):
        yield {"number": number}

def badly():
    yield {"number": 0}
    raise SystemExit("it broke")

def never(pid_file):
    yield {"number": 0}
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    open(pid_file, "w").write(str(child.pid))
    time.sleep(600)
"""


def run(tmp_path: Path, parts: list[GpuPart], seconds: float) -> list[PartOutcome]:
    (tmp_path / "pieces.py").write_text(PIECES)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    return list(gpu_parts.run_parts(parts, tmp_path / "rows", environment, time.monotonic() + seconds))[-1]


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_part_that_fails_or_hangs_keeps_its_rows_and_the_others_run(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    parts = [
        GpuPart("beside", "pieces:well", {"count": 1}, beside=True),
        GpuPart("bad", "pieces:badly"),
        GpuPart("hangs", "pieces:never", {"pid_file": str(pid_file)}, limit_s=3.0),
        GpuPart("good", "pieces:well", {"count": 3}),
    ]
    outcomes = run(tmp_path, parts, 60.0)
    assert [(each.name, each.state, len(each.rows)) for each in outcomes] == [
        ("bad", "failed", 1),
        ("hangs", "late", 1),
        ("good", "done", 3),
        ("beside", "done", 1),
    ]
    assert outcomes[0].error.strip() == "it broke"
    assert not is_running(int(pid_file.read_text()))


def test_parts_without_enough_time_are_not_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_parts, "MIN_S", 1000.0)
    (outcome,) = run(tmp_path, [GpuPart("good", "pieces:well", {"count": 1})], 60.0)
    assert (outcome.state, outcome.rows) == ("not begun", [])
