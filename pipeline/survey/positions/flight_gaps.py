"""Find missing photos along a flight: gaps in an otherwise straight path where several photos should have been."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.survey.positions.swapped_positions import PositionEvidence

MIN_PHOTOS = 6
LONG_STEP, LONG_PAUSE = 2.2, 2.5  # times the usual ones: at least two photos are missing
BY_NUMBER_PAUSE = 2.2  # suffices where numbers are missing, too
MIN_NUMBERS = 2  # missing, to report a gap
REGULAR_SHARE = 0.8  # share of names that increase by one, above which a skipped number is evidence
SPEED_RATIOS = (0.5, 2.0)  # bounds over the usual speed: slower is a pause, faster means that times are wrong
LONGEST_TURN = 1.3  # times the longest step between two flight lines elsewhere: no turn is as long
TURN_STEP = 1.5  # times the usual step: a longer one leads to the next flight line
AHEAD = 0.1  # cosine between the path before, the gap, and the path after: an orbit turns by as much in four photos
WINDOW = 8  # steps before and after that define what is usual
FURTHEST_MISSING = 50  # photos; a larger gap is another flight


@dataclass(frozen=True)
class MissingStrip:
    """A run of missing photos.

    Attributes:
        before: Index of the photo taken before them.
        after: Index of the photo taken after them.
        missing: Estimated number of missing photos.
        apart_m: Distance between the two; NaN without positions.
        usual_m: Distance between photos elsewhere.
        numbers: Whether their numbers are missing in the names, too.
    """

    before: int
    after: int
    missing: int
    apart_m: float
    usual_m: float
    numbers: bool


def find_missing(names: Sequence[str], flight: PositionEvidence) -> list[MissingStrip]:
    """Find gaps along the flight path.

    Args:
        names: The photos' names.
        flight: Their positions and times.
    """
    order = flight.order()
    numbers = _numbers(names)
    if len(order) < max(MIN_PHOTOS, len(names) // 2):
        return _by_numbers(names, numbers, flight)
    way, times = flight.places_m[order], flight.times_s[order]
    steps, pauses = np.linalg.norm(np.diff(way, axis=0), axis=1), np.diff(times)
    found = []
    for k in range(len(steps)):
        around = [at for at in range(max(0, k - WINDOW), min(len(steps), k + WINDOW + 1)) if at != k]
        usual, pause = float(np.median(steps[around])), float(np.median(pauses[around]))
        if usual <= 0.0 or pause <= 0.0:
            continue
        skipped = 0
        if numbers is not None:
            skipped = numbers[int(order[k + 1])] - numbers[int(order[k])] - 1
        by_number = MIN_NUMBERS <= skipped <= FURTHEST_MISSING
        missing = skipped if by_number else round(float(pauses[k]) / pause) - 1
        is_gap = by_number and pauses[k] > BY_NUMBER_PAUSE * pause
        leads_on = _goes_on(way, k, usual) or steps[k] > max(LONG_STEP * usual, LONGEST_TURN * _other_turns(steps, k))
        is_gap |= leads_on and _as_fast(steps[k] / pauses[k], usual / pause, pauses[k] / pause)
        if is_gap and 2 <= missing <= FURTHEST_MISSING:
            pair = int(order[k]), int(order[k + 1])
            found.append(MissingStrip(*pair, int(missing), float(steps[k]), usual, by_number))
    return found


def _goes_on(way: Float64[np.ndarray, "m 3"], k: int, usual_m: float) -> bool:
    """Whether the path keeps its direction before, across and after the gap, and the gap is long."""
    across = way[k + 1] - way[k]
    length = float(np.linalg.norm(across))
    if length < LONG_STEP * usual_m or not 0 < k < len(way) - 2:
        return False
    before, after = way[k] - way[k - 1], way[k + 2] - way[k + 1]
    return all(float(leg @ across) > AHEAD * length * float(np.linalg.norm(leg)) for leg in (before, after))


def _other_turns(steps: Float64[np.ndarray, " m"], k: int) -> float:
    """The longest step elsewhere that leads to another flight line; infinite where there is none."""
    others = np.delete(steps, k)
    turns = others[others > TURN_STEP * float(np.median(others))]
    return float(turns.max()) if len(turns) else float("inf")


def _as_fast(speed: float, usual: float, pauses: float) -> bool:
    return bool(SPEED_RATIOS[0] * usual < speed < SPEED_RATIOS[1] * usual and pauses > LONG_PAUSE)


def _by_numbers(names: Sequence[str], numbers: Sequence[int] | None, flight: PositionEvidence) -> list[MissingStrip]:
    """Gaps without positions: skipped numbers where the photos on both sides have few matches."""
    if numbers is None or len(names) < MIN_PHOTOS:
        return []
    beside = [flight.matches.get((k, k + 1), 0) for k in range(len(names) - 1)]
    usual = float(np.median(beside))
    found = []
    for k, count in enumerate(beside):
        skipped = numbers[k + 1] - numbers[k] - 1
        if MIN_NUMBERS <= skipped <= FURTHEST_MISSING and count < usual / 2.0:
            found.append(MissingStrip(k, k + 1, skipped, float("nan"), float("nan"), True))
    return found


def _numbers(names: Sequence[str]) -> list[int] | None:
    """The last number in each name; None unless most numbers increase by one."""
    found = [re.search(r"(\d{2,9})\D*$", name.rpartition(".")[0] or name) for name in names]
    if any(match is None for match in found):
        return None
    numbers = [int(match.group(1)) for match in found if match is not None]
    steps = np.diff(numbers)
    return numbers if len(steps) and float(np.mean(steps == 1)) >= REGULAR_SHARE else None
