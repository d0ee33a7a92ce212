"""Positions that repeat: a coordinate that was copied, a receiver slower than the camera, two places in one list."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.photos.metadata.position_outliers import FAR_M
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.positions.flight_steps import FlightSteps
from splatpipe.pipeline.survey.positions.position_sources import PLACE_DIGITS, same_place

MIN_COPIED = 6  # photos of one latitude or longitude: fewer may lie on a line by chance
MIN_PLACES = 3  # in the other coordinate
MIN_PLACE_SHARE = 0.2  # share of the photos, at least, at each of two places; fewer are outliers
MIN_GAP_RATIO = 5.0  # times the extent of either place


def copied_coordinate(places: Sequence[tuple[float, float]]) -> str:
    """The coordinate that all positions share to a millimetre although the other varies; empty if none.

    Args:
        places: Latitude and longitude of the photos, degrees.
    """
    values = [{round(place[axis], PLACE_DIGITS) for place in places} for axis in (0, 1)]
    for axis, name in enumerate(("latitude", "longitude")):
        if len(places) >= MIN_COPIED and len(values[axis]) == 1 and len(values[1 - axis]) >= MIN_PLACES:
            return name
    return ""


def two_places(places: Sequence[tuple[float, float]]) -> tuple[int, int, float] | None:
    """How many photos lie at each of two distant places, and how far apart these are (metres); None if at one.

    Args:
        places: Latitude and longitude of the photos, degrees.
    """
    if len(places) < MIN_COPIED:
        return None
    geodetic = np.array([(*place, 0.0) for place in places], dtype=np.float64)
    local = Origin(*geodetic[0]).enu_from_geodetic(geodetic)
    centred = local - local.mean(axis=0)
    along = np.sort(centred @ np.linalg.svd(centred, full_matrices=False)[2][0])
    at = int(np.argmax(np.diff(along))) + 1
    gap = float(along[at] - along[at - 1])
    extent = max(float(np.ptp(along[:at])), float(np.ptp(along[at:])))
    if gap <= max(FAR_M, MIN_GAP_RATIO * extent) or min(at, len(along) - at) < MIN_PLACE_SHARE * len(along):
        return None
    return at, len(along) - at, gap


def repeats(places: Sequence[tuple[float, float] | None], steps: FlightSteps) -> Int64[np.ndarray, " k"]:
    """Indices of the steps at whose ends one and the same position is stated.

    Args:
        places: Latitude and longitude of each photo, degrees; None where unknown.
        steps: From photo to photo.
    """
    keys = [None if place is None else same_place(*place) for place in places]
    ends = zip(steps.first.tolist(), steps.second.tolist(), strict=True)
    return np.array(
        [k for k, (one, other) in enumerate(ends) if keys[one] is not None and keys[one] == keys[other]], np.int64
    )


def ways_m(centres: Float64[np.ndarray, "n 3"], steps: FlightSteps) -> Float64[np.ndarray, " k"]:
    """Length of each step."""
    return np.asarray(np.linalg.norm(centres[steps.second] - centres[steps.first], axis=1))
