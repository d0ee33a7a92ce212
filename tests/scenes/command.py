"""The command line, called in this process: as complete as a process of its own, without the seconds of its imports."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest

from splatpipe.pipeline.app import report
from splatpipe.pipeline.app.cli.main import main

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def splatpipe(*arguments: object, cwd: Path | None = None) -> CompletedProcess[str]:
    """Run ``splatpipe`` with these arguments; return its exit code and what it printed."""
    stdout, stderr = io.StringIO(), io.StringIO()
    words = ["splatpipe", *map(str, arguments)]
    with _called(words, cwd), contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
        try:
            main()
        except SystemExit as end:
            code = end.code
    return CompletedProcess(words, int(code or 0), stdout.getvalue(), stderr.getvalue())


def answered(*arguments: object) -> dict[str, Any]:
    """Run ``splatpipe … --json``, which has to succeed; return the object that it printed."""
    done = splatpipe(*arguments, "--json")
    assert done.returncode == 0, done.stderr
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def ran(answer: dict[str, Any]) -> list[str]:
    """Return the names of the stages that a command ran, in order; others were reused."""
    return [stage["name"] for stage in answer["stages"] if stage["state"] == "ran"]


@contextlib.contextmanager
def plain_reports() -> Iterator[None]:
    """Let commands write their reports without pictures and in this process: for tests that do not look at them."""

    def plain(out: Path, log: Path, *, until_s: float | None = None, anew: bool = False) -> Path:
        return report.write_report(out, drawn=False)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "make_report", plain)
        yield


@contextlib.contextmanager
def _called(words: list[str], cwd: Path | None) -> Iterator[None]:
    """Set what a process of its own would have, and restore what the command changes for all of a process."""
    arguments, folder, handlers = sys.argv, Path.cwd(), {number: signal.getsignal(number) for number in SIGNALS}
    sys.argv = words
    if cwd is not None:
        os.chdir(cwd)
    try:
        yield
    finally:
        sys.argv = arguments
        os.chdir(folder)
        for number, handler in handlers.items():
            signal.signal(number, handler)
