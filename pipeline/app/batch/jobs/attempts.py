"""What became of each attempt of a job, from its log and from what `job_errors` recorded of it."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from splatpipe.pipeline.app.batch.jobs.job_errors import EngineError
from splatpipe.pipeline.engine.errors import EXIT_INPUT, EXIT_STAGE, EXIT_USAGE
from splatpipe.pipeline.engine.files.output_file import appended_file
from splatpipe.pipeline.engine.files.small_file import read_small
from splatpipe.pipeline.engine.stage import JSON

PERMANENT_FAILURES = (EXIT_INPUT, EXIT_USAGE)  # exit codes not retried: these photos and options would fail again
SIGNALS = 128  # an exit code above it is that of a signal
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
        number: Snakemake's number of the attempt, from 1; the same if the engine below it restarts the job by itself.
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
    number: int = 1

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
    def ended_from_outside(self) -> bool:
        """Whether a signal ended it, or nothing was recorded: the engine may say why, or restart it by itself."""
        return self.exit_code is None or self.exit_code > SIGNALS

    @property
    def reason(self) -> str:
        """Why it failed, in one or two sentences; empty while it is running or if it succeeded."""
        if self.succeeded or self.alive:
            return ""
        return self.message or NO_MESSAGE


def as_engine_knows(
    attempts: Sequence[Attempt], errors: Sequence[EngineError], stages: Sequence[str], *, running: bool
) -> list[Attempt]:
    """A job's attempts corrected by what the engine reported of them, for jobs that run elsewhere.

    An attempt counts once the engine has ended it: it may have been on a machine that can no longer say so, or not have
    begun at all, and one that the engine restarts by itself is none.

    Args:
        attempts: The attempts at the job's stages, in order.
        errors: The engine's reports, one for each of Snakemake's attempts that has failed, in order.
        stages: The job's stages, in order.
        running: Whether the engine's reports are complete only later, for the batch is still running.
    """
    last = {(each.number, each.stage): at for at, each in enumerate(attempts)}
    found: list[Attempt] = []
    for at, each in enumerate(attempts):
        if last[each.number, each.stage] != at and not each.succeeded:
            continue  # restarted by the engine
        if each.succeeded or each.final:
            found.append(each)
        elif each.number <= len(errors):
            found.append(_ended_by(each, errors[each.number - 1]))
        elif (each.ended_s is None and each.alive) or not running:
            found.append(each)
    for number, error in enumerate(errors, 1):
        if any(each.final for each in found):
            break  # Snakemake's retries of a hopeless stage, which do not begin it again
        if not any(each.number == number and not each.succeeded for each in found):
            done = {each.stage for each in found if each.succeeded and each.number <= number}
            stage = next((stage for stage in stages if stage not in done), stages[-1])
            never = Attempt(stage, 0.0, "", 0, number=number)
            found.insert(sum(each.number <= number for each in found), _ended_by(never, error))
    return found


def _ended_by(attempt: Attempt, error: EngineError) -> Attempt:
    """An attempt with the engine's reason, unless it knows a better one itself."""
    ended_s = attempt.began_s if attempt.ended_s is None else attempt.ended_s
    if not error.decides and not attempt.ended_from_outside:
        return replace(attempt, ended_s=ended_s)
    return replace(attempt, ended_s=ended_s, exit_code=EXIT_STAGE, message=error.reason, hint=error.hint)


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

    def begin(self, stage: str, number: int = 1) -> Attempt:
        """Record that a stage starts here and now, in Snakemake's attempt of that number."""
        begun = Attempt(stage, time.time(), socket.gethostname(), os.getpid(), number=number)
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
