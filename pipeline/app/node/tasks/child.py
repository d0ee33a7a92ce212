"""Processes of the node: each in a group of its own, which ends with the node, and ends whole."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType

from splatpipe.pipeline.app.node.tasks.under_parent import MODULE
from splatpipe.pipeline.engine.files.output_file import appended_file
from splatpipe.pipeline.engine.python_module import python_module

GRACE_S = 5.0  # a run writes its checkpoint and its report in less
POLL_S = 0.05
# Numeric libraries of one run and of others beside it share the machine: each run is told its threads.
ENVIRONMENT = {"PYTHONUNBUFFERED": "1", "NO_COLOR": "1", "COLUMNS": "200"}


class Child:
    """A process and those that it starts.

    The thread that makes it must live as long as the node: to the kernel, a thread that ends is a parent that dies.

    Args:
        module: Module of ours to run.
        arguments: Its arguments.
        log: File that receives what it prints to stderr; what it prints to stdout if there is no ``answer``.
        answer: File that receives what it prints to stdout.
        environment: Further environment variables.
    """

    def __init__(
        self,
        module: str,
        arguments: Sequence[str],
        log: Path,
        answer: Path | None = None,
        environment: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        command = python_module(MODULE, str(os.getpid()), module, *arguments)
        if answer is not None:
            answer.unlink(missing_ok=True)
        with appended_file(log) as errors, appended_file(answer or log) as output:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=errors,
                env={**os.environ, **ENVIRONMENT, **environment},
                start_new_session=True,
            )
        self.began_s = time.monotonic()
        self._is_gone = False  # from then on, the group's ID may be another's

    @property
    def group(self) -> int:
        """The process group's ID."""
        return self._process.pid

    def poll(self) -> int | None:
        """The exit code; negative if it was killed by a signal, None while it is running."""
        code = self._process.poll()
        if code is not None:
            self._kill_rest()
        return code

    def end(self) -> None:
        """End the group: ask it to stop, and kill what is left after ``GRACE_S``."""
        self.ask_to_end()
        self.wait_or_kill(time.monotonic() + GRACE_S)

    def ask_to_end(self) -> None:
        """Send SIGTERM to the group."""
        if not self._is_gone:
            self._signal(signal.SIGTERM)

    def wait_or_kill(self, until_s: float) -> None:
        """Wait for the group's end until a time of ``time.monotonic``; then kill it."""
        while self._process.poll() is None and time.monotonic() < until_s:
            time.sleep(POLL_S)
        self._kill_rest()
        self._process.wait()

    def _kill_rest(self) -> None:
        """Kill what is left of the group, once: its ID is free as soon as its last process is gone."""
        if not self._is_gone:
            self._is_gone = True
            self._signal(signal.SIGKILL)

    def _signal(self, number: signal.Signals) -> None:
        with suppress(ProcessLookupError, PermissionError):  # macOS: a group of zombies is not permitted
            os.killpg(self.group, number)
