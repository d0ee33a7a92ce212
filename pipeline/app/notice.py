"""Calls a user's command when a run or a batch has ended.

Its input is passed in environment variables, so that no capture name can become part of the command. What it does, and
whether it finishes in time, does not affect the run.
"""

from __future__ import annotations

import os
import signal
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Literal

from splatpipe.pipeline.engine.errors import UsageError

State = Literal["done", "failed", "stopped"]
TIME_LIMIT_S = 30.0  # a message to a server takes a second, and the next capture or the shell waits for it
MAX_COMMAND_CHARS = 8192  # characters of a command: far below what Linux takes as one argument, 128 KiB
SHELL = "/bin/sh"
STDERR = 2  # for the command's output: stdout is reserved for the JSON object


def check_command(command: str) -> None:
    """Check the command before hours are spent.

    Raises:
        UsageError: if it is empty, too long, or contains a character that no command can.
    """
    if not command.strip() or len(command) > MAX_COMMAND_CHARS or "\0" in command:
        raise UsageError(
            "--notify has no command.",
            hint="Give a shell command, e.g. --notify 'mail -s \"$SPLATPIPE_CAPTURE: $SPLATPIPE_STATE\" me'.",
        )


def notify(
    command: str,
    state: State,
    name: str,
    report: Path | None,
    out: Path | None = None,
    time_limit_s: float = TIME_LIMIT_S,
) -> str:
    """Call the command and wait for it.

    Args:
        command: A shell command line; it gets ``SPLATPIPE_STATE``, ``SPLATPIPE_CAPTURE``, ``SPLATPIPE_REPORT`` and
            ``SPLATPIPE_OUT`` in its environment, nothing on stdin, and writes to our stderr.
        state: How the run or batch ended.
        name: The capture's or the batch's name.
        report: Its report page; None, and an empty variable, if there is none.
        out: The results folder; by default that of the report.
        time_limit_s: After this it is killed, with everything it started.

    Returns:
        What went wrong with it, in a sentence that does not quote the command, which may contain a secret; empty if
        nothing did.
    """
    folder = out or (report.parent if report is not None else None)
    values = {"STATE": state, "CAPTURE": name, "REPORT": str(report or ""), "OUT": str(folder or "")}
    environment = os.environ | {f"SPLATPIPE_{key}": value.replace("\0", "") for key, value in values.items()}
    try:
        process = subprocess.Popen(
            [SHELL, "-c", command],
            stdin=subprocess.DEVNULL,
            stdout=STDERR,
            env=environment,
            start_new_session=True,  # so that its child processes can be killed with it
        )
    except (OSError, ValueError) as error:
        return f"The --notify command could not be started: {getattr(error, 'strerror', None) or error}."
    try:
        code = process.wait(time_limit_s)
    except subprocess.TimeoutExpired:
        return f"The --notify command did not end within {time_limit_s:.0f} s and was killed."
    finally:
        _end(process)
    return f"The --notify command ended with exit code {code}." if code else ""


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill what is left of the process and its children, if anything."""
    with suppress(ProcessLookupError, PermissionError):
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    process.wait()
