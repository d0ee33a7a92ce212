"""A server's process that announces its address on its standard error."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping

from timeouts import TIMEOUT_S


@contextlib.contextmanager
def announced(
    pattern: re.Pattern[str], *arguments: object, environment: Mapping[str, str] | None = None
) -> Iterator[tuple[re.Match[str], subprocess.Popen[str]]]:
    """Run ``splatpipe ARGUMENTS`` while the context lasts, and end it as Ctrl-C does.

    Args:
        pattern: What its announcement looks like; the context begins when it is printed.
        arguments: Subcommand and options.
        environment: More environment variables.

    Yields:
        What the pattern found, and the process.
    """
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", *map(str, arguments)]
    env = {**os.environ, **(environment or {})}
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env)
    try:
        assert process.stderr is not None
        output = ""
        for line in process.stderr:
            output += line
            if found := pattern.search(line):
                yield found, process
                break
        else:
            raise AssertionError(output)
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=TIMEOUT_S)
        finally:
            process.kill()  # no effect if it has ended
