"""Formats lengths, sizes, durations and counts with their units; a dash for missing values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, TypeGuard

NONE = "–"


def number(value: object, digits: int = 3) -> str:
    """A figure with a fixed number of digits after the point."""
    return f"{value:,.{digits}f}" if _finite(value) else NONE


def count(value: object) -> str:
    """An integer with thousands separators."""
    return f"{value:,.0f}" if _finite(value) else NONE


def metres(value: object) -> str:
    """A residual, to the millimetre."""
    return f"{round(value, 3) + 0.0:.3f}" if _finite(value) else NONE


def length(value: object) -> str:
    """A length in the most natural unit."""
    if not _finite(value):
        return NONE
    longest = abs(value)
    if longest < 0.01:
        return f"{value * 1000:.1f} mm"
    if longest < 1.0:
        return f"{value * 100:.1f} cm"
    return f"{value:.2f} m" if longest < 100.0 else f"{value:,.0f} m"


def two_digits(value: object) -> str:
    """A standard deviation or a bound, to two significant digits."""
    if not _finite(value):
        return NONE
    if abs(value) < 0.0995:
        return f"{100.0 * value:.2g} cm"
    return f"{value:.2g} m" if abs(value) < 99.5 else f"{value:,.0f} m"


def share(value: object, digits: int = 0) -> str:
    """A share as a percentage."""
    return f"{value:.{digits}%}".replace("%", " %") if _finite(value) else NONE


def duration(seconds: object) -> str:
    """A duration in seconds, minutes or hours."""
    if not _finite(seconds):
        return NONE
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def roughly(seconds: object) -> str:
    """A forecast duration, rounded to its accuracy."""
    if not _finite(seconds):
        return NONE
    minutes = seconds / 60
    if minutes < 90:
        return f"{max(1, round(minutes))} min"
    return f"{minutes / 60:.1f} h" if minutes < 570 else f"{minutes / 60:.0f} h"


def size(value: object) -> str:
    """A size in bytes, with decimal prefixes."""
    if not _finite(value):
        return NONE
    rest = float(value)
    for unit in ("B", "kB", "MB"):
        if rest < 1000:
            return f"{rest:.0f} B" if unit == "B" else f"{rest:.1f} {unit}"
        rest /= 1000
    return f"{rest:.2f} GB"


def moment(seconds: object) -> str:
    """A point in time, UTC."""
    try:
        return f"{datetime.fromtimestamp(float(str(seconds)), UTC):%Y-%m-%d %H:%M UTC}"
    except (TypeError, ValueError, OverflowError, OSError):
        return NONE


def local_moment(seconds: float) -> str:
    """A point in time in this machine's time zone, with the zone."""
    try:
        return f"{datetime.fromtimestamp(seconds).astimezone():%Y-%m-%d %H:%M %Z}"
    except (OverflowError, OSError, ValueError):
        return "at an unknown time"


def interval(bounds: object) -> str:
    """The 95 % confidence interval."""
    if not isinstance(bounds, list | tuple) or len(bounds) != 2:
        return NONE
    return f"{metres(bounds[0])} to {metres(bounds[1])}"


def plural(amount: int, one: str) -> str:
    """``1 photo``, ``2 photos``."""
    return f"{amount:,} {one if amount == 1 else one + 's'}"


def judged_of(judged: int, held_out: int, one: str) -> str:
    """``37 photos``, or ``8 of 37 photos`` if only some of those held out were judged."""
    return plural(judged, one) if judged >= held_out else f"{judged:,} of {plural(held_out, one)}"


def judged_size(metrics: Mapping[str, Any]) -> str:
    """Megapixels at which held-out photos were evaluated; empty if unknown, as in runs of earlier versions."""
    judged = metrics.get("judged_megapixels")
    return "" if judged is None else number(judged, 1 if judged >= 1.0 else 2)


def _finite(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
