"""The log of a capture's jobs: one line when an attempt starts and one when it ends."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from splatpipe.pipeline.engine.errors import EXIT_INPUT, EXIT_USAGE
from splatpipe.pipeline.engine.output_file import appended_file
from splatpipe.pipeline.engine.small_file import read_small
from splatpipe.pipeline.engine.stage import JSON

PERMANENT_FAILURES = (EXIT_INPUT, EXIT_USAGE)  # the same photos and options would fail again: not retried
MAX_LOG_BYTES = 16 << 20
NO_MESSAGE = "It ended without an error message: its process was killed, usually by the system for lack of memory."


@dataclass(frozen=True)
class AttemptResult:
    """The outcome of an attempt; the fields are those of ``Attempt``."""

    exit_code: int
    message: str = ""
    hint: str = ""
    final: bool = False


@dataclass(frozen=True)
class Attempt:
    """One attempt to run a stage.

    Attributes:
        stage: The stage's name.
        began_s: Start, seconds since the epoch.
        host: The machine.
        process: The process ID on that machine.
        ended_s: End; None if not recorded.
        exit_code: Exit code; None if not recorded.
        message: Why it failed; else empty.
        hint: What to do about it.
        final: Whether a retry would fail in the same way.
    """

    stage: str
    began_s: float
    host: str
    process: int
    ended_s: float | None = None
    exit_code: int | None = None
    message: str = ""
    hint: str = ""
    final: bool = False

    @property
    def succeeded(self) -> bool:
        return self.exit_code == 0

    @property
    def alive(self) -> bool:
        """Whether it is still running, as far as is known here; on another machine, until its end is recorded."""
        if self.ended_s is not None:
            return False
        if self.host != socket.gethostname():
            return True
        try:
            os.kill(self.process, 0)
        except ProcessLookupError:
            return False
        except PermissionError:
            return True
        return True

    @property
    def reason(self) -> str:
        """Why it failed, in one or two sentences; empty while it is running or if it succeeded."""
        if self.succeeded or self.alive:
            return ""
        return self.message or NO_MESSAGE


def spent_s(attempts: Iterable[Attempt]) -> float:
    """Seconds during which any of these attempts was running, counted once; one without a recorded end counts as 0."""
    spent, until_s = 0.0, 0.0
    for each in sorted(attempts, key=lambda each: each.began_s):
        ended_s = each.ended_s or each.began_s
        spent += max(0.0, ended_s - max(each.began_s, until_s))
        until_s = max(until_s, ended_s)
    return spent


def read_attempts(paths: Iterable[Path]) -> list[Attempt]:
    """The attempts of several files, in order of their start."""
    return sorted((each for path in paths for each in AttemptLog(path).read()), key=lambda each: each.began_s)


class AttemptLog:
    """The attempts of those jobs of a capture that run one at a time.

    Args:
        path: The log file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def begin(self, stage: str) -> Attempt:
        """Record that a stage starts here and now."""
        begun = Attempt(stage, time.time(), socket.gethostname(), os.getpid())
        self._append({"begun": asdict(begun)})
        return begun

    def end(self, ending: AttemptResult) -> None:
        """Record the outcome of the last attempt."""
        self._append({"ended": {"ended_s": time.time(), **asdict(ending)}})

    def read(self) -> list[Attempt]:
        """All attempts in order; malformed lines, e.g. after a power cut, are skipped."""
        try:
            lines = read_small(self._path, MAX_LOG_BYTES).splitlines()
        except FileNotFoundError:
            return []
        attempts: list[Attempt] = []
        for line in lines:
            try:
                record = json.loads(line)
                if "begun" in record:
                    attempts.append(Attempt(**record["begun"]))
                elif attempts:
                    attempts[-1] = Attempt(**{**asdict(attempts[-1]), **record["ended"]})
            except (ValueError, TypeError, KeyError):
                continue
        return attempts

    def _append(self, record: Mapping[str, JSON]) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with appended_file(self._path) as file:
            file.write(json.dumps(record).encode() + b"\n")
            os.fsync(file.fileno())
