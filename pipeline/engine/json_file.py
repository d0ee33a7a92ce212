"""JSON as splatpipe writes it for people and programs: indented, UTF-8, no NaN; the same bytes for the same value."""

from __future__ import annotations

import json
from pathlib import Path

from splatpipe.pipeline.engine.stage import JSON


def json_text(value: JSON) -> str:
    """A value as text that ends with a line's end.

    Raises:
        ValueError: if a number is not finite: JSON has none.
    """
    return json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write_json(path: Path, value: JSON) -> None:
    """Write a value into a file of a stage's own folder."""
    path.write_text(json_text(value), encoding="utf-8")
