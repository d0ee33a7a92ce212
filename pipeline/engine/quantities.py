"""Parses quantities as written on a command line: `1h30m`, `8G`, `2cm`."""

from __future__ import annotations

import math
import re

from splatpipe.pipeline.engine.errors import UsageError

MAX_TEXT_CHARACTERS = 24  # characters: longer than any quantity that makes sense

_NUMBER = r"[0-9]+(?:\.[0-9]+)?"
_DURATION = re.compile(rf"(?:({_NUMBER})h)?(?:({_NUMBER})m)?(?:({_NUMBER})s)?")
_SECONDS = (3600.0, 60.0, 1.0)
_BYTES = re.compile(rf"({_NUMBER})([MGT])B?")
_LENGTH = re.compile(rf"({_NUMBER}) ?(mm|cm|m)")
_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_UNITS = {"M": 10**6, "G": 10**9, "T": 10**12}


def parse_duration(text: str, option: str) -> float:
    """Parse a duration such as `90s`, `10m`, `1h30m` or `1.5h`; returns seconds.

    Args:
        text: What the user wrote.
        option: The option's name, for the message.

    Raises:
        UsageError: if it is anything else, or zero.
    """
    match = _DURATION.fullmatch(text.strip()) if len(text) <= MAX_TEXT_CHARACTERS else None
    parts = match.groups(default="0") if match else ()
    seconds = sum(float(part) * unit for part, unit in zip(parts, _SECONDS, strict=False))
    if not 0.0 < seconds < math.inf:
        raise UsageError(
            f'Cannot understand {option} "{text[:MAX_TEXT_CHARACTERS]}".',
            hint=f"Write it with its units, largest first: {option} 90s, 10m or 1h30m.",
        )
    return seconds


def parse_bytes(text: str, option: str) -> int:
    """Parse a size such as `512M`, `8G` or `1.5T`; returns bytes. Units are decimal, the smaller interpretation.

    Args:
        text: What the user wrote.
        option: The option's name, for the message.

    Raises:
        UsageError: if it is anything else, or zero.
    """
    match = _BYTES.fullmatch(text.strip()) if len(text) <= MAX_TEXT_CHARACTERS else None
    number = int(float(match[1]) * _UNITS[match[2]]) if match else 0
    if number <= 0:
        raise UsageError(
            f'Cannot understand {option} "{text[:MAX_TEXT_CHARACTERS]}".',
            hint=f"Write it with its unit: {option} 512M or 8G.",
        )
    return number


def parse_length(text: str, option: str) -> float:
    """Parse a length such as `2cm`, `25mm` or `0.1m`; returns metres.

    Args:
        text: What the user wrote.
        option: The option's name, for the message.

    Raises:
        UsageError: if it is anything else, or zero.
    """
    match = _LENGTH.fullmatch(text.strip()) if len(text) <= MAX_TEXT_CHARACTERS else None
    metres = float(match[1]) * _METRES[match[2]] if match else 0.0
    if not 0.0 < metres < math.inf:
        raise UsageError(
            f'Cannot understand {option} "{text[:MAX_TEXT_CHARACTERS]}".',
            hint=f"Write it with its unit: {option} 2cm, 25mm or 0.1m.",
        )
    return round(metres, 9)
