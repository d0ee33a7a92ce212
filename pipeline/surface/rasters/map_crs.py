"""The CRS of survey files: projected, easting first, with heights; and the exact transformation to it and back.

It is the run's CRS, except for two kinds that are unsuitable for rasters: in geographic CRSs cells are not square, and
axes that point west (South Africa's Lo, Krovak's older form) turn an image upside down. The UTM zone of the origin
replaces both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pyproj
from jaxtyping import Float64
from pyproj.crs import CompoundCRS
from pyproj.database import query_crs_info
from pyproj.enums import PJType

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.survey.crs.crs import (
    ELLIPSOIDAL,
    UNKNOWN,
    Crs,
    describe_vertical,
    open_operation,
    same_datum,
    usable_for_maps,
    utm_of,
)
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.crs.world import World, open_world

LOCAL = "local"
HEIGHTS_FOR_PEOPLE = {
    LOCAL: "above the local zero",
    ELLIPSOIDAL: "above the WGS 84 ellipsoid",
    UNKNOWN: "datum unknown",
}
LOCAL_WKT = (
    'ENGCRS["Local metres, z up, arbitrary place and heading",EDATUM["The reconstruction"],CS[Cartesian,2],'
    'AXIS["easting (E)",east],AXIS["northing (N)",north],LENGTHUNIT["metre",1]]'
)
UNIT_TOLERANCE = 1e-9  # relative: the US survey foot and the foot differ by 2e-6
UNIT_NAMES = {1.0: "metre", 0.3048: "foot", 1200.0 / 3937.0: "US survey foot"}


@dataclass(frozen=True, eq=False)
class MapCrs:
    """A projected CRS and its heights.

    Attributes:
        horizontal: Two axes: easting and northing, or x and y of a frame that is not georeferenced.
        vertical: CRS of the heights; None without an EPSG code: for ellipsoidal, unknown and local heights.
        heights: Their datum: ``ellipsoidal``, ``EPSG:n``, ``unknown``, or ``local`` without georeferencing.
        unit_m: Metres per unit of eastings and northings.
        height_unit_m: Metres per unit of heights.
        world: Transformation to the local frame; None if the two are the same.
    """

    horizontal: pyproj.CRS
    vertical: pyproj.CRS | None
    heights: str
    unit_m: float
    height_unit_m: float
    world: World | None = field(repr=False)

    @property
    def compound(self) -> pyproj.CRS:
        """The compound CRS, or the horizontal one if there is no vertical CRS."""
        if self.vertical is None:
            return self.horizontal
        return CompoundCRS(f"{self.horizontal.name} + {self.vertical.name}", [self.horizontal, self.vertical])

    def described_heights(self) -> str:
        """Datum and unit of the heights, as text for users."""
        datum = HEIGHTS_FOR_PEOPLE.get(self.heights) or describe_vertical(self.heights)
        return f"{datum}, {unit_name(self.height_unit_m)}"

    def crs_from_local(self, local: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """East, north, up (metres) to easting, northing, height in the CRS's units, exactly."""
        return local.copy() if self.world is None else self.world.crs_from_local(local)

    def local_from_crs(self, coordinates: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """The inverse of ``crs_from_local``."""
        return coordinates.copy() if self.world is None else self.world.local_from_crs(coordinates)


def open_map(frame: Frame) -> MapCrs:
    """The CRS of a frame's files.

    Raises:
        SplatpipeError: if the frame is not metric, or as ``open_world``.
    """
    if frame.origin is None:
        if not frame.metres:
            raise SplatpipeError(
                "The reconstruction has no metric scale, so no products in metres can be made.",
                "Give photos with positions, a gcp_list.txt, or scale bars.",
            )
        return MapCrs(pyproj.CRS(LOCAL_WKT), None, LOCAL, 1.0, 1.0, None)
    world = _plane(open_world(frame))
    unit_m = world.crs.height_unit_m
    vertical = _vertical(world.heights, unit_m)
    return MapCrs(_horizontal(world.crs), vertical, world.heights, world.crs.unit_m, unit_m, world)


def unit_name(unit_m: float) -> str:
    """Name of a unit of length for users."""
    for known_m, name in UNIT_NAMES.items():
        if math.isclose(unit_m, known_m, rel_tol=UNIT_TOLERANCE):
            return name
    return f"{unit_m:.10g} m"


def _plane(world: World) -> World:
    """This world in a projected CRS whose first axis does not point west."""
    if usable_for_maps(world.crs):
        return world
    latitude, longitude = world.origin.latitude, world.origin.longitude
    crs = utm_of(latitude, longitude)
    operation = open_operation(crs, latitude, longitude)
    crs = replace(crs, vertical=world.crs.vertical, height_unit_m=world.crs.height_unit_m)
    return replace(world, crs=crs, operation=operation)


def _horizontal(crs: Crs) -> pyproj.CRS:
    """The two horizontal axes, with the EPSG code if there is one: web readers do not accept parameters instead."""
    code = crs.text.removeprefix("EPSG:").partition("+")[0]
    if not code.isdecimal():
        return crs.horizontal.to_2d()
    stated = pyproj.CRS.from_epsg(int(code))
    plane = stated.sub_crs_list[0] if stated.is_compound else stated
    return plane.to_2d() if len(plane.axis_info) > 2 else plane


def _vertical(heights: str, unit_m: float) -> pyproj.CRS | None:
    """The vertical CRS in a unit: for NAVD88, EPSG has one each for metre, foot and US survey foot."""
    if not heights.startswith("EPSG:"):
        return None
    stated = pyproj.CRS(heights)
    if _is_in(stated, unit_m):
        return stated
    family = stated.name.partition(" (")[0]
    for info in query_crs_info("EPSG", PJType.VERTICAL_CRS):
        if info.name.partition(" (")[0] == family and same_datum(f"EPSG:{info.code}", heights):
            other = pyproj.CRS.from_epsg(int(info.code))
            if _is_in(other, unit_m):
                return other
    return None


def _is_in(vertical: pyproj.CRS, unit_m: float) -> bool:
    """Whether a vertical CRS has upward heights in a unit."""
    axis = vertical.axis_info[0]
    return axis.direction == "up" and math.isclose(axis.unit_conversion_factor, unit_m, rel_tol=UNIT_TOLERANCE)
