"""International foot against US survey foot: two parts in a million, metres at the eastings of a state plane."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.survey.control.control import ControlResult
from splatpipe.pipeline.survey.crs.crs import to_geodetic
from splatpipe.pipeline.survey.crs.readings import Evidence, Reading, plausible

US_FOOT_M = 1200.0 / 3937.0
FOOT_M = 0.3048
SAME_UNIT = 1e-7  # relative: the two feet differ by 2e-6
MIN_SHIFT_SIGMAS = 2.0  # shift between the readings, in the positions' sigmas: a smaller one shows in no position


def other_foot(controlled: ControlResult) -> tuple[Reading, Evidence] | None:
    """The other foot, if control in it agrees with the photos' positions and as stated does not; else None.

    The positions are held against the cameras that control places: their common error is a receiver's, which is all
    the more unlikely to be the difference of two feet, the larger that is.

    Args:
        controlled: The result, whose control is in a CRS in feet.
    """
    crs, stations = controlled.survey.crs, controlled.site.stations
    feet = {US_FOOT_M: "US survey feet", FOOT_M: "international feet"}
    own = next((unit for unit in feet if abs(crs.unit_m / unit - 1.0) < SAME_UNIT), None)
    if own is None or len(stations) == 0:
        return None
    other = FOOT_M if own == US_FOOT_M else US_FOOT_M
    shift = _moved(controlled, other / own)
    if float(np.hypot(*shift)) < MIN_SHIFT_SIGMAS * float(np.median(stations.sigmas[:, 0])):
        return None
    placed = controlled.placed
    cameras = placed.world_from_model.apply(placed.model.centres[stations.indices])
    apart = (controlled.site.station_enu - cameras)[:, :2]
    near = float(np.hypot(*shift)) / 2.0

    def within(errors: Float64[np.ndarray, "n 2"]) -> Evidence:
        return Evidence(int((np.linalg.norm(errors, axis=1) <= near).sum()), len(errors))

    reading = Reading(
        f"its coordinates are in {feet[other]} (the CRS {crs.text} is in {feet[own]})",
        f"Multiply eastings and northings by {other / own:.9f}, or choose the CRS in that foot.",
    )
    return plausible(within(apart), [(reading, within(apart - shift))])


def _moved(controlled: ControlResult, ratio: float) -> Float64[np.ndarray, " 2"]:
    """East and north (metres) by which control moves if its coordinates are in a unit of another length."""
    survey, site = controlled.survey, controlled.site
    stated = np.array([[point.surveyed.x, point.surveyed.y, np.nan] for point in survey.points], dtype=np.float64)
    there = to_geodetic(stated * [ratio, ratio, 1.0], survey.crs, approximate=True).geodetic
    there[:, 2] = site.origin.height_m
    here = np.column_stack([site.targets.geodetic[:, :2], there[:, 2]])
    moved = site.origin.enu_from_geodetic(there) - site.origin.enu_from_geodetic(here)
    return np.asarray(np.median(moved, axis=0)[:2])
