"""Progress of a run, read from its events as they are written."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from splatpipe.pipeline.engine.events import Event, parse_event
from splatpipe.pipeline.engine.stage import stage_name

READ_BYTES = 1 << 20  # at most, at once: a long run's events are some megabytes
LEAST_WEIGHT_S = 1.0  # of a stage without a forecast
MOST = 99.0  # per cent before the results can be downloaded


class RunProgress:
    """Follows ``events.jsonl``.

    Args:
        path: The file, which need not exist yet; what is in it already is of earlier attempts.
        weights: Expected seconds of each stage.
    """

    def __init__(self, path: Path, weights: Mapping[str, float]) -> None:
        self._path, self._weights = path, weights
        self._rest = b""
        self._at = 0
        with suppress(OSError):
            self._at = path.stat().st_size
        self._order: list[str] = []
        self._done: set[str] = set()
        self._fractions: dict[str, float] = {}  # of the stages that run, one or two
        self._whats: dict[str, str] = {}
        self._stage = ""
        self.message, self.hint = "", ""
        self.moved_s = time.monotonic()

    @property
    def percent(self) -> float:
        """How much is done, 0 to 99, by the forecast's times."""
        whole = sum(self._weight(name) for name in self._order)
        if not whole:
            return 0.0
        return min(MOST, max(0.0, 100.0 * (whole - self.left_s) / whole))

    @property
    def left_s(self) -> float:
        """Forecast seconds left."""
        rest = (name for name in self._order if name not in self._done)
        return sum(self._weight(name) * (1.0 - self._fractions.get(name, 0.0)) for name in rest)

    @property
    def stage(self) -> str:
        """The stage that is running, the first in order if another runs beside it; empty before the first."""
        return next((name for name in self._order if name in self._fractions), self._stage)

    @property
    def what(self) -> str:
        """What it is doing."""
        return self._whats.get(self.stage, "")

    def read(self) -> None:
        """Read the events that were added."""
        try:
            with self._path.open("rb") as file:
                if self._at > os.fstat(file.fileno()).st_size:
                    self._at, self._rest = 0, b""
                file.seek(self._at)
                data = file.read(READ_BYTES)
        except OSError:
            return
        if not data:
            return
        self._at += len(data)
        self.moved_s = time.monotonic()
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            event = parse_event(line)
            if event is not None:
                with suppress(KeyError, TypeError, ValueError, ZeroDivisionError):
                    self._see(event)

    def _see(self, event: Event) -> None:
        name = stage_name(event.stage)
        if event.kind == "run_started":
            self._order, self._done = [str(each) for each in event.data["stages"]], set()
            self._fractions, self._whats, self._stage = {}, {}, ""
        elif event.kind == "stage_started" and name == event.stage:
            self._stage, self._fractions[name], self._whats[name] = name, 0.0, ""
        elif event.kind in ("stage_finished", "stage_reused", "stage_failed") and name == event.stage:
            self._fractions.pop(name, None)
            if event.kind != "stage_failed":
                self._done.add(name)
        elif event.kind == "progress" and name in self._fractions:
            self._fractions[name] = min(1.0, max(0.0, float(event.data["done"]) / float(event.data["total"])))
            self._whats[name] = str(event.data["what"])
        elif event.kind == "run_finished":
            self.message, self.hint = str(event.data.get("message", "")), str(event.data.get("hint", ""))

    def _weight(self, stage: str) -> float:
        return max(LEAST_WEIGHT_S, self._weights.get(stage, 0.0))
