"""Reads and writes JSON for people and programs: indented, UTF-8, no NaN; the same bytes for the same value."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.engine.files.small_file import read_small

if TYPE_CHECKING:  # it imports pydantic
    from splatpipe.pipeline.engine.stage import JSON

MAX_JSON_BYTES = 128 << 20  # the pairs of 100,000 photos are smaller
MAX_VALUES = 10_000_000  # those pairs are 8 million; a value takes up to 100 bytes, and three of the file's (`{},`)
TOO_MANY_DIGITS = re.compile(rb"(?<![0-9])[0-9]{300}")  # neither a number that a float can hold nor a name
STRIDE, IN_A_ROW = 30, re.compile(rb"[0-9]{10}")  # of 300 digits, every 30th is 10: seen sooner in much text


def json_text(value: JSON) -> str:
    """A value as JSON text ending in a newline.

    Raises:
        ValueError: if a number is not finite, which JSON cannot represent.
    """
    return json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write_json(path: Path, value: JSON) -> None:
    """Write a value as JSON to a file in a stage's own folder (not atomically)."""
    write_file(path, json_text(value))


def parse_json(data: bytes) -> Any:
    """The value of JSON text in UTF-8.

    Raises:
        ValueError: if it is not JSON, is nested too deeply, has too many values, or a number that no float can hold.
    """
    if sum(map(data.count, (b",", b"[", b"{"))) > MAX_VALUES:
        raise ValueError(f"it has more than {MAX_VALUES:,} values")
    if IN_A_ROW.search(data[::STRIDE]) and TOO_MANY_DIGITS.search(data):
        raise ValueError("it has a number of 300 digits or more")
    try:
        return json.loads(data.decode("utf-8"))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def read_json(path: Path, max_bytes: int = MAX_JSON_BYTES) -> Any:
    """Read a JSON file, which need not be one of ours.

    Args:
        path: The file.
        max_bytes: The most it may have.

    Raises:
        OSError: if it cannot be read, is not a regular file, or is larger.
        ValueError: as ``parse_json``.
    """
    return parse_json(read_small(path, max_bytes))
