"""Flights: which photos share a receiver's error, since they were taken in one go by one aircraft.

A receiver's error changes slowly, and a take-off sets its heights anew: positions of one flight agree with each other
far better than with another flight's. A flight ends where the aircraft (or the source of its positions) is another
one, where no photo was taken for long, and where the take-off's altitude steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

LEAST_GAP_S = 180.0  # a battery is not changed faster
GAP_INTERVALS = 20.0  # who takes a photo a minute by hand pauses longer in a flight
TAKEOFF_STEP_M = 1.0  # less is the barometer's drift
TAKEOFF_NOISES = 6.0  # times the spread in a flight: receivers that write noisy altitudes do not start flights
LEAST_PLATEAU = 3  # photos that a step of the take-off's altitude is judged by, on each side
CANDIDATES = 20  # steps between neighbours that are looked at closer, the largest first
MOST_FLIGHTS = 1000  # of one device without a pause: more are nonsense, and cost time
MAD_TO_SIGMA = 1.4826  # of Gaussian noise


@dataclass(frozen=True)
class Stamp:
    """What tells a photo's flight.

    Attributes:
        device: The aircraft or camera, the source of the position, an id of the flight: another text, another flight.
        time_s: When it was taken, of any epoch; NaN where not known.
        takeoff_m: Altitude of the take-off: the photo's less its height above take-off; NaN where not known.
    """

    device: tuple[str, ...]
    time_s: float = math.nan
    takeoff_m: float = math.nan


def tell_flights(stamps: Sequence[Stamp]) -> list[int]:
    """The number of each photo's flight, counted from 0 in the order of the photos.

    Args:
        stamps: Of the photos, in the order of their names; photos without a time stay with their device's others.
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
    longest = max(LEAST_GAP_S, GAP_INTERVALS * float(np.median(taken))) if len(taken) else LEAST_GAP_S
    cuts = (np.flatnonzero(gaps > longest) + 1).tolist()
    return [ordered[start:end] for start, end in zip([0, *cuts], [*cuts, len(ordered)], strict=True)]


def _split_at_steps(run: list[int], takeoffs: Float64[np.ndarray, " n"]) -> list[list[int]]:
    """Cut where the median of the take-off's altitude before and after differs most, as long as it does by far."""
    if not np.isfinite(takeoffs[run]).all():
        return [run]
    done: list[list[int]] = []
    left = [run]
    while left:
        part = left.pop()
        cut = _best_cut(takeoffs[part]) if len(done) + len(left) < MOST_FLIGHTS else 0
        if cut:
            left += [part[cut:], part[:cut]]
        else:
            done.append(part)
    return done


def _best_cut(values: Float64[np.ndarray, " n"]) -> int:
    """Where two levels describe the altitudes best (least absolute deviations), 0 where one does.

    It is looked for where neighbours differ most.
    """
    cuts = np.arange(LEAST_PLATEAU, len(values) - LEAST_PLATEAU + 1)
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
