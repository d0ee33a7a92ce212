"""Exact conversion between coordinates in a CRS and WGS 84 latitude, longitude, height; nothing is guessed silently.

PROJ does the mathematics (pyproj). By default it falls back silently: to a less accurate operation where a grid is
missing, to a "ballpark" one where it knows none, and it leaves heights unchanged where the geoid grid is missing. So
the operation is chosen here, named with its accuracy, and refused where a better one lacks its grid, unless the user
accepts that.

Coordinates are always east (or longitude) first, whatever the axis order of the CRS says, as in the files of ODM.

Heights are kept as stated: in metres, in the datum `Crs.vertical`. Only `undulation` relates them to another datum.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pyproj
from jaxtyping import Float64
from pyproj.aoi import AreaOfInterest
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.survey.crs.crs_names import (
    ELLIPSOIDAL,
    UNKNOWN,
    Crs,
    describe_vertical,
    parse_crs,
    parse_vertical,
    same_datum,
    utm_of,
)
from splatpipe.pipeline.survey.crs.geodesy import FLATTENING, SEMI_MAJOR_M

__all__ = [
    "ELLIPSOIDAL",
    "UNKNOWN",
    "Crs",
    "GeodeticPoints",
    "Operation",
    "describe_vertical",
    "from_geodetic",
    "geodetic_by",
    "open_operation",
    "outside_area_km",
    "parse_crs",
    "parse_vertical",
    "same_datum",
    "to_geodetic",
    "undulation",
    "usable_for_maps",
    "utm_of",
]

WGS84_3D = "EPSG:4979"
MAX_OUTSIDE_KM = 300.0  # distance from a CRS's area of use: surveyors do stay in their zone across a border
MAX_STRETCH = 0.05  # a projected length that differs more from the true one belongs to another part of the earth
AROUND_DEG = 0.05  # around the points: where operations are compared
MAX_ROUNDS = 10  # iterations to the exact inverse; each gains four digits
TOLERANCE_M = 1e-6  # change at which the iteration ends: float64 resolves 1e-9 m at a northing of 5,000 km
METRES_A_DEGREE = 111_000.0
EARTH_RADIUS_KM = 6371.0
GRIDS_SHOWN = 4


@dataclass(frozen=True)
class Operation:
    """The operation between a CRS and WGS 84 (EPSG:4979) around a place.

    Attributes:
        name: PROJ's name for it.
        accuracy_m: As stated by EPSG; None where it states none.
        definition: The PROJ pipeline from the CRS to longitude, latitude, height.
        best: False where a better operation exists but its grid is missing.
        note: What was assumed: a sentence, or empty.
    """

    name: str
    accuracy_m: float | None
    definition: str
    best: bool
    note: str
    transformer: pyproj.Transformer = field(repr=False, compare=False)


@dataclass(frozen=True)
class GeodeticPoints:
    """Points by latitude and longitude.

    Attributes:
        geodetic: Latitude, longitude (degrees, WGS 84), height in metres as stated, in the CRS's vertical datum.
        operation: The operation that converted them.
    """

    geodetic: Float64[np.ndarray, "n 3"]
    operation: Operation


def open_operation(crs: Crs, latitude: float, longitude: float, approximate: bool = False) -> Operation:
    """The best operation between a CRS and WGS 84 around a place.

    Args:
        crs: The CRS.
        latitude: Of the place, degrees.
        longitude: Likewise.
        approximate: Accept the best operation whose grids are installed although a better one lacks its grid, and treat
            a datum on WGS 84's ellipsoid as WGS 84 where EPSG has no operation.

    Raises:
        SplatpipeError: if the place is far outside the CRS's area, a grid is missing, or PROJ knows no operation.
    """
    _require_near(crs, latitude, longitude)
    group = _quiet_group(crs.horizontal, latitude, longitude)
    if not group.best_available and not (approximate and group.transformers):
        raise _lacks_grid(crs, group)
    note = crs.assumed
    if not group.transformers and approximate and _like_wgs84(crs):
        group = _quiet_group(crs.horizontal, latitude, longitude, allow_ballpark=True)
        note = "EPSG has no operation to WGS 84: its datum is treated as WGS 84, which may be metres off."
    if not group.transformers:
        _require_near(crs, latitude, longitude, 0.0)  # the likelier cause, if PROJ knows operations in its area
        raise _no_way(f"{crs.text} ({crs.name})", _like_wgs84(crs))
    best = group.transformers[0]
    accuracy = float(best.accuracy) if best.accuracy is not None and best.accuracy >= 0.0 else None
    name = re.sub(r" \+ axis order change \([^)]*\)|axis order change \([^)]*\) \+ ", "", best.description)
    return Operation(name, accuracy, best.definition, bool(group.best_available), note, best)


def to_geodetic(points: Float64[np.ndarray, "n 3"], crs: Crs, approximate: bool = False) -> GeodeticPoints:
    """Latitude, longitude and height of points that are stated in a CRS.

    Args:
        points: Easting (or longitude), northing (or latitude), height in the CRS's units; a height may be NaN.
        crs: Their CRS.
        approximate: As in ``open_operation``.

    Raises:
        SplatpipeError: as ``open_operation``, and if a point is not on the earth or far outside the CRS's area.
    """
    latitude, longitude = _rough_place(points, crs)
    _require_no_degrees(points, crs, latitude, longitude)
    operation = open_operation(crs, latitude, longitude, approximate)
    located = geodetic_by(operation, crs, points)
    for point, place in zip(points, located, strict=True):
        if not np.isfinite(place[:2]).all():
            raise _not_there(crs, point)
    return GeodeticPoints(located, operation)


def geodetic_by(operation: Operation, crs: Crs, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """As ``to_geodetic``, with an operation that is already open; points outside its reach are infinite.

    This is the exact inverse of ``from_geodetic``, computed by iteration: a datum shift is three-dimensional, so it
    needs a height above the CRS's own ellipsoid, which the stated height need not be; and PROJ's small-angle rotations
    invert each other only to about a millimetre.
    """
    stated = points[:, 2] * crs.height_unit_m
    wanted = np.stack([points[:, 0], points[:, 1], np.where(np.isfinite(stated), stated, 0.0)])
    tolerance = np.array([[1.0 / METRES_A_DEGREE if crs.is_geographic else 1.0]] * 2 + [[1.0]]) * TOLERANCE_M
    sought = wanted
    for _ in range(MAX_ROUNDS):
        lon, lat, height = operation.transformer.transform(*sought)
        if crs.vertical == ELLIPSOIDAL:  # then the CRS's heights are those of its ellipsoid, and move with the datum
            found = np.stack(operation.transformer.transform(lon, lat, height, direction="INVERSE"))
        else:
            back = operation.transformer.transform(lon, lat, wanted[2], direction="INVERSE")
            found = np.stack([back[0], back[1], height])
        off = np.where(np.isfinite(found), wanted - found, 0.0)
        sought = sought + off
        if (np.abs(off) <= tolerance).all():
            break
    known = height if crs.vertical == ELLIPSOIDAL else stated
    return np.stack([lat, lon, np.where(np.isfinite(stated), known, np.nan)], axis=1)


def from_geodetic(operation: Operation, crs: Crs, geodetic: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Coordinates in a CRS.

    Args:
        operation: From ``open_operation``, around the points.
        crs: The CRS.
        geodetic: Latitude, longitude (degrees), height in metres: ellipsoidal where the CRS's heights are, else as
            stated, in the CRS's vertical datum.

    Returns:
        Easting (or longitude), northing (or latitude), height in the CRS's units.
    """
    lat, lon = np.ascontiguousarray(geodetic[:, 0]), np.ascontiguousarray(geodetic[:, 1])
    stated = geodetic[:, 2]
    known = np.where(np.isfinite(stated), stated, 0.0)
    x, y, height = operation.transformer.transform(lon, lat, known, direction="INVERSE")
    if crs.vertical == ELLIPSOIDAL:
        stated = np.where(np.isfinite(stated), height, np.nan)
    return np.stack([x, y, stated / crs.height_unit_m], axis=1)


