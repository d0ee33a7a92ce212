"""The way from photo to photo of a flight: how fast it is, and whether it leads where the aircraft's nose points."""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Complex128, Float64, Int64

from splatpipe.pipeline.photos.files.photo_list import Photo

MIN_STEPS = 6  # fewer agree by chance
MIN_STEP_M = 3.0  # receivers err by less from one photo to the next
STEADY_COSINE = math.cos(math.radians(20.0))  # between the headings at both ends of a straight step: no turn in between
ALIGNED, SCATTERED = 0.9, 0.7  # length of the mean of headings' differences as unit vectors: they agree, or do not
AHEAD_RAD, ASKEW_RAD, BACKWARDS_RAD = (math.radians(angle) for angle in (45.0, 75.0, 110.0))  # sideways is 90°
Relation = Literal["same", "ahead", "askew", "backwards", "mirrored"]


@dataclass(frozen=True)
class FlightSteps:
    """Pairs of photos that were taken one after the other by one camera in one flight.

    Attributes:
        first: Indices of the earlier photos.
        second: Of the later ones.
        seconds: Time between them, more than 0.
    """

    first: Int64[np.ndarray, " n"]
    second: Int64[np.ndarray, " n"]
    seconds: Float64[np.ndarray, " n"]


def seconds_of(time: str | None) -> float:
    """Seconds, from any epoch, of a capture time (ISO 8601); NaN where it is unknown."""
    try:
        return datetime.datetime.fromisoformat(time or "").replace(tzinfo=datetime.UTC).timestamp()
    except ValueError:
        return math.nan


def steps_of(
    names: Sequence[str], records: Mapping[str, Mapping[str, Any]], photos: Mapping[str, Photo]
) -> FlightSteps:
    """The steps between photos.

    Args:
        names: The photos that indices count.
        records: Their positions' records, for the number of the flight.
        photos: The capture's photos by name, for camera and time.
    """
    by_flight: dict[tuple[int, int], list[tuple[float, int]]] = {}
    for index, name in enumerate(names):
        photo = photos.get(name)
        time = seconds_of(None if photo is None else photo.time)
        if photo is not None and math.isfinite(time):
            flight = int(records.get(name, {}).get("flight", 0))
            by_flight.setdefault((flight, photo.camera), []).append((time, index))
    found = [
        (one[1], other[1], other[0] - one[0])
        for taken in by_flight.values()
        for one, other in zip(sorted(taken), sorted(taken)[1:], strict=False)
        if other[0] > one[0]
    ]
    first, second, seconds = zip(*found, strict=True) if found else ((), (), ())
    return FlightSteps(np.array(first, np.int64), np.array(second, np.int64), np.array(seconds, np.float64))


def heading_vectors(yaw_deg: Float64[np.ndarray, " n"]) -> Complex128[np.ndarray, " n"]:
    """Unit vectors, east + i north, of headings clockwise from north."""
    return np.asarray(1j * np.exp(-1j * np.radians(yaw_deg)))


def relation_of(
    found: Complex128[np.ndarray, " n"], stated: Complex128[np.ndarray, " n"]
) -> tuple[Relation | None, float]:
    """How directions relate to stated ones, and by what angle (radians, counter-clockwise) they are turned.

    Directions that differ turn the same way as the stated ones (``same``), or the other way (``mirrored``). Strips to
    and fro in two opposite directions do either; then only the angle is known: ``ahead``, ``askew`` (mirrored strips
    are turned by twice their heading; wind is not on the same side of both directions), ``backwards``. None where there
    is no relation, or one direction only, or sideways.

    Args:
        found: Unit vectors, east + i north.
        stated: The same.
    """
    if len(found) == 0:
        return None, 0.0
    turn, sum_ = (found * stated.conj()).mean(), (found * stated).mean()
    same, mirrored, angle = abs(turn), abs(sum_), float(np.angle(turn))
    if mirrored >= ALIGNED and same <= SCATTERED:
        return "mirrored", 0.0
    if same < ALIGNED:
        return None, 0.0
    if mirrored <= SCATTERED:
        return "same", angle
    if abs(stated.mean()) >= ALIGNED:  # one direction, in which one may as well fly backwards
        return None, angle
    if abs(angle) >= BACKWARDS_RAD:
        return "backwards", angle
    if abs(angle) <= AHEAD_RAD:
        return "ahead", angle
    return ("askew" if abs(angle) <= ASKEW_RAD else None), angle


def flying_relation(
    places: Float64[np.ndarray, "n 3"], yaw_deg: Float64[np.ndarray, " n"], steps: FlightSteps
) -> tuple[Relation | None, float]:
    """How the direction of flight relates to where the camera or the aircraft heads, as ``relation_of``.

    Args:
        places: East, north, up of the photos, metres; NaN where unknown.
        yaw_deg: Their headings; NaN where unknown.
        steps: Between them.
    """
    way = (places[steps.second] - places[steps.first])[:, :2] @ np.array([1.0, 1.0j])
    before, after = heading_vectors(yaw_deg[steps.first]), heading_vectors(yaw_deg[steps.second])
    with np.errstate(invalid="ignore"):
        good = (np.abs(way) >= MIN_STEP_M) & ((before * after.conj()).real >= STEADY_COSINE)
    if good.sum() < MIN_STEPS:
        return None, 0.0
    middle = before[good] + after[good]
    return relation_of(way[good] / np.abs(way[good]), middle / np.abs(middle))
