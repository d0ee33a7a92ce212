"""The events that a run emits; the console, the report and the batch driver all read these."""

from __future__ import annotations

import errno
import json
import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal, get_args

from splatpipe.pipeline.engine.files.output_file import open_own
from splatpipe.pipeline.engine.stage import JSON

Kind = Literal[
    "run_started",
    "stage_started",
    "stage_reused",
    "stage_finished",
    "stage_failed",
    "progress",
    "metric",
    "note",
    "warning",
    "run_finished",
]

PROGRESS_INTERVAL_S = 0.1  # a console redraws ten times a second at most
LOGGED_PROGRESS_INTERVAL_S = 2.0  # events.jsonl is read afterwards: this is enough for a curve


@dataclass(frozen=True)
class Event:
    """An event of a run.

    Attributes:
        kind: What happened.
        stage: The stage it concerns, or empty.
        data: The details, JSON values. ``progress``: done, total, what, unit. ``metric``: name, value, step.
            ``note``: message. ``warning``: message, hint. ``run_started``: stages, machine, versions.
            ``stage_started``: reason, key. ``stage_reused``: summary, seconds, key. ``stage_finished``: summary,
            seconds, cpu_seconds, peak_memory_bytes, key. ``stage_failed``: message, hint, exit_code, seconds,
            peak_memory_bytes (None: unknown), key, lasting (the same input will fail again). ``run_finished``:
            exit_code, message, hint, seconds.
        time_s: Seconds since the epoch.
    """

    kind: Kind
    stage: str = ""
    data: Mapping[str, JSON] = field(default_factory=dict)
    time_s: float = field(default_factory=time.time)


Sink = Callable[[Event], None]


def parse_event(line: bytes) -> Event | None:
    """Parse a line of ``events.jsonl``; None if it is not a valid event, since the log is not trusted."""
    try:
        record = json.loads(line)
        if record["kind"] in get_args(Kind) and isinstance(record["data"], dict):
            return Event(record["kind"], str(record["stage"]), record["data"], float(record["time_s"]))
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        pass
    return None


class EventReporter:
    """The Reporter passed to stage bodies: turns its calls into events and throttles the progress of each activity.

    The first progress of an activity is always reported: people and tests wait for it by name.
    """

    def __init__(self, stage: str, sink: Sink) -> None:
        self._stage = stage
        self._sink = sink
        self._last_progress_s = 0.0
        self._last_what = ""

    def progress(self, done: int | float, total: int | float, what: str, unit: str = "") -> None:
        now = time.monotonic()
        soon = now - self._last_progress_s < PROGRESS_INTERVAL_S
        if soon and done < total and what == self._last_what:
            return
        self._last_progress_s, self._last_what = now, what
        self._send("progress", {"done": done, "total": total, "what": what, "unit": unit})

    def metric(self, name: str, value: int | float, step: int | None = None) -> None:
        self._send("metric", {"name": name, "value": value, "step": step})

    def note(self, message: str) -> None:
        self._send("note", {"message": message})

    def warning(self, message: str, hint: str = "") -> None:
        self._send("warning", {"message": message, "hint": hint})

    def _send(self, kind: Kind, data: Mapping[str, JSON]) -> None:
        self._sink(Event(kind, self._stage, data))


class EventLog:
    """Appends events to ``events.jsonl``, one JSON object per line, never partial lines; progress is throttled."""

    def __init__(self, path: Path) -> None:
        self._name = path.name
        self._descriptor = open_own(path, os.O_RDWR | os.O_APPEND)
        self._last_progress_s: dict[tuple[str, str], float] = {}  # by stage and activity
        size = os.fstat(self._descriptor).st_size
        if size and os.pread(self._descriptor, 1, size - 1) != b"\n":  # the machine stopped in the middle of a line
            os.write(self._descriptor, b"\n")

    def __call__(self, event: Event) -> None:
        """Append an event.

        Raises:
            OSError: if the disk is full or gone; the file still ends with a complete line.
        """
        if event.kind == "progress":
            thing = event.stage, str(event.data.get("what"))
            if event.time_s - self._last_progress_s.get(thing, 0.0) < LOGGED_PROGRESS_INTERVAL_S:
                return
            self._last_progress_s[thing] = event.time_s
        line = f"{json.dumps(_finite(asdict(event)), allow_nan=False)}\n".encode()
        size = os.fstat(self._descriptor).st_size
        if os.write(self._descriptor, line) < len(line):
            os.ftruncate(self._descriptor, size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), self._name)

    def close(self) -> None:
        os.close(self._descriptor)


def _finite(value: JSON) -> JSON:
    """The value with None in place of numbers that are not finite, which JSON cannot represent."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(name): _finite(each) for name, each in value.items()}
    return [_finite(each) for each in value] if isinstance(value, list | tuple) else value
