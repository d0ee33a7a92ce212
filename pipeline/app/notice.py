"""Tells a command of the user's that a run or a batch has ended.

What it needs stands in its environment, where no name of a capture can become a part of the command. What it does, and
whether it does it in time, changes nothing about the run.
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
TIME_LIMIT_S = 30.0  # a message to a server takes a second; the next capture or the shell waits for it
LONGEST = 8192  # characters of a command: far below what Linux takes as one argument, 128 KiB
SHELL = "/bin/sh"
STDERR = 2  # for what the command says: stdout is the JSON object's alone


def check_command(command: str) -> None:
    """Refuse what cannot be called, before hours are spent.

    Raises:
        UsageError: if it is empty or too long, or has a character that no command can have.
    """
    if not command.strip() or len(command) > LONGEST or "\0" in command:
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
        command: A line for the shell; it finds ``SPLATPIPE_STATE``, ``SPLATPIPE_CAPTURE``, ``SPLATPIPE_REPORT`` and
            ``SPLATPIPE_OUT`` in its environment, nothing on stdin, and writes to our stderr.
        state: How it ended.
        name: The capture's, or the batch's.
        report: Its page; None where there is none, and the variable is empty.
        out: The folder of results; that of the report by default.
        time_limit_s: After that it is ended, with all that it started.

    Returns:
        What went wrong with it, a sentence for the user without a word of the command, which may hold a secret; empty
        where nothing did.
    """
    folder = out or (report.parent if report is not None else None)
    told = {"STATE": state, "CAPTURE": name, "REPORT": str(report or ""), "OUT": str(folder or "")}
    environment = os.environ | {f"SPLATPIPE_{key}": value.replace("\0", "") for key, value in told.items()}
    try:
        process = subprocess.Popen(
            [SHELL, "-c", command],
            stdin=subprocess.DEVNULL,
            stdout=STDERR,
            env=environment,
            start_new_session=True,  # so that what it starts can be ended with it
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
    """End what is left of it; nothing where it has ended and left nobody behind."""
    with suppress(ProcessLookupError, PermissionError):
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    process.wait()
