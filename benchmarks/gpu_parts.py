"""Run the parts of a GPU session: each in its own process with a time limit, none able to end the others.

A part is a generator function of a module in this folder. Every row that it yields is saved at once, so a part that
fails, hangs or runs out of time keeps its earlier rows.
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

MIN_S = 10.0  # a part with less time left is not started: loading torch takes half of it
LONGEST_ERROR = 1200  # characters of a failed part's last output
GRACE_S = 3.0  # from SIGTERM to SIGKILL


@dataclass(frozen=True)
class GpuPart:
    """Something to be checked or measured.

    Attributes:
        name: Name to display.
        entry: ``module:function``; the function takes the arguments and yields rows.
        arguments: Keyword arguments, JSON-serializable.
        limit_s: Time limit; the part is terminated after it.
        beside: Run it on the CPU alongside the parts after it.
    """

    name: str
    entry: str
    arguments: Row = field(default_factory=dict)
    limit_s: float = 120.0
    beside: bool = False


@dataclass
class PartOutcome:
    """Result of a part.

    Attributes:
        name: The part's name.
        state: done, failed, late (terminated at its limit), or not begun.
        seconds: Its duration.
        rows: The rows that it yielded.
        error: Its last output, if it did not succeed.
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
        """Wait until it has ended or its time is up."""
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
        """Terminate the process and everything it started, first politely, then by force."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(GRACE_S)


def run_parts(
    parts: Sequence[GpuPart], folder: Path, environment: dict[str, str], deadline: float
) -> Iterator[list[PartOutcome]]:
    """Run parts in order, those marked ``beside`` alongside the others.

    Args:
        parts: The parts, the most important first.
        folder: Folder for rows and logs.
        environment: Environment of their processes.
        deadline: By ``time.monotonic()``; nothing runs past it.

    Yields:
        All outcomes so far, after each part.
    """
    folder.mkdir(parents=True, exist_ok=True)
    outcomes: list[PartOutcome] = []
    beside: list[PartProcess] = []
    try:
        for part in parts:
            if deadline - time.monotonic() < MIN_S:
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
    """Print a part's rows, one per line."""
    print(f"-- {outcome.name}: {outcome.state}, {outcome.seconds:.1f} s", flush=True)
    for row in outcome.rows:
        print("   " + "  ".join(f"{key} {_shown(value)}" for key, value in row.items()), flush=True)
    if outcome.error:
        print("   " + outcome.error.strip().splitlines()[-1][:200], flush=True)


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main(entry: str, arguments: str, rows: str) -> None:
    """Run one part and write the rows that its function yields, one per line."""
    module, _, function = entry.partition(":")
    with Path(rows).open("w", encoding="utf-8", buffering=1) as file:
        for row in getattr(importlib.import_module(module), function)(**json.loads(arguments)):
            file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
