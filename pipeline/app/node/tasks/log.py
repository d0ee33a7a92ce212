"""The log of a task, as clients read it line by line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splatpipe.pipeline.engine.files.small_file import read_end
from splatpipe.pipeline.engine.files.text_lines import text_lines

MAX_LOG_BYTES = 8 << 20  # the end of a longer log is kept: a training of a day prints some hundred kilobytes
WORD = "error"  # a line that is only this is taken for a failure by PyODM


def log_lines(notes: Sequence[str], output: Path) -> list[str]:
    """The lines of a task's log; what cannot be read is left out.

    Args:
        notes: The node's own lines.
        output: What the run printed.
    """
    try:
        text = read_end(output, MAX_LOG_BYTES).decode("utf-8", "replace")
    except OSError:
        text = ""
    return [*notes, *(f"{line}." if line.strip() == WORD else line.rstrip() for line in text_lines(text))]


def last_line(output: Path) -> str:
    """The last line that says something; empty if there is none."""
    lines = [line for line in log_lines((), output) if line.strip()]
    return lines[-1].strip() if lines else ""
