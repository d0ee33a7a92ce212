"""What starts next, what becomes of a run that ended, and how far one is."""

import json
import signal
from pathlib import Path

import pytest

from splatpipe.pipeline.app.node.tasks.endings import CRASH_TRIES, MACHINE_TRIES, judge_run
from splatpipe.pipeline.app.node.tasks.log import last_line, log_lines
from splatpipe.pipeline.app.node.tasks.progress import RunProgress
from splatpipe.pipeline.app.node.tasks.queue import Running, Waiting, next_run, start_times

GB = 10**9


def test_runs_start_in_the_order_of_the_queue_while_there_are_slots() -> None:
    queue = [Waiting("a", GB, 100.0), Waiting("b", GB, 10.0)]
    assert next_run(queue, [], 1, 8 * GB) == "a"
    assert next_run(queue, [Running(GB, 50.0)], 2, 8 * GB) == "a"
    assert next_run(queue, [Running(GB, 50.0)], 1, 8 * GB) is None


def test_a_run_waits_for_memory_and_a_short_one_passes_it_without_delaying_it() -> None:
    running = [Running(5 * GB, 600.0)]
    large, short, long = Waiting("large", 6 * GB, 900.0), Waiting("short", 2 * GB, 500.0), Waiting("long", GB, 700.0)
    assert next_run([large, long, short], running, 3, 8 * GB) == "short"
    assert next_run([large, long], running, 3, 8 * GB) is None


def test_a_run_that_needs_more_than_the_machine_has_starts_alone() -> None:
    assert next_run([Waiting("a", 100 * GB, 1.0)], [], 2, 8 * GB) == "a"
    assert next_run([Waiting("a", 100 * GB, 1.0)], [Running(GB, 1.0)], 2, 8 * GB) is None


def test_memory_that_other_programs_use_counts() -> None:
    assert next_run([Waiting("a", 3 * GB, 1.0)], [Running(GB, 1.0)], 2, 8 * GB, free_bytes=2 * GB) is None


def test_starts_are_estimated_slot_by_slot() -> None:
    queue = [Waiting("a", GB, 100.0), Waiting("b", GB, 10.0), Waiting("c", GB, 10.0)]
    assert start_times(queue, [Running(GB, 30.0)], 2) == {"a": 0.0, "b": 30.0, "c": 40.0}


@pytest.mark.parametrize("code", [1, 2])
def test_an_input_that_cannot_be_used_fails_at_once(code: int) -> None:
    assert judge_run(code, "Only 3 photos.", "", 0).final


@pytest.mark.parametrize("code", [3, -signal.SIGKILL, -signal.SIGSEGV])
def test_a_crash_is_tried_again_before_it_fails(code: int) -> None:
    assert not judge_run(code, "", "", CRASH_TRIES - 1).final
    assert judge_run(code, "", "", CRASH_TRIES).final


def test_what_the_machine_lacks_is_waited_for_longer_and_longer() -> None:
    delays = [judge_run(4, "The disk is full.", "", tries).delay_s for tries in range(MACHINE_TRIES)]
    assert delays == sorted(delays) and delays[0] > 0.0 and sum(delays) > 3600.0
    assert not judge_run(4, "The disk is full.", "", MACHINE_TRIES - 1).final


def test_a_run_that_the_system_killed_says_so_in_words_that_clients_know() -> None:
    assert "Killed" in judge_run(-signal.SIGKILL, "", "depths: 3/20 photos", 2).text


def _event(kind: str, stage: str = "", **data: object) -> str:
    return json.dumps({"kind": kind, "stage": stage, "data": data, "time_s": 1.0}) + "\n"


def test_progress_follows_the_forecast_of_the_stages(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    path.write_text(_event("run_finished", exit_code=1, message="an earlier attempt", hint=""))
    progress = RunProgress(path, {"ingest": 10.0, "train": 90.0})
    assert progress.percent == 0.0
    with path.open("a") as file:
        file.write(_event("run_started", stages=["ingest", "train"]))
        file.write(_event("stage_reused", "ingest"))
        file.write(_event("stage_started", "train"))
        file.write(_event("progress", "train", done=1, total=2, what="training", unit=""))
        file.write('{"torn')
    progress.read()
    assert progress.percent == pytest.approx(55.0)
    assert (progress.stage, progress.what, progress.left_s) == ("train", "training", pytest.approx(45.0))
    assert progress.message == ""


def test_progress_is_that_of_both_stages_where_one_runs_beside_another(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    progress = RunProgress(path, {"train": 60.0, "clean": 10.0, "depths": 30.0})
    events = [_event("run_started", stages=["train", "clean", "depths"])]
    events += [_event("stage_started", name) for name in ("train", "depths")]
    events += [_event("progress", name, done=1, total=2, what=f"{name}ing", unit="") for name in ("train", "depths")]
    path.write_text("".join(events))
    progress._at = 0  # as if it had been followed from the start
    progress.read()
    assert (progress.percent, progress.left_s) == (pytest.approx(45.0), pytest.approx(55.0))
    assert (progress.stage, progress.what) == ("train", "training")
    with path.open("a") as file:
        file.write(_event("stage_finished", "train") + _event("stage_finished", "depths"))
        file.write(_event("stage_started", "clean"))
    progress.read()
    assert (progress.percent, progress.stage, progress.what) == (pytest.approx(90.0), "clean", "")


def test_events_that_nobody_of_ours_wrote_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    progress = RunProgress(path, {"train": float("1e9")})
    path.write_text(
        "null\n[]\n"
        + _event("run_started", stages=["train"])
        + _event("stage_started", "train")
        + _event("progress", "train", done="x", total=0, what=3)
        + _event("progress", "train", done=5, total=0, what=3)
        + _event("run_started")
    )
    progress.read()
    assert progress.percent == 0.0


def test_a_line_that_pyodm_takes_for_a_failure_is_not_sent(tmp_path: Path) -> None:
    output = tmp_path / "output.txt"
    output.write_text("a\nerror\nb  \n\n")
    assert log_lines(("note",), output) == ["note", "a", "error.", "b", ""]
    assert last_line(output) == "b"
    assert log_lines(("note",), tmp_path / "none") == ["note"]
