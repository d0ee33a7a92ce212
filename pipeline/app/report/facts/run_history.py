"""The history of the last run from `events.jsonl`: the progress of its stages and their messages."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from splatpipe.pipeline.engine.events import Event, parse_event
from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.engine.stage import shards_first

Facts = Mapping[str, Any]
State = Literal["finished", "reused", "failed", "stopped", "interrupted", "running", "not reached"]

MAX_BYTES = 64 << 20  # read from the end of the file: events of hundreds of runs
MAX_LINE = 1 << 20
STOPPED = (130, 143)  # exit codes of Ctrl-C and of SIGTERM


@dataclass
class StageMessages:
    """The messages of one stage, over all attempts at one artifact.

    Attributes:
        notes: Notes of the last attempt.
        warnings: Messages and hints of the last attempt.
        metrics: Values by step, by name; of all attempts, since each resumes where the last one stopped.
        progress: The last progress: done, total, what, unit.
    """

    notes: list[str] = field(default_factory=list)
    warnings: list[tuple[str, str]] = field(default_factory=list)
    metrics: dict[str, dict[float, float]] = field(default_factory=dict)
    progress: Facts = field(default_factory=dict)


@dataclass
class StageHistory:
    """A stage in the last run.

    Attributes:
        name: The stage's name.
        state: Its state.
        key: Its artifact's key; empty if an older version ran.
        reason: Why it ran.
        seconds: Wall-clock time; None if unknown.
        memory_bytes: Peak memory; None if unknown.
        message: The error message if it failed.
        hint: What to do about it.
        permanent: Whether the same input will fail again.
        messages: Its messages.
    """

    name: str
    state: State
    key: str = ""
    reason: str = ""
    seconds: float | None = None
    memory_bytes: int | None = None
    message: str = ""
    hint: str = ""
    permanent: bool = False
    messages: StageMessages = field(default_factory=StageMessages)

    @property
    def reached(self) -> float | None:
        """How far it got, in its own unit: the last progress, or the last step of a curve if that is farther."""
        steps = [step for curve in self.messages.metrics.values() for step in curve]
        done = self.messages.progress.get("done")
        return max([*steps, *([] if done is None else [float(done)])], default=None)


@dataclass
class RunHistory:
    """The history of the last run.

    Attributes:
        stages: The stages it was to run, in order.
        began_s: Start, seconds since the epoch; 0 if there is no run.
        ended_s: Time of its last event.
        exit_code: None if its end was not recorded, or it has not ended.
        message: Why it failed.
        hint: What to do about it.
        machine: Device, threads, cores.
        versions: Versions of the libraries.
        running: Whether it is running now.
        keys: The last known key of each stage, from any run.
    """

    stages: dict[str, StageHistory] = field(default_factory=dict)
    began_s: float = 0.0
    ended_s: float = 0.0
    exit_code: int | None = None
    message: str = ""
    hint: str = ""
    machine: Facts = field(default_factory=dict)
    versions: Facts = field(default_factory=dict)
    running: bool = False
    keys: dict[str, str] = field(default_factory=dict)

    @property
    def culprit(self) -> StageHistory | None:
        """The stage in which it failed or is running."""
        bad = ("failed", "stopped", "interrupted", "running")
        return next((stage for stage in self.stages.values() if stage.state in bad), None)

    @property
    def complete(self) -> bool:
        """Whether all its stages are done."""
        good = all(stage.state in ("finished", "reused") for stage in self.stages.values())
        return bool(self.stages) and good and not self.exit_code and not self.running


def read_history(path: Path, *, running: bool) -> RunHistory:
    """Read the events of a run; invalid lines are skipped.

    Args:
        path: `events.jsonl`; it may not exist.
        running: Whether a splatpipe is working in the folder now.
    """
    reader = _EventReader()
    for event in _events(path):
        try:
            reader.take(event)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            continue
    return reader.finish(running)


def _events(path: Path) -> Iterator[Event]:
    try:
        with open_regular(path) as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - MAX_BYTES))
            while line := file.readline(MAX_LINE):
                event = parse_event(line)
                if event is not None:
                    yield event
    except OSError:
        return


class _EventReader:
    """Builds the history from one event after the other."""

    def __init__(self) -> None:
        self._history = RunHistory()
        self._messages: dict[tuple[str, str], StageMessages] = {}
        self._keys: dict[str, str] = {}

    def take(self, event: Event) -> None:
        self._history.ended_s = event.time_s
        getattr(self, f"_{event.kind}")(event.stage, event.data)

    def finish(self, running: bool) -> RunHistory:
        history = self._history
        history.running, history.keys = running, dict(self._keys)
        history.stages = {name: history.stages[name] for name in shards_first(history.stages)}
        for stage in history.stages.values():
            if stage.state == "running" and not running:
                stage.state = "interrupted"
        return history

    def _run_started(self, _name: str, data: Facts) -> None:
        stages = {str(name): StageHistory(str(name), "not reached") for name in data["stages"]}
        self._history = RunHistory(stages, self._history.ended_s, self._history.ended_s)
        self._history.machine, self._history.versions = data.get("machine", {}), data.get("versions", {})

    def _run_finished(self, _name: str, data: Facts) -> None:
        self._history.exit_code = int(data["exit_code"])
        self._history.message, self._history.hint = str(data["message"]), str(data["hint"])

    def _stage_started(self, name: str, data: Facts) -> None:
        stage = self._stage(name, "running", data)
        stage.reason = str(data["reason"])
        before = stage.messages if stage.key else StageMessages()
        # a new attempt's messages replace the earlier ones, but the curves continue
        stage.messages = self._messages[name, stage.key] = StageMessages(
            metrics=before.metrics, progress=before.progress
        )

    def _stage_reused(self, name: str, data: Facts) -> None:
        self._stage(name, "reused", data).seconds = float(data["seconds"])

    def _stage_finished(self, name: str, data: Facts) -> None:
        stage = self._stage(name, "finished", data)
        stage.seconds = float(data["seconds"])
        stage.memory_bytes = data.get("peak_memory_bytes")

    def _stage_failed(self, name: str, data: Facts) -> None:
        code = data.get("exit_code")
        stopped = code in STOPPED if code is not None else data["message"] == "Stopped."
        stage = self._stage(name, "stopped" if stopped else "failed", data)
        stage.message, stage.hint = str(data["message"]), str(data["hint"])
        stage.permanent = bool(data.get("lasting"))
        stage.seconds, stage.memory_bytes = data.get("seconds"), data.get("peak_memory_bytes")

    def _progress(self, name: str, data: Facts) -> None:
        self._messages_of(name).progress = data

    def _metric(self, name: str, data: Facts) -> None:
        curve = self._messages_of(name).metrics.setdefault(str(data["name"]), {})
        curve[float(data["step"] or 0)] = float(data["value"])

    def _note(self, name: str, data: Facts) -> None:
        self._messages_of(name).notes.append(str(data["message"]))

    def _warning(self, name: str, data: Facts) -> None:
        self._messages_of(name).warnings.append((str(data["message"]), str(data["hint"])))

    def _stage(self, name: str, state: State, data: Facts) -> StageHistory:
        stage = self._history.stages.setdefault(name, StageHistory(name, state))
        stage.state = state
        stage.key = str(data.get("key", "")) or stage.key
        self._keys[name] = stage.key
        stage.messages = self._messages.setdefault((name, stage.key), StageMessages())
        return stage

    def _messages_of(self, name: str) -> StageMessages:
        stage = self._history.stages.get(name)
        return stage.messages if stage is not None else StageMessages()
