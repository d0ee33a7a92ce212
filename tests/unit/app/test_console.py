"""The display of two stages that run at once."""

import io
from typing import Any

import pytest
from rich.console import Console

from splatpipe.pipeline.app.terminal.console import RunConsole
from splatpipe.pipeline.engine.events import Event, Kind

DONE = {"seconds": 3.0, "summary": {"maps": 2, "found": 0.5}}


def event(kind: Kind, stage: str, **data: Any) -> Event:
    return Event(kind, stage, data)


def progress(stage: str, done: int, what: str, unit: str) -> Event:
    return event("progress", stage, done=done, total=100, what=what, unit=unit)


def begun(console: RunConsole) -> None:
    console(Event("run_started", data={"stages": ["train", "clean", "depths"]}))
    console(event("stage_started", "train.1", reason="not run yet", shard={"number": 1, "count": 3}))
    console(event("stage_started", "depths", reason="not run yet"))


def test_lines_of_two_stages_say_whose_they_are(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock_s = iter(range(1000, 2000, 6))  # seconds from event to event; a stage's lines are at least ten apart
    monkeypatch.setattr("splatpipe.pipeline.app.terminal.console.time.monotonic", lambda: float(next(clock_s)))
    monkeypatch.setenv("COLUMNS", "200")
    console = RunConsole()
    begun(console)
    for done in (10, 20, 30):
        console(progress("train.1", done, "training", "iterations"))
        console(progress("depths", done, "finding depths", "photos"))
    console(event("stage_finished", "depths", **DONE))
    console(progress("train.1", 40, "training", "iterations"))
    lines = [" ".join(line.split()) for line in capfd.readouterr().err.splitlines()]
    assert [line for line in lines if "started" not in line] == [
        "1/3 train.1 training: 10/100 iterations, 5 min 48 s including the 2 remaining",
        "3/3 depths finding depths: 10/100 photos",
        "1/3 train.1 training: 20/100 iterations, about 1 min 36 s left, 5 min 36 s including the 2 remaining",
        "3/3 depths finding depths: 20/100 photos, about 1 min 36 s left",
        "1/3 train.1 training: 30/100 iterations, about 1 min 24 s left, 5 min 24 s including the 2 remaining",
        "3/3 depths finding depths: 30/100 photos, about 1 min 24 s left",
        "✓ 3/3 depths 3.0 s 2 depth maps, 50 % of their pixels",
        "1/3 train.1 training: 40/100 iterations, about 1 min 12 s left, 5 min 12 s including the 2 remaining",
    ]


def test_each_of_two_stages_has_a_bar_until_it_ends() -> None:
    console, screen = RunConsole(), io.StringIO()
    console._console = Console(file=screen, force_terminal=True, width=100)
    begun(console)
    console(progress("train.1", 10, "training", "iterations"))
    console(progress("depths", 20, "finding depths", "photos"))
    bars = console._live
    assert bars is not None
    assert [(task.description.split()[1], task.completed) for task in bars.tasks] == [("train.1", 10), ("depths", 20)]
    console(event("stage_finished", "depths", **DONE))
    assert console._live is bars and [task.completed for task in bars.tasks] == [10]
    console(progress("train.1", 30, "training", "iterations"))
    assert [task.completed for task in bars.tasks] == [30]
    console(event("stage_failed", "train.1", message="Stopped."))
    assert console._live is None
    assert "depth maps," in screen.getvalue() and "Stopped." in screen.getvalue()
