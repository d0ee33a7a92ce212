"""What happened in the last run, from `events.jsonl`: which stages came how far, and what they said."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from splatpipe.pipeline.engine.events import Event, parse_event
from splatpipe.pipeline.engine.stage import shards_first

Facts = Mapping[str, Any]
State = Literal["finished", "reused", "failed", "stopped", "broken off", "running", "not reached"]

MAX_BYTES = 64 << 20  # of the file's end: hundreds of runs' events
MAX_LINE = 1 << 20
STOPPED = (130, 143)  # exit codes of Ctrl-C and of SIGTERM


@dataclass
class StageMessages:
    """What one stage said, in all attempts at one artifact.

    Attributes:
        notes: Of the last attempt.
        warnings: Messages and hints of the last attempt.
        metrics: Value by step, by name; of all attempts, since one goes on where the other was stopped.
        progress: The last one: done, total, what, unit.
    """

    notes: list[str] = field(default_factory=list)
    warnings: list[tuple[str, str]] = field(default_factory=list)
    metrics: dict[str, dict[float, float]] = field(default_factory=dict)
    progress: Facts = field(default_factory=dict)


@dataclass
class StageHistory:
    """What became of a stage in the last run.

    Attributes:
        name: The stage's.
        state: How it ended.
        key: Of its artifact; empty where an older version ran.
        reason: Why it ran.
        seconds: By the clock; None where unknown.
        memory_bytes: Peak; None where unknown.
        message: What it failed with.
        hint: What to do about it.
        lasting: Whether the same input fails again.
        messages: What it said.
    """

    name: str
    state: State
    key: str = ""
    reason: str = ""
    seconds: float | None = None
    memory_bytes: int | None = None
    message: str = ""
    hint: str = ""
    lasting: bool = False
    messages: StageMessages = field(default_factory=StageMessages)

    @property
    def reached(self) -> float | None:
        """How far it came, in its own unit: the last progress, or the last point of a curve if that is further."""
        steps = [step for curve in self.messages.metrics.values() for step in curve]
        done = self.messages.progress.get("done")
        return max([*steps, *([] if done is None else [float(done)])], default=None)


@dataclass
class RunHistory:
    """The last run.

    Attributes:
        stages: Those it was to walk, in order.
        began_s: Seconds since the epoch; 0 where there is no run.
        ended_s: Of its last event.
        exit_code: None where it ended without a word, or has not ended.
        message: Why it ended badly.
        hint: What to do about it.
        machine: Device, threads, cores.
        versions: Of what computes.
        running: Whether it goes on at this moment.
        keys: The last known key of each stage, in any run.
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
        """The stage in which it ended badly, or is."""
        bad = ("failed", "stopped", "broken off", "running")
        return next((stage for stage in self.stages.values() if stage.state in bad), None)

    @property
    def complete(self) -> bool:
        """Whether all that it was to walk is there."""
        good = all(stage.state in ("finished", "reused") for stage in self.stages.values())
        return bool(self.stages) and good and not self.exit_code and not self.running


def read_history(path: Path, *, running: bool) -> RunHistory:
    """Read the events of a run's folder; lines that are none are passed over.

    Args:
        path: `events.jsonl`; it need not be there.
        running: Whether somebody works in the folder now.
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
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - MAX_BYTES))
            while line := file.readline(MAX_LINE):
                event = parse_event(line)
                if event is not None:
                    yield event
    except OSError:
        return


class _EventReader:
    """Takes one event after the other."""

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
                stage.state = "broken off"
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
        # what it says again counts, and not what it said before; the curves go on
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
        stage.lasting = bool(data.get("lasting"))
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
