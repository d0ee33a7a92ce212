"""Run the parts of a visit to a GPU: each in its own process with a time limit, none able to end the others.

A part is a generator function of a module in this folder. Every row that it yields is written at once, as a line of the
visit's file, so a part that fails, hangs or runs out of time leaves its earlier rows, and a visit that is cut off what
was measured until then.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Row = dict[str, Any]

MIN_S = 4.0  # a part with less time left is not started
MAX_ERROR_LETTERS = 1200  # characters of a failed part's last output
GRACE_S = 1.5  # from SIGTERM to SIGKILL, and from there until a process that cannot be killed is left alone
POLL_S = 0.02
REFUSED = 77  # exit code of a part that the machine does not permit
QUIET = "quiet"  # entry of the part that waits for those alongside


class Refusal(Exception):
    """Raised by a part that the machine does not permit: no fault of ours."""


@dataclass(frozen=True)
class GpuPart:
    """Something to be checked or measured.

    Attributes:
        name: Name to display.
        entry: ``module:function``; the function takes the arguments and yields rows. ``QUIET``: waits for the parts
            alongside, and terminates them at its limit.
        arguments: Keyword arguments, JSON-serializable.
        limit_s: Time limit; the part is terminated after it. Time that earlier parts left over is added, except to a
            part with ``on_failure``.
        beside: Run it alongside the parts after it, until the next ``QUIET`` one.
        on_failure: If it does not succeed, this part is run, and the visit ends: without it, nothing else makes sense.
        ours: Whether its failure is one of ours; a peer's is not.
    """

    name: str
    entry: str
    arguments: Row = field(default_factory=dict)
    limit_s: float = 60.0
    beside: bool = False
    on_failure: GpuPart | None = None
    ours: bool = True


@dataclass
class PartOutcome:
    """Result of a part.

    Attributes:
        name: The part's name.
        state: done, failed, late (terminated at its limit), refused (not permitted by the machine), or not begun.
        seconds: Its duration.
        error: Its last output, if it did not succeed.
    """

    name: str
    state: str
    seconds: float = 0.0
    error: str = ""


@dataclass(frozen=True)
class VisitFile:
    """The visit's record: one JSON object a line, and beside it the log, what the parts print.

    Attributes:
        path: Path of the file.
    """

    path: Path

    def log(self, part: GpuPart | None = None) -> Path:
        """Return the path of the log, or of the own one of a part that runs alongside others."""
        if part is None or not part.beside:
            return self.path.with_suffix(".log")
        stem = "".join(letter if letter.isalnum() else "-" for letter in part.name)
        return self.path.with_name(f"{self.path.stem}.{stem}.log")

    def write(self, line: Mapping[str, Any]) -> None:
        """Append a line; several processes may do so."""
        with self.path.open("ab", buffering=0) as file:
            file.write((json.dumps(line) + "\n").encode())
            os.fsync(file.fileno())

    def ended(self, outcome: PartOutcome) -> None:
        """Append a part's outcome, and print it."""
        facts = {"state": outcome.state, "seconds": round(outcome.seconds, 1)}
        self.write({"part": outcome.name} | facts | ({"error": outcome.error} if outcome.error else {}))
        print(f"-- {outcome.name}: {outcome.state}, {outcome.seconds:.1f} s", flush=True)
        if outcome.error:
            print("   " + outcome.error.strip().splitlines()[-1][:200], flush=True)


