"""What became of a capture's jobs: a line when one begins and one when it ends, as they happen."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from splatpipe.pipeline.engine.errors import EXIT_INPUT, EXIT_USAGE
from splatpipe.pipeline.engine.stage import JSON

HOPELESS = (EXIT_INPUT, EXIT_USAGE)  # the same photos and options fail again: no second try
NO_WORD = "It ended without an error message: its process was killed, usually by the system for lack of memory."


@dataclass(frozen=True)
class TryResult:
    """How a go at a stage ended; the fields are those of ``Try``."""

    exit_code: int
    message: str = ""
    hint: str = ""
    final: bool = False


@dataclass(frozen=True)
class Try:
    """One go at a stage.

    Attributes:
        stage: Its name.
        began_s: Seconds since the epoch.
        host: Where.
        process: Its number there.
        ended_s: None where no end was told.
        exit_code: Of the end; None where none was told.
        message: Why it ended badly; empty where it did not.
        hint: What to do about it.
        final: Whether another try would end alike.
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
        """Whether it goes on as far as one can tell from here: of another machine's the end is awaited."""
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
        """Why it ended badly, in one sentence or two; empty while it goes on or where it went well."""
        if self.succeeded or self.alive:
            return ""
        return self.message or NO_WORD


def spent_s(tries: Iterable[Try]) -> float:
    """Seconds in which any of these was at work: shards are side by side, and one that never told its end took none."""
    spent, until_s = 0.0, 0.0
    for each in sorted(tries, key=lambda each: each.began_s):
        ended_s = each.ended_s or each.began_s
        spent += max(0.0, ended_s - max(each.began_s, until_s))
        until_s = max(until_s, ended_s)
    return spent


def read_tries(paths: Iterable[Path]) -> list[Try]:
    """The tries of several files, in the order in which they began."""
    return sorted((each for path in paths for each in TryLog(path).read()), key=lambda each: each.began_s)


class TryLog:
    """Tries of jobs of one capture of which one runs at a time.

    Args:
        path: Of the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def begin(self, stage: str) -> Try:
        """Tell that a stage begins, here and now."""
        begun = Try(stage, time.time(), socket.gethostname(), os.getpid())
        self._append({"begun": asdict(begun)})
        return begun

    def end(self, ending: TryResult) -> None:
        """Tell how what was begun last ended."""
        self._append({"ended": {"ended_s": time.time(), **asdict(ending)}})

    def read(self) -> list[Try]:
        """All of them in order; lines that are none, as a power cut leaves them, are passed over."""
        try:
            lines = self._path.read_bytes().splitlines()
        except FileNotFoundError:
            return []
        tries: list[Try] = []
        for line in lines:
            try:
                told = json.loads(line)
                if "begun" in told:
                    tries.append(Try(**told["begun"]))
                elif tries:
                    tries[-1] = Try(**{**asdict(tries[-1]), **told["ended"]})
            except (ValueError, TypeError, KeyError):
                continue
        return tries

    def _append(self, told: Mapping[str, JSON]) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        try:
            os.write(descriptor, json.dumps(told).encode() + b"\n")
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
