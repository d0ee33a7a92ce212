"""Writes JSON for people and programs: indented, UTF-8, no NaN; the same bytes for the same value."""

from __future__ import annotations

import json
from pathlib import Path

from splatpipe.pipeline.engine.stage import JSON


def json_text(value: JSON) -> str:
    """A value as JSON text ending in a newline.

    Raises:
        ValueError: if a number is not finite, which JSON cannot represent.
    """
    return json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write_json(path: Path, value: JSON) -> None:
    """Write a value as JSON to a file in a stage's own folder (not atomically)."""
    path.write_text(json_text(value), encoding="utf-8")
