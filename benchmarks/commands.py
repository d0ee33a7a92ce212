"""Commands of the line as subprocesses, a few at a time: what each used, how it ended, and no orphans."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

POLL_S = 0.1  # far below what any run takes
GRACE_S = 10.0  # the line ends within five seconds of a signal
LONGEST_MESSAGE = 400  # characters of a failure that are told; the log has the rest


@dataclass(frozen=True)
class Command:
    """A call of this interpreter.

    Attributes:
        name: For people.
        words: After the interpreter: a script or module, and its arguments.
        log: File that takes what it tells.
    """

    name: str
    words: tuple[str, ...]
    log: Path


def splatpipe(name: str, arguments: Sequence[str], log: Path) -> Command:
    """A call of the line, whose message of failure is told."""
    return Command(name, ("-m", "splatpipe.pipeline.app.cli", *arguments, "--json"), log)


@dataclass(frozen=True)
class CommandEnd:
    """How a command ended.

    Attributes:
        command: Which.
        failure: Its message; empty where it did what it should.
        wall_s: From its start.
        cpu_s: Of it and all its descendants.
    """

    command: Command
    failure: str
    wall_s: float
    cpu_s: float


def run_all(commands: Sequence[Command], jobs: int) -> Iterator[CommandEnd]:
    """Run commands; those that run when this ends early are ended.

    Args:
        commands: In the order in which they start.
        jobs: How many run at once.

    Yields:
        Their ends, as they come.
    """
    waiting = list(reversed(commands))
    running: dict[int, _Running] = {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                started = _Running.start(waiting.pop())
                running[started.process.pid] = started
            ended = next((end for each in running.values() if (end := each.poll()) is not None), None)
            if ended is None:
                time.sleep(POLL_S)
                continue
            running = {pid: each for pid, each in running.items() if each.command is not ended.command}
            yield ended
    finally:
        _end([each.process for each in running.values()])


@dataclass(frozen=True)
class _Running:
    command: Command
    process: subprocess.Popen[bytes]
    since: float

    @staticmethod
    def start(command: Command) -> _Running:
        command.log.parent.mkdir(parents=True, exist_ok=True)
        words = [sys.executable, *command.words]
        with command.log.open("wb") as log, _told(command).open("wb") as told:
            # A session of its own: the terminal's Ctrl-C reaches only us, and we end it.
            process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=told, stderr=log, start_new_session=True)
        return _Running(command, process, time.perf_counter())

    def poll(self) -> CommandEnd | None:
        """Its end, once; None while it runs."""
        pid, status, usage = os.wait4(self.process.pid, os.WNOHANG)
        if pid == 0:
            return None
        self.process.returncode = os.waitstatus_to_exitcode(status)
        failure = _failure(self.command, self.process.returncode)
        _told(self.command).unlink()
        return CommandEnd(self.command, failure, time.perf_counter() - self.since, usage.ru_utime + usage.ru_stime)


def _told(command: Command) -> Path:
    """Where what it prints goes: the line's JSON object."""
    return command.log.with_name(f"{command.log.name}.json")


def _failure(command: Command, code: int) -> str:
    if code == 0:
        return ""
    try:
        error = json.loads(_told(command).read_bytes())["error"]
        text = f"{error['message']} {error['hint']}"
    except (ValueError, KeyError, TypeError):
        text = f"It ended with exit code {code}; see {command.log}."
    text = " ".join(text.split())
    return text if len(text) <= LONGEST_MESSAGE else f"{text[:LONGEST_MESSAGE]}…"


def _end(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """Politely, then for certain: a run's worker dies with it."""
    try:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        pass
    finally:
        for process in processes:
            process.kill()
            process.wait()
