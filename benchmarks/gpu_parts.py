"""Parts of a day with a GPU: each in a process of its own, within its time, and none ends the others.

A part is a generator function of a module beside this one; every row that it yields is kept at once, so that a part
that fails, hangs or runs out of time leaves what it had.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Row = dict[str, Any]

LEAST_S = 10.0  # a part that has less left is not begun: to load torch takes half of that
LONGEST_ERROR = 1200  # characters of what a failed part said last
GRACE_S = 3.0  # from the polite signal to the other one


@dataclass(frozen=True)
class GpuPart:
    """Something to be proven or measured.

    Attributes:
        name: For people.
        entry: ``module:function``; the function takes the arguments and yields rows.
        arguments: Its keyword arguments, as JSON has them.
        limit_s: It is ended after that.
        beside: It runs beside the parts after it, on the CPU.
    """

    name: str
    entry: str
    arguments: Row = field(default_factory=dict)
    limit_s: float = 120.0
    beside: bool = False


@dataclass
class PartOutcome:
    """What became of a part.

    Attributes:
        name: The part's.
        state: done, failed, late (ended at its limit), or not begun.
        seconds: That it took.
        rows: What it yielded.
        error: What it said last, where it did not end well.
    """

    name: str
    state: str
    seconds: float
    rows: list[Row]
    error: str = ""


class PartProcess:
    """A part's process."""

    def __init__(self, part: GpuPart, folder: Path, environment: dict[str, str]) -> None:
        self.part = part
        stem = "".join(letter if letter.isalnum() else "_" for letter in part.name)
        self._rows, self._log = folder / f"{stem}.jsonl", folder / f"{stem}.log"
        self._rows.unlink(missing_ok=True)
        self._began = time.monotonic()
        words = [sys.executable, str(Path(__file__)), part.entry, json.dumps(part.arguments), str(self._rows)]
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(words, stdout=log, stderr=log, env=environment, start_new_session=True)

    def end(self, deadline: float) -> PartOutcome:
        """Wait until it has ended or its time is over."""
        limit = min(deadline, self._began + self.part.limit_s)
        state = "late"
        try:
            code = self._process.wait(max(0.0, limit - time.monotonic()))
            state = "failed" if code else "done"
        except subprocess.TimeoutExpired:
            self._stop()
        rows = [json.loads(line) for line in self._rows.read_text().splitlines()] if self._rows.exists() else []
        error = "" if state == "done" else self._log.read_text(errors="replace")[-LONGEST_ERROR:]
        return PartOutcome(self.part.name, state, round(time.monotonic() - self._began, 1), rows, error)

    def _stop(self) -> None:
        """It and all that it started, politely and then for certain."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(GRACE_S)


def run_parts(
    parts: Sequence[GpuPart], folder: Path, environment: dict[str, str], deadline: float
) -> Iterator[list[PartOutcome]]:
    """Run parts in their order, those ``beside`` beside the others.

    Args:
        parts: What is to be done, the most important first.
        folder: For rows and logs.
        environment: Of their processes.
        deadline: By ``time.monotonic()``; nothing runs on after it.

    Yields:
        All outcomes so far, after each part.
    """
    folder.mkdir(parents=True, exist_ok=True)
    outcomes: list[PartOutcome] = []
    beside: list[PartProcess] = []
    try:
        for part in parts:
            if deadline - time.monotonic() < LEAST_S:
                outcomes.append(PartOutcome(part.name, "not begun", 0.0, [], "no time was left"))
            elif part.beside:
                beside.append(PartProcess(part, folder, environment))
                continue
            else:
                outcomes.append(PartProcess(part, folder, environment).end(deadline))
            print_outcome(outcomes[-1])
            yield outcomes
        while beside:
            outcomes.append(beside.pop(0).end(deadline))
            print_outcome(outcomes[-1])
            yield outcomes
    finally:
        for running in beside:
            running.end(0.0)


def print_outcome(outcome: PartOutcome) -> None:
    """A part's rows, one a line."""
    print(f"-- {outcome.name}: {outcome.state}, {outcome.seconds:.1f} s", flush=True)
    for row in outcome.rows:
        print("   " + "  ".join(f"{key} {_shown(value)}" for key, value in row.items()), flush=True)
    if outcome.error:
        print("   " + outcome.error.strip().splitlines()[-1][:200], flush=True)


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main(entry: str, arguments: str, rows: str) -> None:
    """One part: what its function yields, a row a line."""
    module, _, function = entry.partition(":")
    with Path(rows).open("w", encoding="utf-8", buffering=1) as file:
        for row in getattr(importlib.import_module(module), function)(**json.loads(arguments)):
            file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
