"""Unattended runs: full, read-only and vanished disks end in clear errors, lose nothing, and the run resumes."""

import sys
import tempfile
from pathlib import Path

import pytest
from unattended_runs import LINE, events, goes_on, largest_file, request_of, walk

from splatpipe.pipeline.app.terminal.console import RunConsole, print_line, show_error
from splatpipe.pipeline.app.terminal.summary import for_the_user
from splatpipe.pipeline.engine.errors import EXIT_INPUT, EXIT_MACHINE, MachineError, SplatpipeError
from splatpipe.pipeline.engine.events import Event, EventLog, parse_event

pytestmark = pytest.mark.usefixtures("lines")


HOSTILE = 'a\nb\r\u2028\x1b[31mred\x85\udcff\0"},{'


@pytest.fixture
def numbers(tmp_path: Path) -> Path:
    folder = tmp_path / "numbers"
    folder.mkdir()
    (folder / "a.txt").write_text("1")
    (folder / "b.txt").write_text("20")
    return folder


def test_a_disk_that_is_full_from_the_start_is_reported(numbers: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    walk(request_of(numbers, out))
    before = (out / "events.jsonl").read_bytes()
    with largest_file(0), pytest.raises(MachineError, match=r"Cannot write|Cannot lock"):
        walk(request_of(numbers, out, steps=4))
    assert (out / "events.jsonl").read_bytes() == before
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
    output = capfd.readouterr().err
    assert not {"\x1b", "\x07", "\x9b"} & set(output) and output.count("[bold]") >= 5


def test_time_left_is_that_of_the_step_and_unknown_until_it_advances(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A resumed training begins in the middle; counts start again in each step, and in a step that is repeated."""
    console, clock_s = RunConsole(), iter(range(1000, 2000, 20))
    monkeypatch.setattr("splatpipe.pipeline.app.terminal.console.time.monotonic", lambda: float(next(clock_s)))
    for what, done in (("a", 80), ("a", 90), ("b", 0), ("b", 50), ("b", 0), ("b", 20), ("b", 100)):
        console(Event("progress", "sparse", {"done": done, "total": 100, "what": what, "unit": "photos"}))
    lines = [line.partition("photos")[2] for line in capfd.readouterr().err.splitlines()]
    assert lines == ["", ", about 20.0 s left", "", ", about 20.0 s left", "", ", about 1 min 20 s left", ""]


@pytest.mark.parametrize(("stages", "mentions_rest"), [(["blocks", "train"], True), (["train.2"], False)])
def test_time_left_is_that_of_all_shards_unless_one_is_made_alone(
    stages: list[str], mentions_rest: bool, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splatpipe.pipeline.app.terminal.console.PLAIN_INTERVAL_S", -1.0)
    console = RunConsole()
    console(Event("run_started", data={"stages": stages}))
    console(Event("stage_started", "train.2", {"reason": "", "shard": {"number": 2, "count": 4}}))
    console(Event("progress", "train.2", {"done": 5.0, "total": 10.0, "what": "training", "unit": "iterations"}))
    console.close()
    output = " ".join(capfd.readouterr().err.split())
    assert "5/10 iterations" in output and ("including the 2 remaining" in output) == mentions_rest


def test_an_internal_error_is_reported_even_without_a_temporary_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a read-only root without /dev/shm."""
    monkeypatch.setattr(tempfile, "tempdir", "/nowhere")
    assert "ValueError: odd" in for_the_user(ValueError("odd")).message
