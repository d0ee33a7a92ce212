"""Conventions of surveyed coordinates, told apart by the photos' positions and by the shape of the model."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pyproj
from jaxtyping import Bool, Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.survey.crs.crs import Crs, parse_crs, utm_of
from splatpipe.pipeline.survey.crs.geodesy import ecef_from_geodetic
from splatpipe.pipeline.survey.crs.readings import MAX_STATED_RATIO, MIN_WITNESSES, Evidence, Reading, plausible

FAR_M = 2000.0  # distance from the photos from which control cannot be what they show
ZONE = 1e6  # what a zone number in front of an easting counts
FOOT_M = 0.3048  # the US survey foot differs by 2e-6, which no position this far off can tell
CUT_FROM = 1e5  # leading digits from here on are sometimes dropped for brevity
MAX_MISFIT_SHARE = 0.05  # how far a point may be off the shape of the others, over the points' extent
MAX_SCALE_RATIO = 1.2  # factor between the model's scales by its positions and by a reading, at most
MAX_TURN_RAD = np.radians(20.0)  # angle between the model's headings by both, at most
Plane = Float64[np.ndarray, "n 2"]


@dataclass(frozen=True)
class _Rewritten:
    how: str
    xy: Plane
    changes: int


def nearer_reading(stated: Plane, crs: Crs, positions: Float64[np.ndarray, "m 3"]) -> str:
    """A hint at the CRS, the order, the unit or the digits by which points lie where they should; else empty.

    Their number does not matter: that any lie within kilometres of the photos by chance is unlikely enough.

    Args:
        stated: The points' first two coordinates.
        crs: Their CRS.
        positions: Latitude, longitude, height of the photos; without any, points should lie in the CRS's area of use.
    """
    if len(stated) == 0:
        return ""
    as_stated = _evidence(stated, crs, positions)
    if as_stated.share >= MAX_STATED_RATIO:  # no reading explains more than all
        return ""
    texts, place = [crs.text], None
    if len(positions):
        place = np.median(positions, axis=0)
        zone = utm_of(float(place[0]), float(place[1])).text
        number = zone.rpartition(":")[2]
        texts += [zone, "EPSG:4326"] + ([f"EPSG:258{number[3:]}"] if number.startswith("326") else [])
    candidates = []
    for text in dict.fromkeys(texts):
        try:
            read = parse_crs(text)
        except SplatpipeError:
            continue
        for each in _rewritten(stated, read, place):
            other = text != crs.text
            if other or each.changes:
                how = " and ".join(filter(None, (each.how, f"as {text}" if other else "")))
                candidates.append((each.changes + other, how, _evidence(each.xy, read, positions)))
    candidates.sort(key=lambda candidate: candidate[0])
    readings = ((Reading(how, ""), evidence) for _, how, evidence in candidates)
    found = plausible(as_stated, readings, least=1)
    if found is None:
        return ""
    match = "match the photos' positions" if len(positions) else f"lie where {crs.text} is used"
    return f"Read {found[0].cause}, they {match}: correct the file."


def _rewritten(stated: Plane, crs: Crs, place: Float64[np.ndarray, " 3"] | None) -> Iterator[_Rewritten]:
    """Readings of coordinates in a CRS; the order of two is part of most."""
    for swapped in (False, True):
        xy = stated[:, ::-1] if swapped else stated
        order = "with its first two coordinates swapped (east comes first)" if swapped else ""

        def as_(how: str, changed: Plane, order: str = order, swapped: bool = swapped) -> _Rewritten:
            return _Rewritten(" and ".join(filter(None, (order, how))), changed, swapped + bool(how))

        yield as_("", xy)
        yield as_("with the other sign of the first coordinate", xy * [-1.0, 1.0])
        yield as_("with the other sign of the second coordinate", xy * [1.0, -1.0])
        if crs.is_geographic:
            continue
        zones = np.floor(np.clip(xy[:, 0], 0.0, 99.0 * ZONE) / ZONE)
        own = (crs.horizontal.utm_zone or "").rstrip("NS")
        likely = str(int(zones[0])) == own if own else place is not None
        if likely and (zones == zones[0]).all() and 1 <= zones[0] <= 60:
            number = f"without the zone number in front of the eastings ({zones[0]:.0f})"
            yield as_(number, xy - [zones[0] * ZONE, 0.0])
        if crs.unit_m == 1.0:
            yield as_("in feet", xy * FOOT_M)
        else:
            yield as_("in metres", xy / crs.unit_m)
        if place is not None:
            transformer = pyproj.Transformer.from_crs("EPSG:4979", crs.horizontal, always_xy=True)
            there = np.array(transformer.transform(place[1], place[0], 0.0)[:2])
            middle = np.median(xy, axis=0)
            missing = np.round((there - middle) / CUT_FROM) * CUT_FROM
            if np.isfinite(missing).all() and (np.abs(xy) < np.abs(there)).all():
                digits = f"with the leading digits that they lack ({missing[0]:+,.0f} and {missing[1]:+,.0f})"
                yield as_(digits, xy + missing)


def _evidence(xy: Plane, crs: Crs, positions: Float64[np.ndarray, "m 3"]) -> Evidence:
    """How many of the points lie near the photos, to the kilometre that a datum may matter."""
    transformer = pyproj.Transformer.from_crs(crs.horizontal, "EPSG:4979", always_xy=True)
    lon, lat = transformer.transform(xy[:, 0], xy[:, 1], np.zeros(len(xy)))[:2]
    good = np.isfinite(lon) & np.isfinite(lat) & (np.abs(lat) <= 90.0)
    lat, lon = np.where(good, lat, 0.0), np.where(good, lon, 0.0)
    if not len(positions):
        west, south, east, north = crs.area if crs.area is not None else (0.0, 1.0, 0.0, -1.0)
        inside = good & (lat >= south) & (lat <= north) & ((lon - west) % 360.0 <= (east - west) % 360.0)
        return Evidence(int(inside.sum()), len(xy))
    places = ecef_from_geodetic(np.stack([lat[good], lon[good], np.zeros(int(good.sum()))], axis=1))
    photos = ecef_from_geodetic(np.column_stack([positions[:, :2], np.zeros(len(positions))]))
    centre = np.median(photos, axis=0)
    reach = FAR_M + float(np.linalg.norm(photos - centre, axis=1).max())
    return Evidence(int((np.linalg.norm(places - centre, axis=1) <= reach).sum()), len(xy))


Places = Float64[np.ndarray, "n 3"]
SHAPES: tuple[tuple[Reading, Callable[[Places], Places]], ...] = (
    (Reading("east and north are swapped", "Write east first."), lambda enu: enu[:, [1, 0, 2]]),
    (Reading("eastings count to the west", "Change their sign."), lambda enu: enu * [-1.0, 1.0, 1.0]),
    (Reading("northings count to the south", "Change their sign."), lambda enu: enu * [1.0, -1.0, 1.0]),
    (Reading("heights count downwards", "Change their sign."), lambda enu: enu * [1.0, 1.0, -1.0]),
    (
        Reading("heights are in feet, the rest in metres", "Convert them to metres."),
        lambda enu: enu * [1.0, 1.0, FOOT_M],
    ),
    (
        Reading("the names are one line too low in the list", "Move the names up by one line."),
        lambda enu: np.roll(enu, 1, axis=0),
    ),
    (
        Reading("the names are one line too high in the list", "Move the names down by one line."),
        lambda enu: np.roll(enu, -1, axis=0),
    ),
)


def shape_reading(found: Places, surveyed: Places, heights: Bool[np.ndarray, " n"]) -> tuple[Reading, Evidence] | None:
    """The convention by which surveyed points have the shape of the model, where they do not as stated; else None.

    Fewer than ``MIN_WITNESSES`` points, or none, have no shape.

    Args:
        found: Their places in the model, upright, with its north, and in metres to a few percent.
        surveyed: East, north, up as stated.
        heights: Where up is known.
    """
    if len(found) < MIN_WITNESSES:
        return None
    stated = _alike(found, surveyed, heights)
    return plausible(stated, ((reading, _alike(found, rewrite(surveyed), heights)) for reading, rewrite in SHAPES))


def _alike(found: Places, surveyed: Places, heights: Bool[np.ndarray, " n"]) -> Evidence:
    """How many points a turn about the vertical, a shift and a slight change of scale bring to their places."""
    extent = float(np.linalg.norm(np.ptp(surveyed[:, :2], axis=0)))
    tolerance = MAX_MISFIT_SHARE * extent
    a, b = found[:, 0] + 1j * found[:, 1], surveyed[:, 0] + 1j * surveyed[:, 1]
    best = 0
    for i, j in itertools.islice(itertools.combinations(range(len(a)), 2), 500):
        if abs(a[j] - a[i]) < tolerance:
            continue
        turn = (b[j] - b[i]) / (a[j] - a[i])
        if not 1.0 / MAX_SCALE_RATIO <= abs(turn) <= MAX_SCALE_RATIO or abs(np.angle(turn)) > MAX_TURN_RAD:
            continue
        near = np.abs(b[i] + turn * (a - a[i]) - b) <= tolerance
        lift = surveyed[:, 2] - abs(turn) * found[:, 2]
        known = near & heights
        if known.any():
            near &= ~heights | (np.abs(lift - np.median(lift[known])) <= tolerance)
        best = max(best, int(near.sum()))
    return Evidence(max(best - 2, 0), max(len(a) - 2, 0))
