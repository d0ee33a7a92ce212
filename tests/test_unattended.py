"""Unattended runs: full, read-only and vanished disks end in clear errors, lose nothing, and the run resumes."""

import json
import os
import pkgutil
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from splatpipe import pipeline, stages
from splatpipe.pipeline.app.command_summary import for_the_user
from splatpipe.pipeline.app.console import RunConsole, print_line, show_error
from splatpipe.pipeline.app.notice import TIME_LIMIT_S
from splatpipe.pipeline.engine.config import resolve
from splatpipe.pipeline.engine.errors import EXIT_INPUT, EXIT_MACHINE, MachineError, SplatpipeError
from splatpipe.pipeline.engine.events import Event, EventLog, parse_event
from splatpipe.pipeline.engine.runner import Outcome
from splatpipe.pipeline.engine.session import Request, open_session
from splatpipe.pipeline.engine.stage import Machine

LINES = Path(__file__).parent / "lines"
sys.path.insert(0, str(LINES))
import arithmetic  # noqa: E402

pytestmark = pytest.mark.usefixtures("lines")

DISK = "40m"  # beyond what every stage asks to be free, and less than the stage that fills it writes
LINE = ["read", "add", "count", "tell"]
HOSTILE = 'a\nb\r\u2028\x1b[31mred\x85\udcff\0"},{'


@pytest.fixture
def numbers(tmp_path: Path) -> Path:
    folder = tmp_path / "numbers"
    folder.mkdir()
    (folder / "a.txt").write_text("1")
    (folder / "b.txt").write_text("20")
    return folder


def request_of(numbers: Path, out: Path, **count: object) -> Request:
    return Request(arithmetic.LINE, resolve(arithmetic.LineConfig, [{"count": count}]), numbers, out, Machine("cpu", 1))


def walk(request: Request, show: Callable[[Event], object] = lambda event: None) -> Outcome:
    with open_session(request, show) as runner:
        return runner.walk()


def events(out: Path) -> list[Event]:
    """Return the logged events; every line is one."""
    found = [parse_event(line) for line in (out / "events.jsonl").read_bytes().split(b"\n")[:-1]]
    assert None not in found
    return [event for event in found if event is not None]


