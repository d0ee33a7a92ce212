"""Unattended runs on full and read-only disks, and with limits, as commands."""

import json
import os
import pkgutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from unattended_runs import events, goes_on, largest_file, request_of, walk

from splatpipe import pipeline, stages
from splatpipe.pipeline.app.notice import TIME_LIMIT_S
from splatpipe.pipeline.engine.errors import EXIT_INPUT, EXIT_MACHINE, MachineError

pytestmark = pytest.mark.usefixtures("lines")


DISK = "40m"  # beyond what every stage asks to be free, and less than the stage that fills it writes


@pytest.fixture
def numbers(tmp_path: Path) -> Path:
    folder = tmp_path / "numbers"
    folder.mkdir()
    (folder / "a.txt").write_text("1")
    (folder / "b.txt").write_text("20")
    return folder


@contextmanager
def mounted(folder: Path, *options: str) -> Iterator[bool]:
    """A small disk in a folder, where this user may mount one."""
    folder.mkdir(exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", ",".join((f"size={DISK}", *options)), "tmpfs", str(folder)]
    able = os.geteuid() == 0 and subprocess.run(command, capture_output=True, check=False).returncode == 0
    try:
        yield able
    finally:
        if able:
            subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_disk_that_runs_full_is_reported_and_the_run_resumes_once_there_is_space(
    numbers: Path, tmp_path: Path
) -> None:
    disk = tmp_path / "disk"
    with mounted(disk) as able:
        limit = (64 if able else 8) << 20
        with largest_file(limit), pytest.raises(MachineError, match=r"full|No space left|File too large") as caught:
            walk(request_of(numbers, disk / "out", fail="fill"))
        assert "run again" in caught.value.hint
        assert [event.data["exit_code"] for event in events(disk / "out")[-2:]] == [EXIT_MACHINE] * 2
        if able:
            with pytest.raises(MachineError, match=r"Cannot write to .*No space left"):
                walk(request_of(numbers, disk / "out"))
            subprocess.run(["mount", "-o", "remount,size=120m", str(disk)], check=True)
        goes_on(numbers, disk / "out", ["count", "tell"])


def test_a_read_only_disk_is_reported(numbers: Path, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    with mounted(disk) as able:
        out = disk / "out"
        walk(request_of(numbers, out))
        if able:
            subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        else:
            for folder in (out, out / "stages", out / "stages" / ".partial"):
                folder.chmod(0o500)
        with pytest.raises(MachineError, match=r"Cannot write to .*(Read-only|Permission denied)"):
            walk(request_of(numbers, out, steps=4))
        if able:
            subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)
        for folder in (out, out / "stages", out / "stages" / ".partial"):
            folder.chmod(0o700)
        goes_on(numbers, out, [])


def splatpipe(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd)


def test_a_notice_reports_a_failure_and_leaves_only_json_on_stdout(tmp_path: Path) -> None:
    command = 'echo "$SPLATPIPE_STATE,$SPLATPIPE_CAPTURE" > notice; echo said; exit 3 # token=hunter2'
    done = splatpipe("run", "no photos", "the; touch out", "--notify", command, "--json", cwd=tmp_path)
    assert done.returncode == EXIT_INPUT and json.loads(done.stdout)["exit_code"] == EXIT_INPUT
    assert (tmp_path / "notice").read_text() == "failed,the; touch out\n"
    assert "said" in done.stderr and "exit code 3" in done.stderr and "hunter2" not in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notice"]


def test_a_stopped_run_does_not_wait_for_a_notice_that_hangs(tmp_path: Path) -> None:
    """Docker kills ten seconds after SIGTERM: the notice ends before, though it would sleep for longer than allowed."""
    (tmp_path / "out" / "stages").mkdir(parents=True)
    (tmp_path / "photos").mkdir()
    holds = "import sys; from pathlib import Path; from splatpipe.pipeline.engine.runs.lock import locked\n"
    holds += "with locked(Path('out')): print('held', flush=True); sys.stdin.readline()"
    waits = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "run", "photos", "out", "--wait", "--notify"]
    with (
        subprocess.Popen([sys.executable, "-c", holds], stdin=-1, stdout=-1, text=True, cwd=tmp_path) as holder,
        subprocess.Popen(
            [*waits, f"echo $SPLATPIPE_STATE > notice; sleep {10 * TIME_LIMIT_S}"],
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
        ) as waiting,
    ):
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        assert waiting.stderr is not None
        while "waiting for it to finish" not in waiting.stderr.readline():
            assert waiting.poll() is None
        waiting.send_signal(signal.SIGTERM)
        said = waiting.communicate(timeout=5 * TIME_LIMIT_S)[1]
        assert waiting.returncode == 143 and "did not end within" in said
        assert (tmp_path / "notice").read_text() == "stopped\n"
        holder.kill()


def test_home_is_not_needed(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "HOME"}
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "run", "~nobody-of-that-name/x", "out"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    assert done.returncode == 2 and "no home folder" in done.stderr


def test_no_module_needs_a_home_or_a_known_user(tmp_path: Path) -> None:
    """As for an arbitrary user in a container; libraries search for their caches and settings when imported."""
    names = [
        module.name
        for package in (stages, pipeline)
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        if not module.name.endswith(("__main__", "libsplat_cuda"))  # that library is loaded by ctypes
    ]
    assert len(names) > 300
    text = (
        "import importlib, os, pwd, tempfile\n"
        "def unknown(uid): raise KeyError(uid)\n"
        "pwd.getpwuid = unknown\n"
        f"for name in {names}: importlib.import_module(name)\n"
        "assert not os.listdir(tempfile.gettempdir()), os.listdir(tempfile.gettempdir())\n"
    )
    caches = ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME")
    environment = {name: value for name, value in os.environ.items() if name not in caches}
    (tmp_path / "temporary").mkdir()
    environment |= {"TMPDIR": str(tmp_path / "temporary"), "MPLCONFIGDIR": str(tmp_path / "matplotlib")}
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