class PartProcess:
    """A part's process, forked from this one, so that it need not import again what this one has imported.

    This process must not use the device: a fork of it could not.
    """

    def __init__(self, part: GpuPart, file: VisitFile) -> None:
        self.part, self._file = part, file
        self._began = time.monotonic()
        self._log = file.log(part)
        self._log_from = self._log.stat().st_size if self._log.exists() else 0
        sys.stdout.flush()
        sys.stderr.flush()
        with warnings.catch_warnings():  # threads of numpy's BLAS, which takes care of forks
            warnings.simplefilter("ignore", DeprecationWarning)
            self._pid = os.fork()
        if self._pid == 0:
            self._run()

    def _run(self) -> None:
        """In the new process: run the part and exit."""
        code = 1
        try:
            os.setsid()
            for number in (signal.SIGTERM, signal.SIGINT):
                signal.signal(number, signal.SIG_DFL)
            log = os.open(self._log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(log, 1)
            os.dup2(log, 2)
            print(f"== {self.part.name}", flush=True)
            code = run_entry(self.part, self._file)
        except BaseException:
            traceback.print_exc()
        finally:
            with contextlib.suppress(Exception):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code)

    def end(self, deadline: float, slot_end: float = 0.0) -> PartOutcome:
        """Wait until it has ended or its time is up: its limit, or that of its place in the order if that is later."""
        limit = min(deadline, max(self._began + self.part.limit_s, slot_end))
        code = self._wait(limit)
        if code is None:
            state = "late"
            self._stop()
        else:
            state = {0: "done", REFUSED: "refused"}.get(code, "failed")
        error = "" if state == "done" else self._said()
        return PartOutcome(self.part.name, state, time.monotonic() - self._began, error)

    def _said(self) -> str:
        """Return the end of what it printed."""
        with contextlib.suppress(FileNotFoundError), self._log.open("rb") as file:
            file.seek(self._log_from)
            return file.read().decode(errors="replace").strip()[-MAX_ERROR_LETTERS:]
        return ""

    def _wait(self, until: float) -> int | None:
        """Return its exit code, or None if it runs on."""
        while True:
            pid, status = os.waitpid(self._pid, os.WNOHANG)
            if pid:
                return os.waitstatus_to_exitcode(status)
            if time.monotonic() >= until:
                return None
            time.sleep(POLL_S)

    def _stop(self) -> None:
        """Terminate the process and everything it started, first politely, then by force."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._pid, number)
            if self._wait(time.monotonic() + GRACE_S) is not None and number == signal.SIGTERM:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self._pid, signal.SIGKILL)  # what it left behind
                return


def run_entry(part: GpuPart, file: VisitFile) -> int:
    """Run a part here and write the rows that its function yields; return the exit code."""
    module, _, function = part.entry.partition(":")
    try:
        for row in getattr(importlib.import_module(module), function)(**part.arguments):
            file.write({"part": part.name, "row": row})
            print("   " + row_text(row), flush=True)
    except Refusal as error:
        print(f"refused: {error}", flush=True)
        return REFUSED
    except SystemExit as error:
        if error.code is not None and not isinstance(error.code, int):
            print(error.code, flush=True)
            return 1
        return int(error.code or 0)
    return 0


def run_parts(
    parts: Sequence[GpuPart], file: VisitFile, deadline: float, ready: Callable[[], None] = lambda: None
) -> list[PartOutcome]:
    """Run parts in order, those marked ``beside`` alongside the others.

    Args:
        parts: The parts, the most telling first.
        file: Gets rows and outcomes.
        deadline: By ``time.monotonic()``; nothing runs past it.
        ready: Called before the first part that is not ``beside``: imports what all of them need.

    Returns:
        All outcomes, in the order of their ends.
    """
    outcomes: list[PartOutcome] = []
    beside: list[PartProcess] = []
    is_ready = False
    slot_end = time.monotonic()

    def add(outcome: PartOutcome) -> PartOutcome:
        outcomes.append(outcome)
        file.ended(outcome)
        return outcome

    try:
        for number, part in enumerate(parts):
            if not part.beside and not is_ready:
                ready()
                is_ready = True
            slot_end += 0.0 if part.beside else part.limit_s
            if deadline - time.monotonic() < MIN_S:
                add(PartOutcome(part.name, "not begun", error="no time was left"))
            elif part.entry == QUIET:
                began = time.monotonic()
                until = max(slot_end, began + part.limit_s)
                for running in _taken(beside):
                    add(running.end(min(deadline, until)))
                add(PartOutcome(part.name, "done", time.monotonic() - began))
            elif part.beside:
                beside.append(PartProcess(part, file))
            elif part.on_failure is None:
                add(PartProcess(part, file).end(deadline, slot_end))
            elif add(PartProcess(part, file).end(deadline)).state != "done":
                add(PartProcess(part.on_failure, file).end(deadline))
                for left in parts[number + 1 :]:
                    add(PartOutcome(left.name, "not begun", error=f"the visit ended after: {part.name}"))
                break
    finally:
        for running in _taken(beside):
            add(running.end(0.0))
    return outcomes


def _taken(running: list[PartProcess]) -> Iterator[PartProcess]:
    while running:
        yield running.pop(0)


def row_text(row: Row) -> str:
    """Return a row as one line of text."""
    texts = {key: f"{value:.4g}" if isinstance(value, float) else str(value) for key, value in row.items()}
    return "  ".join(f"{key} {text}" for key, text in texts.items())


def read_lines(path: Path) -> list[Row]:
    """Return the lines of a visit's file; one that was cut off while it was written is left out."""
    lines = []
    for text in path.read_text(encoding="utf-8").splitlines():
        with contextlib.suppress(ValueError):
            lines.append(json.loads(text))
    return lines
