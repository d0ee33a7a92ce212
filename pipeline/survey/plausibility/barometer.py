"""Climbs by the drone's barometer, against which altitudes and a placed model are held: the sign and the unit show.

Heights above take-off know neither the sea nor the ground, but a climb of 10 m is one of 10 m.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.survey.crs.readings import MIN_WITNESSES, Evidence, Reading, plausible
from splatpipe.pipeline.survey.placing.up_witnesses import values_of
from splatpipe.pipeline.survey.positions.position_sources import is_altitude

STATED = ("file", "exif", "xmp")  # sources of altitudes; others are the heights above take-off, or the model's own
CLIMB_M = 5.0  # spread of the heights above take-off that tells a scale: five times the barometer's error
MAX_CLIMB_RATIO = 1.5  # ratio of climbs, either way, that is sound: barometers drift by metres, not by halves
CLIMB_SIGMAS = 5.0  # the ratio's least difference from 1: altitudes of poor receivers climb by chance
CAUSE_RATIO = 1.25  # a ratio within this of a cause's is that cause's
MIN_FLIGHTS = 3
MAX_MISFIT_RATIO = 0.6  # misfit by a cause over that as stated: at most
SIGN = Reading(
    "they are above the sea instead of below it",
    "Correct EXIF's GPSAltitudeRef or the sign in the file of positions; or give better altitudes in geo.txt.",
)
FEET = Reading("they are in feet", "Convert them to metres, or name a CRS whose heights are in feet.")
METRES = Reading("they are in metres and read as feet", "Name a CRS whose heights are in metres, or convert them.")
CAUSES = ((-1.0, SIGN), (1.0 / 0.3048, FEET), (0.3048, METRES))


def climb_ratio(
    heights_m: Float64[np.ndarray, " n"], above_m: Float64[np.ndarray, " n"], flights: Float64[np.ndarray, " n"]
) -> float | None:
    """How far heights climb where the drone climbs by 1, if that contradicts; None if it agrees or is unknown.

    Args:
        heights_m: Heights to be tested; NaN where unknown.
        above_m: Heights above take-off, likewise.
        flights: Number of each photo's flight: each may start elsewhere, and be off by a constant.
    """
    ours, theirs = _climbs(heights_m, above_m, flights)
    if len(ours) < MIN_WITNESSES or float(theirs.std()) < CLIMB_M:
        return None
    spread = float(theirs @ theirs)
    ratio = float(ours @ theirs) / spread
    sigma = float(np.linalg.norm(ours - ratio * theirs)) / math.sqrt(len(ours) * spread)
    sound = 1.0 / MAX_CLIMB_RATIO <= ratio <= MAX_CLIMB_RATIO or abs(ratio - 1.0) <= CLIMB_SIGMAS * sigma
    return None if sound else ratio


def climb_sentence(ratio: float, what: str) -> str:
    """Say it; ``what`` climbs, in the singular."""
    way = "climbs" if ratio >= 0.0 else "falls"
    drone = "Where the drone climbs by 10 m according to its heights above take-off"
    return f"{drone}, {what} {way} by {10.0 * abs(ratio):.1f} m"


def altitude_climbs(records: Sequence[Mapping[str, Any]]) -> tuple[str, str] | None:
    """What contradicts the drone's climbs in stated altitudes, and what to check, as sentences; None if nothing.

    Args:
        records: The photos' positions.
    """
    stated = [record if record.get("altitude_source") in STATED else {} for record in records]
    heights, above = values_of(stated, "altitude_m"), values_of(records, "relative_altitude_m")
    flights = np.nan_to_num(values_of(records, "flight"))
    ratio = climb_ratio(heights, above, flights)
    between = ratio is None and len(np.unique(flights)) >= MIN_FLIGHTS
    if between:  # flights that are level: another take-off point makes no such ratio of three
        flights = np.zeros(len(flights))
        ratio = climb_ratio(heights, above, flights)
    if ratio is None:
        return None
    cause = _cause(ratio, heights, above, flights)
    text = climb_sentence(ratio, "the stated altitude")
    if cause is None and between:
        return None
    if cause is None:
        return f"{text}.", "Check the altitudes' sign and unit, and that each is its photo's."
    reading, evidence = cause
    return f"{text}: if {reading.cause}, {evidence.share:.0%} of the altitudes agree.", reading.remedy


def _cause(
    ratio: float,
    heights_m: Float64[np.ndarray, " n"],
    above_m: Float64[np.ndarray, " n"],
    flights: Float64[np.ndarray, " n"],
) -> tuple[Reading, Evidence] | None:
    """The cause of a ratio, a sign or a unit, if it explains nearly all photos: they lie nearer to it than to 1."""
    ours, theirs = _climbs(heights_m, above_m, flights)
    telling = np.abs(theirs) > CLIMB_M / 2.0
    ours, theirs = ours[telling], theirs[telling]
    middle = float(np.nanmedian(heights_m))
    candidates = []
    for factor, reading in CAUSES:
        if not is_altitude(middle / factor):
            continue
        fits = np.linalg.norm(ours - factor * theirs) < MAX_MISFIT_RATIO * np.linalg.norm(ours - theirs)
        if factor * ratio > 0.0 and abs(math.log(ratio / factor)) < math.log(CAUSE_RATIO) and fits:
            nearer = np.abs(ours - factor * theirs) < np.abs(ours - theirs)
            candidates.append((reading, Evidence(int(nearer.sum()), len(ours))))
    if not candidates:
        return None
    evidence = candidates[0][1]
    return plausible(Evidence(evidence.of - evidence.explained, evidence.of), candidates)


def _climbs(
    heights_m: Float64[np.ndarray, " n"], above_m: Float64[np.ndarray, " n"], flights: Float64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """Both heights off the mean of their flight, where both are known."""
    known = np.isfinite(heights_m) & np.isfinite(above_m)
    ours, theirs, of = heights_m[known].copy(), above_m[known].copy(), flights[known]
    for flight in np.unique(of):
        own = of == flight
        ours[own] -= ours[own].mean()
        theirs[own] -= theirs[own].mean()
    return ours, theirs
