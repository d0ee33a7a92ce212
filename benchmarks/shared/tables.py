"""Print tables of figures on the terminal."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

Row = dict[str, Any]

PIPE_WIDTH = 200  # columns if the output is not a terminal


def console() -> Console:
    """Return the console of standard output."""
    return Console(width=PIPE_WIDTH if not sys.stdout.isatty() else None)


def print_table(title: str, rows: Sequence[Row], columns: Mapping[str, str]) -> None:
    """Print rows under headings, each with its value's ``key:format``; times with ``ms``, bytes ``MB``."""
    table = Table(title=title)
    for heading in columns:
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(*(_cell(row, spec) for spec in columns.values()))
    console().print(table)


def _cell(row: Row, spec: str) -> str:
    key, _, how = spec.partition(":")
    value = row.get(key)
    if value is None:
        return "-"
    if how == "ms":
        return f"{1e3 * value:.2f}"
    return f"{1e-6 * value:.0f}" if how == "MB" else escape(format(value, how))