def goes_on(numbers: Path, out: Path, ran: list[str]) -> None:
    """The next run does what is missing, and no more."""
    assert walk(request_of(numbers, out)).ran == ran
    assert (out / "telling.txt").read_text() == "3 1 False 21"
    assert events(out)[-1].data["exit_code"] == 0


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


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """A file size limit enforced by the kernel, also for workers: another way of having no space."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


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


def test_a_disk_that_is_full_from_the_start_is_reported(numbers: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    walk(request_of(numbers, out))
    before = (out / "events.jsonl").read_bytes()
    with largest_file(0), pytest.raises(MachineError, match=r"Cannot write|Cannot lock"):
        walk(request_of(numbers, out, steps=4))
    assert (out / "events.jsonl").read_bytes() == before
    goes_on(numbers, out, [])


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


@pytest.mark.parametrize(
    ("which", "error", "code", "ran"),
    [("out", MachineError, EXIT_MACHINE, ["add", "count", "tell"]), ("numbers", SplatpipeError, EXIT_INPUT, LINE)],
)
def test_a_folder_that_vanishes_is_reported_and_not_replaced(
    numbers: Path, tmp_path: Path, which: str, error: type[SplatpipeError], code: int, ran: list[str]
) -> None:
    out, stage = tmp_path / "out", "add" if which == "out" else "read"

    def vanish(event: Event) -> None:
        if (event.kind, event.stage) == ("stage_started", stage):
            (tmp_path / which).rename(tmp_path / "elsewhere")

    with pytest.raises(error, match=f"{which} has disappeared") as caught:
        walk(request_of(numbers, out), vanish)
    assert caught.value.exit_code == code and caught.value.hint
    assert not (tmp_path / which).exists()
    (tmp_path / "elsewhere").rename(tmp_path / which)
    goes_on(numbers, out, ran)


def test_missing_photos_are_reported_and_earlier_results_are_kept(numbers: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    walk(request_of(numbers, out))
    numbers.rename(tmp_path / "elsewhere")
    with pytest.raises(SplatpipeError, match="There is no folder"):
        walk(request_of(numbers, out))
    (tmp_path / "elsewhere").rename(numbers)
    goes_on(numbers, out, [])


def test_a_limit_on_processes_is_reported(numbers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(sys, "executable", str(numbers))  # a folder: the kernel starts none
        with pytest.raises(MachineError, match="No worker process could be started"):
            walk(request_of(numbers, out))
    goes_on(numbers, out, LINE)


def test_every_event_is_one_line_of_json_without_colours(tmp_path: Path) -> None:
    log = EventLog(tmp_path / "events.jsonl")
    log(Event("note", HOSTILE, {"message": HOSTILE, HOSTILE: [HOSTILE]}))
    log(Event("metric", "train", {"name": "loss", "value": float("nan"), "step": float("-inf")}))
    log.close()
    text = (tmp_path / "events.jsonl").read_bytes()
    assert text.isascii() and b"\x1b" not in text and b"NaN" not in text and b"Infinity" not in text
    first, second = events(tmp_path)
    assert first.data["message"] == HOSTILE and second.data == {"name": "loss", "value": None, "step": None}


def test_a_line_truncated_by_a_power_cut_affects_no_other(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    path.write_bytes(b'{"kind": "note", "sta')
    log = EventLog(path)
    log(Event("note", "train", {"message": "after"}))
    log.close()
    torn, whole = path.read_bytes().splitlines()
    assert parse_event(torn) is None and (parsed := parse_event(whole)) and parsed.data["message"] == "after"


def test_a_full_disk_leaves_complete_lines_in_the_log(tmp_path: Path) -> None:
    log = EventLog(tmp_path / "events.jsonl")
    log(Event("note", "train", {"message": "before"}))
    with largest_file(200), pytest.raises(OSError, match=r"No space|too large"):
        log(Event("note", "train", {"message": "x" * 500}))
    log(Event("note", "train", {"message": "after"}))
    log.close()
    assert [event.data["message"] for event in events(tmp_path)] == ["before", "after"]


def test_the_log_has_no_colours_whatever_the_terminal(
    numbers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.delenv("NO_COLOR", raising=False)
    walk(request_of(numbers, tmp_path / "out", fail="colours"))
    log = (tmp_path / "out" / "splatpipe.log").read_text()
    assert "no terminal here" in log and "\x1b" not in log


def test_no_name_sends_colours_or_commands_to_the_terminal(capfd: pytest.CaptureFixture[str]) -> None:
    hostile = "\x1b[31mred\x1b]0;title\x07\x9b2J[bold]\ttab"
    print_line(hostile)
    show_error(MachineError(hostile, hostile))
    console = RunConsole()
    console(Event("warning", "train", {"message": hostile, "hint": hostile}))
    console(Event("stage_failed", "train", {"message": hostile}))
    console.close()
    shown = capfd.readouterr().err
    assert not {"\x1b", "\x07", "\x9b"} & set(shown) and shown.count("[bold]") >= 5


def test_time_left_is_that_of_the_step_and_unknown_until_it_advances(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A resumed training begins in the middle; counts start again in each step, and in a step that is repeated."""
    console, clock_s = RunConsole(), iter(range(1000, 2000, 20))
    monkeypatch.setattr("splatpipe.pipeline.app.console.time.monotonic", lambda: float(next(clock_s)))
    for what, done in (("a", 80), ("a", 90), ("b", 0), ("b", 50), ("b", 0), ("b", 20), ("b", 100)):
        console(Event("progress", "sparse", {"done": done, "total": 100, "what": what, "unit": "photos"}))
    lines = [line.partition("photos")[2] for line in capfd.readouterr().err.splitlines()]
    assert lines == ["", ", about 20.0 s left", "", ", about 20.0 s left", "", ", about 1 min 20 s left", ""]


@pytest.mark.parametrize(("stages", "mentions_rest"), [(["blocks", "train"], True), (["train.2"], False)])
def test_time_left_is_that_of_all_shards_unless_one_is_made_alone(
    stages: list[str], mentions_rest: bool, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatpipe.pipeline.app.console.PLAIN_INTERVAL_S", -1.0)
    console = RunConsole()
    console(Event("run_started", data={"stages": stages}))
    console(Event("stage_started", "train.2", {"reason": "", "shard": {"number": 2, "count": 4}}))
    console(Event("progress", "train.2", {"done": 5.0, "total": 10.0, "what": "training", "unit": "iterations"}))
    console.close()
    shown = " ".join(capfd.readouterr().err.split())
    assert "5/10 iterations" in shown and ("including the 2 remaining" in shown) == mentions_rest


def splatpipe(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli", *map(str, arguments)]
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
    holds = "import sys; from pathlib import Path; from splatpipe.pipeline.engine.lock import locked\n"
    holds += "with locked(Path('out')): print('held', flush=True); sys.stdin.readline()"
    waits = [sys.executable, "-m", "splatpipe.pipeline.app.cli", "run", "photos", "out", "--wait", "--notify"]
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


def test_an_internal_error_is_reported_even_without_a_temporary_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a read-only root without /dev/shm."""
    monkeypatch.setattr(tempfile, "tempdir", "/nowhere")
    assert "ValueError: odd" in for_the_user(ValueError("odd")).message


def test_home_is_not_needed(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "HOME"}
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli", "run", "~nobody-of-that-name/x", "out"]
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
