"""Reads a run's ``events.jsonl`` as it grows."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from splatpipe.pipeline.app.serving.files import FileNotServedError, open_inside
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.events import parse_event
from splatpipe.pipeline.engine.runs.run_folder import Contents, RunFolder
from splatpipe.pipeline.engine.stage import JSON, shards_first, stage_name
from splatpipe.stages.options import LineConfig

MAX_LINE_BYTES = 1 << 18
READ_AT_ONCE = 8 << 20
MAX_POINTS = 2000  # points in a curve: twice the width of a screen
MAX_NOTES = 200
RATE_WINDOW_S = 60.0  # for the estimate of the time left: iterations slow down as the model grows


@dataclass
class StageState:
    """The state of a stage in the log.

    Attributes:
        name: The stage's name.
        state: ``waiting``, ``running``, ``done``, ``reused`` or ``failed``.
        seconds: Its duration; None until it has ended.
        done: Work done.
        total: Total work.
        what: The current activity.
        unit: The unit of ``done`` and ``total``.
        trail: Times (seconds since the epoch) and progress over the last ``RATE_WINDOW_S``.
        message: The error message of a failure.
        shard: The shard's number and count; empty for a stage's own body.
        began_s: Start, seconds since the epoch; 0 if not started.
    """

    name: str
    state: str = "waiting"
    seconds: float | None = None
    done: float = 0.0
    total: float = 0.0
    what: str = ""
    unit: str = ""
    trail: list[tuple[float, float]] = field(default_factory=list)
    message: str = ""
    shard: Mapping[str, int] = field(default_factory=dict)
    began_s: float = 0.0

    def progress(self, data: Mapping[str, JSON], time_s: float) -> None:
        """Process a progress event."""
        what = str(data["what"])
        if what != self.what:
            self.trail.clear()
        self.done, self.total = float(data["done"]), float(data["total"])
        self.what, self.unit = what, str(data.get("unit", ""))
        self.trail.append((time_s, self.done))
        while len(self.trail) > 2 and self.trail[1][0] < time_s - RATE_WINDOW_S:
            del self.trail[0]

    @property
    def seconds_left(self) -> float | None:
        """Seconds left at the rate of the last minute; None if unknown."""
        if self.state != "running" or len(self.trail) < 2:
            return None
        (first_s, first), (last_s, last) = self.trail[0], self.trail[-1]
        pace = (last - first) / max(last_s - first_s, 1e-9)
        return max(0.0, self.total - last) / pace if pace > 0.0 else None

    def as_json(self) -> dict[str, JSON]:
        """The state as JSON, for the page."""
        kept = ("name", "state", "seconds", "done", "total", "what", "unit", "message")
        return {name: getattr(self, name) for name in kept} | {"seconds_left": self.seconds_left}


@dataclass
class Curve:
    """A metric over its steps; every second point is dropped when there are too many."""

    points: list[tuple[int, float]] = field(default_factory=list)
    stride: int = 1
    seen: int = 0

    def add(self, step: int, value: float) -> None:
        """Add a point; an earlier step discards all points from there on (a run resumed from a checkpoint)."""
        while self.points and self.points[-1][0] >= step:
            self.points.pop()
        self.seen += 1
        if self.seen % self.stride:
            return
        self.points.append((step, value))
        if len(self.points) > MAX_POINTS:
            self.points = self.points[::2]
            self.stride *= 2


class RunLog:
    """The last run in a growing log.

    Args:
        out: The run's folder.
        name: Name of the log in it.
    """

    def __init__(self, out: Path, name: str) -> None:
        self._out, self._name = out, name
        self._inode, self._offset, self._rest = "", 0, b""
        self.keys: dict[str, str] = {}  # the last known key of each stage, from any run
        self._begin()

    def _begin(self) -> None:
        self.stages: dict[str, StageState] = {}
        self.curves: dict[str, Curve] = {}
        self.curves_of = ""  # the stage or shard they belong to
        self.notes: list[dict[str, JSON]] = []
        self.device = "auto"  # as given to the run
        self.started_s: float | None = None
        self.last_s: float | None = None
        self.finished = False

    def read(self) -> None:
        """Read what was written since the last call; a replaced or truncated log is read from the start."""
        try:
            file = open_inside(self._out, self._name)
        except FileNotServedError:
            return
        try:
            inode = file.tag.partition("-")[0]
            if inode != self._inode or file.size < self._offset:
                self._inode, self._offset, self._rest = inode, 0, b""
                self.keys = {}
                self._begin()
            while self._offset < file.size:
                chunk = os.pread(file.descriptor, READ_AT_ONCE, self._offset)
                if not chunk:
                    break
                self._offset += len(chunk)
                *lines, self._rest = (self._rest + chunk).split(b"\n")
                self._rest = self._rest[: MAX_LINE_BYTES + 1]
                for line in lines:
                    self._process(line)
        finally:
            os.close(file.descriptor)

    def _process(self, line: bytes) -> None:
        """Process a line; invalid ones are skipped, since the log is not trusted."""
        if len(line) > MAX_LINE_BYTES:
            return
        event = parse_event(line)
        if event is None:
            return
        try:
            self._event(event.kind, event.stage, event.data, event.time_s)
        except (ValueError, KeyError, TypeError, OverflowError):
            return

    def _event(self, kind: str, stage: str, data: Mapping[str, JSON], time_s: float) -> None:
        self.last_s = time_s
        if kind == "run_started":
            stages = {str(name): StageState(str(name)) for name in data["stages"]}
            self._begin()
            self.started_s, self.last_s, self.stages = time_s, time_s, stages
            machine = data.get("machine")
            self.device = str(machine.get("device", "auto")) if isinstance(machine, Mapping) else "auto"
        elif kind == "run_finished":
            self.finished = True
        elif kind == "metric":
            value, step = float(data["value"]), data["step"]
            if step is not None and math.isfinite(value):
                self.curves_of = stage
                self.curves.setdefault(str(data["name"]), Curve()).add(int(step), value)
        elif kind in ("note", "warning"):
            note = {"kind": kind, "stage": stage, "message": str(data["message"]), "hint": str(data.get("hint", ""))}
            self.notes = [*self.notes, note][-MAX_NOTES:]
        elif stage_name(stage) in self.stages:
            if stage not in self.stages:  # a shard that starts
                known = {**self.stages, stage: StageState(stage)}
                self.stages = {name: known[name] for name in shards_first(known)}
            self._stage_event(kind, self.stages[stage], data, time_s)

    @property
    def left_after_s(self) -> float | None:
        """Approximate seconds for the shards after the current one; None if unknown or if there are none."""
        running = next((stage for stage in self.stages.values() if stage.state == "running" and stage.shard), None)
        if running is None or running.seconds_left is None or self.last_s is None:
            return None
        of = stage_name(running.name)
        done = [stage.seconds for name, stage in self.stages.items() if stage_name(name) == of and stage.seconds]
        later = range(int(running.shard["number"]) + 1, int(running.shard["count"]) + 1)
        open_ones = sum(f"{of}.{number}" not in self.stages for number in later)
        each = [*done, self.last_s - running.began_s + running.seconds_left]
        return open_ones * sum(each) / len(each) if open_ones else None

    @property
    def unfinished(self) -> set[str]:
        """Stages that the last run started and did not finish."""
        return {name for name, stage in self.stages.items() if stage.state in ("running", "failed")}

    def _stage_event(self, kind: str, state: StageState, data: Mapping[str, JSON], time_s: float) -> None:
        if "key" in data:
            self.keys[state.name] = str(data["key"])
        if kind == "progress":
            state.progress(data, time_s)
        elif kind == "stage_started":
            state.state, state.began_s = "running", time_s
            state.shard = data.get("shard", {})
        elif kind in ("stage_finished", "stage_reused"):
            state.state, state.seconds = kind.removeprefix("stage_").replace("finished", "done"), float(data["seconds"])
        elif kind == "stage_failed":
            state.state, state.message = "failed", f"{data['message']} {data.get('hint', '')}".strip()


def contents_of(run: RunFolder, log: RunLog) -> Contents:
    """The current contents of a run.

    Args:
        run: The run.
        log: Its log, which is read up to its current end.
    """
    log.read()
    try:
        _, config = run.config(LineConfig)
    except SplatpipeError:
        config = None
    return run.contents(config, log.keys, log.unfinished)