def undulation(
    vertical: str, latitude: Float64[np.ndarray, " n"], longitude: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Height of a vertical datum's zero above the WGS 84 ellipsoid, metres, from the geoid's grid.

    Args:
        vertical: ``EPSG:n``, or ``ellipsoidal`` for zeros.
        latitude: Degrees.
        longitude: Degrees.

    Raises:
        SplatpipeError: if the datum is unknown, its grid is missing, or a place is outside of it.
    """
    if vertical == ELLIPSOIDAL:
        return np.zeros(len(latitude))
    if vertical == UNKNOWN:
        raise SplatpipeError(
            "The vertical datum of the heights is not known, so they cannot be converted to another one.",
            "State it: --set georef.vertical=ellipsoidal, or =EPSG:n of the heights' datum.",
        )
    code = vertical.removeprefix("EPSG:")
    place = float(np.median(latitude)), float(np.median(longitude))
    group = _quiet_group(pyproj.CRS(f"EPSG:4326+{code}"), *place)
    if not group.best_available or not group.transformers:
        missing = _missing_grids(group)
        named = f": {', '.join(missing[:GRIDS_SHOWN])}" if missing else ""
        raise SplatpipeError(
            f"Heights in {describe_vertical(vertical)} need a geoid grid that is not installed{named}.",
            _how_to_fetch(missing),
        )
    _, _, height = group.transformers[0].transform(longitude, latitude, np.zeros(len(latitude)))
    if not np.isfinite(height).all():
        raise SplatpipeError(
            f"The scene lies outside the geoid grid of {describe_vertical(vertical)}.",
            "State the vertical datum of its heights.",
        )
    return np.asarray(height, dtype=np.float64)


def _quiet_group(
    source: pyproj.CRS, latitude: float, longitude: float, *, allow_ballpark: bool = False
) -> TransformerGroup:
    south, north = max(latitude - AROUND_DEG, -90.0), min(latitude + AROUND_DEG, 90.0)
    area = AreaOfInterest(longitude - AROUND_DEG, south, longitude + AROUND_DEG, north)
    with warnings.catch_warnings():  # about missing grids: we raise our own error
        warnings.simplefilter("ignore", UserWarning)
        try:
            return TransformerGroup(
                source,
                WGS84_3D,
                always_xy=True,
                area_of_interest=area,  # type: ignore[arg-type]  # pyproj's stub has a class of its own for it
                allow_ballpark=allow_ballpark,
            )
        except (ProjError, IndexError) as error:  # the latter where PROJ knows nothing of an operation's grid
            raise _no_way(source.name) from error


def _rough_place(points: Float64[np.ndarray, "n 3"], crs: Crs) -> tuple[float, float]:
    """Latitude and longitude of the points to about a kilometre: enough to choose the operation."""
    try:
        rough = pyproj.Transformer.from_crs(crs.horizontal, WGS84_3D, always_xy=True)
    except ProjError as error:  # a CRS of another planet, for one
        raise _no_way(f"{crs.text} ({crs.name})") from error
    lon, lat = rough.transform(points[:, 0], points[:, 1], np.zeros(len(points)))[:2]
    good = np.isfinite(lon) & np.isfinite(lat)
    if not good.any():
        raise _not_there(crs, points[0] if len(points) else np.full(3, np.nan))
    return float(np.median(lat[good])), float(np.median(lon[good]))


def _require_near(crs: Crs, latitude: float, longitude: float, most_km: float = MAX_OUTSIDE_KM) -> None:
    """Reject a place far outside the CRS's area or, where that is not stated, where it distorts lengths strongly."""
    place = (
        f"{abs(latitude):.4f}° {'N' if latitude >= 0 else 'S'}, {abs(longitude):.4f}° {'E' if longitude >= 0 else 'W'}"
    )
    hint = "Check the CRS, and the order of the coordinates: east (or longitude) comes first."
    if crs.area is not None:
        away = _outside_km(crs.area, latitude, longitude)
        if away > most_km:
            raise SplatpipeError(f"{place} is {away:,.0f} km outside the area of {crs.text} ({crs.name}).", hint)
    elif not crs.is_geographic:
        factors = pyproj.Proj(crs.horizontal).get_factors(longitude, latitude)
        stretch = max(abs(factors.meridional_scale - 1.0), abs(factors.parallel_scale - 1.0))
        if not stretch <= MAX_STRETCH:  # also where it is infinite or not a number
            raise SplatpipeError(
                f"{place} is in another part of the earth, where {crs.text} is not true to scale.", hint
            )


def outside_area_km(crs: Crs, latitude: float, longitude: float) -> float:
    """Distance from a place to a CRS's area of use; 0 inside, and where no area is stated."""
    return 0.0 if crs.area is None else _outside_km(crs.area, latitude, longitude)


def usable_for_maps(crs: Crs) -> bool:
    """Whether rasters can be in a CRS: cells are not square in degrees, and a westward axis turns them round."""
    return not crs.is_geographic and "west" not in [axis.direction for axis in crs.horizontal.axis_info[:2]]


def _require_no_degrees(points: Float64[np.ndarray, "n 3"], crs: Crs, latitude: float, longitude: float) -> None:
    """Reject degrees given as eastings and northings: those are metres from the false origin."""
    like_degrees = bool((np.abs(points[:, :2]) <= [360.0, 90.0]).all()) and not crs.is_geographic
    if like_degrees and crs.area is not None and _outside_km(crs.area, latitude, longitude) > 0.0:
        raise SplatpipeError(
            f"The coordinates look like degrees, and {crs.text} ({crs.name}) has none.",
            "State their CRS: EPSG:4326 for longitude and latitude of WGS 84.",
        )


def _outside_km(area: tuple[float, float, float, float], latitude: float, longitude: float) -> float:
    """Distance from a place to a box (west, south, east, north; degrees), 0 inside."""
    west, south, east, north = area
    width = (east - west) % 360.0 if east != west else 360.0
    width = 360.0 if east - west >= 360.0 else width
    past = (longitude - west) % 360.0
    off_lon = 0.0 if past <= width else min(past - width, 360.0 - past)
    off_lat = max(south - latitude, latitude - north, 0.0)
    east_km = math.radians(off_lon) * math.cos(math.radians(latitude)) * EARTH_RADIUS_KM
    return math.hypot(east_km, math.radians(off_lat) * EARTH_RADIUS_KM)


def _missing_grids(group: TransformerGroup) -> list[str]:
    grids = [grid for each in group.unavailable_operations for grid in each.grids if not grid.available]
    return list(dict.fromkeys(str(grid.short_name) for grid in grids))


def _how_to_fetch(grids: Sequence[str]) -> str:
    fetch = f"Fetch it: `pyproj sync --file {grids[0]}`" if grids else "Choose another datum"
    return f"{fetch}, or choose a CRS that needs no grid."


def _lacks_grid(crs: Crs, group: TransformerGroup) -> SplatpipeError:
    missing = _missing_grids(group)
    rest = "without it PROJ has no transformation to WGS 84"
    if group.transformers:
        rest = f"without it the best is {group.transformers[0].description}, {group.transformers[0].accuracy:g} m"
    return SplatpipeError(
        f"{crs.text} ({crs.name}) needs a grid that is not installed: {', '.join(missing[:GRIDS_SHOWN])}; {rest}.",
        _how_to_fetch(missing) + " --set georef.approximate_crs=true accepts that.",
    )


def _like_wgs84(crs: Crs) -> bool:
    """Whether its ellipsoid is WGS 84's to a millimetre: then its datum is modern, and at most metres off."""
    ellipsoid = crs.horizontal.ellipsoid
    if ellipsoid is None:
        return False
    shape = abs(ellipsoid.semi_major_metre - SEMI_MAJOR_M), abs(ellipsoid.inverse_flattening - 1.0 / FLATTENING)
    return shape[0] < 0.5 and shape[1] < 1e-4


def _no_way(crs: str, like_wgs84: bool = False) -> SplatpipeError:
    hint = "State its datum: an EPSG code, or +datum=… or +towgs84=… in the PROJ string."
    if like_wgs84:
        hint = "--set georef.approximate_crs=true treats its datum as WGS 84, which may be metres off."
    return SplatpipeError(f"PROJ has no transformation between {crs} and WGS 84.", hint)


def _not_there(crs: Crs, point: Float64[np.ndarray, " 3"]) -> SplatpipeError:
    return SplatpipeError(
        f"{crs.text} ({crs.name}) is not defined at the coordinates {point[0]:g} {point[1]:g}.",
        "Check the CRS, and the order of the coordinates: east (or longitude) comes first.",
    )
