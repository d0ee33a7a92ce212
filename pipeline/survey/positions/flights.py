"""Group photos into flights: photos that share a receiver's error because one aircraft took them in one go.

A receiver's error changes slowly, and each take-off resets its heights: positions of one flight agree with each other
far better than with another flight's. A flight ends where the aircraft (or the source of its positions) changes, where
no photo was taken for a long time, and where the take-off altitude jumps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.geometry.robust import MAD_TO_SIGMA

MIN_GAP_S = 180.0  # a battery change takes at least this long
GAP_INTERVALS = 20.0  # times the usual interval: manual capture at a photo a minute has longer pauses within a flight
TAKEOFF_STEP_M = 1.0  # smaller steps are barometer drift
TAKEOFF_NOISES = 6.0  # times the spread within a flight: noisy altitudes must not start new flights
MIN_PLATEAU = 3  # photos on each side needed to judge a step of the take-off altitude
CANDIDATES = 20  # steps between neighbours that are examined, the largest first
MAX_FLIGHTS = 1000  # flights of one device without a pause: more are implausible, and cost time


@dataclass(frozen=True)
class Stamp:
    """What identifies a photo's flight.

    Attributes:
        device: The aircraft or camera, the source of the position, a flight id: any difference is another flight.
        time_s: Capture time in seconds, from any epoch; NaN where unknown.
        takeoff_m: Take-off altitude: the photo's altitude less its height above take-off; NaN where unknown.
    """

    device: tuple[str, ...]
    time_s: float = math.nan
    takeoff_m: float = math.nan


def assign_flights(stamps: Sequence[Stamp]) -> list[int]:
    """The number of each photo's flight, counted from 0 in the order of the photos.

    Args:
        stamps: One per photo, in the order of their names; photos without a time join their device's first flight.
    """
    flights: list[list[int]] = []
    takeoffs = np.array([stamp.takeoff_m for stamp in stamps])
    devices: dict[tuple[str, ...], list[int]] = {}
    for index, stamp in enumerate(stamps):
        devices.setdefault(stamp.device, []).append(index)
    for members in devices.values():
        timed = [index for index in members if math.isfinite(stamps[index].time_s)]
        untimed = [index for index in members if not math.isfinite(stamps[index].time_s)]
        timed.sort(key=lambda index: stamps[index].time_s)
        runs = _split_at_gaps(timed, stamps) if timed else [[]]
        runs[0] += untimed
        flights += [flight for run in runs for flight in _split_at_steps(run, takeoffs)]
    flights.sort(key=min)
    number = {index: flight for flight, members in enumerate(flights) for index in members}
    return [number[index] for index in range(len(stamps))]


def _split_at_gaps(ordered: list[int], stamps: Sequence[Stamp]) -> list[list[int]]:
    times = np.array([stamps[index].time_s for index in ordered])
    gaps = np.diff(times)
    taken = gaps[gaps > 0.0]
    longest = max(MIN_GAP_S, GAP_INTERVALS * float(np.median(taken))) if len(taken) else MIN_GAP_S
    cuts = (np.flatnonzero(gaps > longest) + 1).tolist()
    return [ordered[start:end] for start, end in zip([0, *cuts], [*cuts, len(ordered)], strict=True)]


def _split_at_steps(run: list[int], takeoffs: Float64[np.ndarray, " n"]) -> list[list[int]]:
    """Cut repeatedly at the clearest step of the take-off altitude, while there is a significant one."""
    if not np.isfinite(takeoffs[run]).all():
        return [run]
    done: list[list[int]] = []
    left = [run]
    while left:
        part = left.pop()
        cut = _best_cut(takeoffs[part]) if len(done) + len(left) < MAX_FLIGHTS else 0
        if cut:
            left += [part[cut:], part[:cut]]
        else:
            done.append(part)
    return done


def _best_cut(values: Float64[np.ndarray, " n"]) -> int:
    """Index where two levels describe the altitudes best (least absolute deviations); 0 where one level suffices.

    Only the largest steps between neighbours are tried.
    """
    cuts = np.arange(MIN_PLATEAU, len(values) - MIN_PLATEAU + 1)
    largest = cuts[np.argsort(-np.abs(np.diff(values))[cuts - 1], kind="stable")[:CANDIDATES]]
    if len(largest) == 0:
        return 0
    cut = min(largest.tolist(), key=lambda at: _deviation(values[:at]) + _deviation(values[at:]))
    before, after = values[:cut], values[cut:]
    step = abs(float(np.median(after) - np.median(before)))
    noise = MAD_TO_SIGMA * max(float(np.median(np.abs(part - np.median(part)))) for part in (before, after))
    return cut if step > max(TAKEOFF_STEP_M, TAKEOFF_NOISES * noise) else 0


def _deviation(values: Float64[np.ndarray, " n"]) -> float:
    return float(np.abs(values - np.median(values)).sum())
