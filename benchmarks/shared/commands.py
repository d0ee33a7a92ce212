"""Run pipeline commands as subprocesses, a few at a time: what each used, how it ended, and no orphans."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.app.library.requests import IN_TURN_VARIABLE

POLL_S = 0.1  # far shorter than any run
GRACE_S = 10.0  # the pipeline ends within five seconds of a signal
HOME = Path(__file__).resolve().parents[1]
MAX_MESSAGE_LETTERS = 400  # characters of an error message that are reported; the log has the rest


@dataclass(frozen=True)
class Command:
    """A call of this Python interpreter.

    Attributes:
        name: Name to display.
        words: Arguments of the interpreter: a folder, script or module, and its arguments.
        log: File that receives its standard error.
    """

    name: str
    words: tuple[str, ...]
    log: Path


def splatpipe(name: str, arguments: Sequence[str], log: Path) -> Command:
    """Return a call of the pipeline whose error message is reported."""
    return Command(name, ("-m", "splatpipe.pipeline.app.cli.main", *arguments, "--json"), log)


def benchmark(name: str, *arguments: object) -> tuple[str, ...]:
    """Return the interpreter's arguments that run a benchmark by its name, as ``python benchmarks NAME`` does."""
    return (str(HOME), name, *map(str, arguments))


@dataclass(frozen=True)
class CommandEnd:
    """How a command ended.

    Attributes:
        command: The command.
        failure: Its error message; empty on success.
        wall_s: Wall-clock seconds since its start.
        cpu_s: CPU seconds of the process and all its descendants.
    """

    command: Command
    failure: str
    wall_s: float
    cpu_s: float


def run_all(commands: Sequence[Command], jobs: int) -> Iterator[CommandEnd]:
    """Run commands; if the generator is closed early, running ones are terminated.

    Args:
        commands: Commands, in the order in which they start.
        jobs: Maximum number of concurrent commands.

    Yields:
        How each command ended, in order of completion.
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
        environment = os.environ | {IN_TURN_VARIABLE: "1"}  # the time and memory of each stage are its own
        with command.log.open("wb") as log, _output_file(command).open("wb") as output:
            # In a session of its own: the terminal's Ctrl-C reaches only this process, which terminates the children.
            process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=log,
                env=environment,
                start_new_session=True,
            )
        return _Running(command, process, time.perf_counter())

    def poll(self) -> CommandEnd | None:
        """Return how the command ended, once; None while it is running."""
        pid, status, usage = os.wait4(self.process.pid, os.WNOHANG)
        if pid == 0:
            return None
        self.process.returncode = os.waitstatus_to_exitcode(status)
        failure = _failure(self.command, self.process.returncode)
        _output_file(self.command).unlink()
        return CommandEnd(self.command, failure, time.perf_counter() - self.since, usage.ru_utime + usage.ru_stime)


def _output_file(command: Command) -> Path:
    """Return the file for its standard output: the pipeline's JSON object."""
    return command.log.with_name(f"{command.log.name}.json")


def _failure(command: Command, code: int) -> str:
    if code == 0:
        return ""
    try:
        error = json.loads(_output_file(command).read_bytes())["error"]
        text = f"{error['message']} {error['hint']}"
    except (ValueError, KeyError, TypeError):
        text = f"It ended with exit code {code}; see {command.log}."
    text = " ".join(text.split())
    return text if len(text) <= MAX_MESSAGE_LETTERS else f"{text[:MAX_MESSAGE_LETTERS]}…"


def _end(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """Terminate the processes, first politely, then by force: a run's worker dies with it."""
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
