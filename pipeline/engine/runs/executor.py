"""Runs tasks in a worker process: starts and ends it, forwards its events, and explains crashes."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import IO

from splatpipe.pipeline.engine.errors import ERRORS, EXIT_TERMINATED, MachineError, StageError, StopSignal
from splatpipe.pipeline.engine.events import Event, Sink
from splatpipe.pipeline.engine.files.output_file import appended_file
from splatpipe.pipeline.engine.python_module import python_module
from splatpipe.pipeline.engine.runs.peak_memory import peak_memory_of
from splatpipe.pipeline.engine.runs.worker import Task
from splatpipe.pipeline.engine.stage import JSON

GRACE_S = 3.0  # training writes its checkpoint in less; Ctrl-C promises an end within five seconds


class KilledError(StageError):
    """The worker was killed: for want of memory, or by hand."""


class Executor:
    """A worker process, started for the first task and kept for later ones.

    Args:
        log: File for what libraries print.
        locks: Descriptors of the locks of the OUT and of a shard, inherited so that they last as long as the worker.
        environment: Additional environment variables for the worker (threads of the numeric libraries).
        niceness: How far it stands back behind other processes (``os.nice``); 0: not at all.
    """

    def __init__(self, log: Path, locks: tuple[int, ...], environment: Mapping[str, str], niceness: int = 0) -> None:
        self._log = log
        self._locks = locks
        self._environment = {**os.environ, **environment}
        self._niceness = niceness
        self._process: subprocess.Popen[str] | None = None
        self._asked_s: float | None = None  # when it was asked to end

    def start(self) -> None:
        """Start the worker, if there is none yet. To the kernel, the thread that does is its parent: it dies with it.

        Raises:
            MachineError: if no process can be started.
        """
        self._running_worker()

    def run(self, task: Task, sink: Sink) -> dict[str, JSON]:
        """Run one task to completion.

        Args:
            task: The stage to run.
            sink: Receives its events.

        Returns:
            ``summary``, ``seconds``, ``cpu_seconds``, ``peak_memory_bytes``.

        Raises:
            SplatpipeError: what the body raised, or a StageError if the worker died.
        """
        process = self._running_worker()
        assert process.stdin is not None and process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # a worker that died on startup is explained below
            process.stdin.write(json.dumps({"task": asdict(task)}) + "\n")
            process.stdin.flush()
        for line in process.stdout:
            if not line.endswith("\n"):
                break  # it died in the middle of a message
            message = json.loads(line)
            if "event" in message:
                sink(Event(**message["event"]))
            elif "done" in message:
                result: dict[str, JSON] = message["done"]
                return result
            else:
                self._raise(message["failed"])
        code = process.wait()
        self._process = None
        _close(process)
        kind = KilledError if code == -signal.SIGKILL else StageError
        raise kind(
            f"The stage {task.stage} {_cause(code)}.",
            hint=f"{_remedy(code)} See the end of the log: {self._log}",
        )

    def peak_memory_bytes(self) -> int | None:
        """Peak resident memory of the worker in its current stage, bytes; None if it is dead or this is unknown."""
        return None if self._process is None else peak_memory_of(self._process.pid)

    def resident_bytes(self) -> int:
        """Resident memory of the worker now, bytes; 0 if there is none or this is unknown."""
        process = self._process
        with contextlib.suppress(OSError, ValueError, IndexError):
            if process is not None:
                pages = Path(f"/proc/{process.pid}/statm").read_text(encoding="ascii").split()[1]
                return int(pages) * os.sysconf("SC_PAGE_SIZE")
        return 0

    def ask_to_end(self) -> None:
        """Ask the worker to terminate, once: a second time would interrupt the writing of its checkpoint."""
        process = self._process
        if process is not None and self._asked_s is None:
            self._asked_s = time.monotonic()
            process.terminate()

    def stop(self) -> None:
        """End the worker: ask it to terminate, and kill it ``GRACE_S`` after it was asked."""
        process = self._process
        if process is None:
            return
        try:
            self.ask_to_end()
            process.wait(max(0.0, (self._asked_s or 0.0) + GRACE_S - time.monotonic()))
        except BaseException as error:
            process.kill()
            process.wait()
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
        finally:
            self._process = None
            _close(process)

    def close(self) -> None:
        """Shut down an idle worker."""
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write('{"exit": true}\n')
            process.stdin.flush()
        try:
            process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        _close(process)

    def _running_worker(self) -> subprocess.Popen[str]:
        if self._process is None:
            with appended_file(self._log) as log:
                self._process, self._asked_s = self._spawn(log), None
        return self._process

    def _spawn(self, log: IO[bytes]) -> subprocess.Popen[str]:
        try:
            return subprocess.Popen(
                python_module(
                    "splatpipe.pipeline.engine.runs.worker",
                    str(os.getpid()),
                    *([str(self._niceness)] if self._niceness else []),
                ),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                encoding="utf-8",
                env=self._environment,
                pass_fds=self._locks,
            )
        except OSError as error:
            raise MachineError(
                f"No worker process could be started: {error.strerror}.",
                hint="Check for limits on processes or memory (ulimit -u, a container's pids limit).",
            ) from error

    def _raise(self, failure: Mapping[str, str]) -> None:
        if failure["type"] == "KeyboardInterrupt":
            raise StopSignal(EXIT_TERMINATED)  # somebody terminated only the worker
        raise ERRORS[failure["type"]](failure["message"], failure["hint"])


def stop_all(executors: Iterable[Executor]) -> None:
    """End several workers within the time of one."""
    each = list(executors)
    try:
        for executor in each:
            executor.ask_to_end()
    finally:
        _stop_each(each)


def _stop_each(executors: list[Executor]) -> None:
    """Stop one after the other, the later ones even if an earlier one is interrupted."""
    if executors:
        try:
            executors[0].stop()
        finally:
            _stop_each(executors[1:])


def _close(process: subprocess.Popen[str]) -> None:
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(BrokenPipeError):
                pipe.close()


def _cause(code: int) -> str:
    if code >= 0:
        return f"crashed (exit code {code})"
    try:
        return f"was killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"was killed by signal {-code}"


def _remedy(code: int) -> str:
    if code == -signal.SIGKILL:
        return "The system may have run out of memory: close other programs, or choose a smaller preset."
    return "Finished work is kept; run again, and if it crashes again, please report it."
