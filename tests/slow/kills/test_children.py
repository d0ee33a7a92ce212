"""A stage's child processes: none survives, whatever ends the stage."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from timeouts import wait_until

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.runs.children import run_children

CODE = "timeit"  # runs its arguments as statements; the first of them is our process number, which does no harm


SLEEP = (
    CODE,
    "import time, splatpipe.pipeline.engine.runs.children as c; c.die_with_parent({parent}); time.sleep(300)",
)


def sleeping() -> tuple[str, ...]:
    return (SLEEP[0], SLEEP[1].format(parent=os.getpid()))


def children_of(pid: int) -> list[int]:
    """Those that run our code; the tests' browser is a child, too."""
    listed = subprocess.run(["ps", "-o", "pid=,args=", "--ppid", str(pid)], capture_output=True, text=True, check=False)
    return [int(line.split()[0]) for line in listed.stdout.splitlines() if f"-m {CODE}" in line]


def is_alive(pid: int) -> bool:
    listing = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False).stdout
    return bool(listing.strip()) and not listing.strip().startswith("Z")


def test_one_that_dies_ends_the_others_and_is_reported() -> None:
    with pytest.raises(StageError, match=r"that was idling ended by signal 9\.") as caught:
        run_children([sleeping(), (CODE, "import os; os.kill(os.getpid(), 9)")], lambda: None, "idling")
    assert "--threads 1" in caught.value.hint
    assert not children_of(os.getpid())


def test_an_interruption_ends_them_at_once() -> None:
    seen: list[int] = []

    def observe() -> None:
        seen[:] = children_of(os.getpid())
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_children([sleeping(), sleeping()], observe, "idling")
    assert seen and not any(map(is_alive, seen))


@pytest.mark.parametrize("platform", [sys.platform, "darwin"])
def test_they_die_with_the_process_that_started_them(tmp_path: Path, platform: str) -> None:
    asked = tmp_path / "asked"
    statement = SLEEP[1].format(parent="os.getppid()").replace("time.sleep", f"open({str(asked)!r}, 'w'); time.sleep")
    statement = statement.replace("c.die", f"import os; c.sys.platform = '{platform}'; c.die")
    script = (
        "from splatpipe.pipeline.engine.runs.children import run_children\n"
        f"run_children([('{CODE}', {statement!r})], lambda: None, '')"
    )
    parent = subprocess.Popen([sys.executable, "-c", script])
    wait_until(asked.exists, "its asking the kernel")
    born = children_of(parent.pid)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    assert born
    wait_until(lambda: not any(map(is_alive, born)), "their end")
