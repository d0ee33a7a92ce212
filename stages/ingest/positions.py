"""Where each photo was taken, how the camera was turned, and how well both are known: from EXIF and XMP."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.scene.exif import Exif, Gps
from splatpipe.pipeline.scene.xmp import xmp_number
from splatpipe.stages.ingest.check import CheckedPhoto

ALTITUDE_BOUNDS_M = (-1000.0, 20_000.0)
NULL_ISLAND_DEG = 1e-6  # receivers without a fix write 0, 0
RTK_OF_FLAG = {50: "fixed", 34: "float", 16: "single"}  # drone-dji:RtkFlag
# Horizontal (per axis) and vertical standard deviations, metres, where a photo does not state its own.
DEFAULT_SIGMAS_M = {"fixed": (0.02, 0.03), "float": (0.5, 1.0), "single": (3.0, 5.0), None: (3.0, 5.0)}
LEAST_SIGMA_M = 0.005  # stated accuracies below are the receiver's noise, not the camera's position
VERTICAL_OVER_HORIZONTAL = 1.5  # of GNSS errors, where only the horizontal one is stated
DATUM_STEP_M = 1.0  # EXIF and XMP altitudes further apart than this are not roundings of one value


@dataclass(frozen=True)
class Position:
    """A photo's position and angles; angles are degrees, yaw clockwise from north, pitch -90 straight down.

    Attributes:
        name: The photo.
        latitude: Degrees north, WGS84.
        longitude: Degrees east, WGS84.
        altitude_m: As stated; its datum is not known. None when there is none.
        altitude_source: ``exif`` or ``xmp``; None when there is none.
        relative_altitude_m: Above the take-off point, by the drone.
        sigma_horizontal_m: Standard deviation in east and in north each.
        sigma_vertical_m: Standard deviation of the altitude.
        rtk: ``fixed``, ``float``, ``single``; None when the drone says nothing of it.
        yaw_deg: Of the camera (gimbal).
        pitch_deg: Likewise.
        roll_deg: Likewise.
        flight_yaw_deg: Of the aircraft.
        flight_pitch_deg: Likewise.
        flight_roll_deg: Likewise.
        orientation: EXIF's, 1 to 8: how the stored grid was turned when the camera was upright.
    """

    name: str
    latitude: float
    longitude: float
    altitude_m: float | None
    altitude_source: str | None
    relative_altitude_m: float | None
    sigma_horizontal_m: float
    sigma_vertical_m: float
    rtk: str | None
    yaw_deg: float | None
    pitch_deg: float | None
    roll_deg: float | None
    flight_yaw_deg: float | None
    flight_pitch_deg: float | None
    flight_roll_deg: float | None
    orientation: int


@dataclass(frozen=True)
class PositionList:
    """The positions of all photos that state one.

    Attributes:
        positions: Sorted by the photos' names.
        impossible: Names of photos whose stated position is none, which therefore count as having none.
        altitude_step_m: Median of EXIF's altitude less XMP's where both are given, else None.
        orientations: EXIF orientation of every photo that has another than 1, by name.
    """

    positions: tuple[Position, ...]
    impossible: tuple[str, ...]
    altitude_step_m: float | None
    orientations: Mapping[str, int]


def read_positions(photos: Sequence[CheckedPhoto]) -> PositionList:
    """Take positions and angles from the photos' metadata.

    Args:
        photos: Those that take part, sorted by name.
    """
    positions: list[Position] = []
    impossible: list[str] = []
    steps: list[float] = []
    for photo in photos:
        gps = photo.exif.gps or _xmp_gps(photo.xmp)
        if gps is None or gps.void:
            continue
        if not is_on_earth(gps.latitude, gps.longitude):
            impossible.append(photo.name)
            continue
        positions.append(_position(photo.name, photo.exif, photo.xmp, gps))
        exif_altitude, xmp_altitude = _exif_altitude(gps), _xmp_altitude(photo.xmp)
        if photo.exif.gps is not None and exif_altitude is not None and xmp_altitude is not None:
            steps.append(exif_altitude - xmp_altitude)
    return PositionList(
        tuple(positions),
        tuple(impossible),
        float(np.median(steps)) if steps else None,
        {photo.name: photo.exif.orientation for photo in photos if photo.exif.orientation != 1},
    )


def positions_json(positions: PositionList) -> JSON:
    """What ``positions.json`` holds."""
    return {
        "positions": [asdict(position) for position in positions.positions],
        "orientations": dict(positions.orientations),
    }


def is_on_earth(latitude: float, longitude: float) -> bool:
    """Whether a position can be meant: finite, within bounds, and not the 0, 0 of a receiver without a fix."""
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        return False
    if abs(latitude) > 90.0 or abs(longitude) > 180.0:
        return False
    return abs(latitude) > NULL_ISLAND_DEG or abs(longitude) > NULL_ISLAND_DEG


def _position(name: str, exif: Exif, xmp: Mapping[str, str], gps: Gps) -> Position:
    exif_altitude, xmp_altitude = _exif_altitude(gps), _xmp_altitude(xmp)
    # Positions that were corrected afterwards (PPK) are written to EXIF: it comes first.
    altitude = xmp_altitude if exif_altitude is None else exif_altitude
    source = None if altitude is None else "exif" if exif_altitude is not None else "xmp"
    flag = xmp_number(xmp, "drone-dji:RtkFlag", 0, 255)
    rtk = RTK_OF_FLAG.get(int(flag)) if flag is not None else None
    sigma_horizontal, sigma_vertical = _sigmas(xmp, gps, rtk)
    return Position(
        name=name,
        latitude=gps.latitude,
        longitude=gps.longitude,
        altitude_m=altitude,
        altitude_source=source,
        relative_altitude_m=xmp_number(xmp, "drone-dji:RelativeAltitude", *ALTITUDE_BOUNDS_M),
        sigma_horizontal_m=sigma_horizontal,
        sigma_vertical_m=sigma_vertical,
        rtk=rtk,
        yaw_deg=xmp_number(xmp, "drone-dji:GimbalYawDegree", -720.0, 720.0),
        pitch_deg=xmp_number(xmp, "drone-dji:GimbalPitchDegree", -180.0, 180.0),
        roll_deg=xmp_number(xmp, "drone-dji:GimbalRollDegree", -360.0, 360.0),
        flight_yaw_deg=xmp_number(xmp, "drone-dji:FlightYawDegree", -720.0, 720.0),
        flight_pitch_deg=xmp_number(xmp, "drone-dji:FlightPitchDegree", -180.0, 180.0),
        flight_roll_deg=xmp_number(xmp, "drone-dji:FlightRollDegree", -360.0, 360.0),
        orientation=exif.orientation,
    )


def _sigmas(xmp: Mapping[str, str], gps: Gps, rtk: str | None) -> tuple[float, float]:
    east = xmp_number(xmp, "drone-dji:RtkStdLon", 1e-6, 1000.0)
    north = xmp_number(xmp, "drone-dji:RtkStdLat", 1e-6, 1000.0)
    up = xmp_number(xmp, "drone-dji:RtkStdHgt", 1e-6, 1000.0)
    horizontal, vertical = DEFAULT_SIGMAS_M[rtk]
    stated = xmp_number(xmp, "Camera:GPSXYAccuracy", 1e-4, 1e4)
    if east is not None and north is not None and up is not None:
        horizontal, vertical = max(east, north), up
    elif stated is not None:
        horizontal = stated
        vertical = xmp_number(xmp, "Camera:GPSZAccuracy", 1e-4, 1e4) or VERTICAL_OVER_HORIZONTAL * stated
    elif gps.horizontal_error_m is not None:
        horizontal, vertical = gps.horizontal_error_m, VERTICAL_OVER_HORIZONTAL * gps.horizontal_error_m
    return max(horizontal, LEAST_SIGMA_M), max(vertical, LEAST_SIGMA_M)


def _exif_altitude(gps: Gps) -> float | None:
    altitude = gps.altitude_m
    if altitude is None or not ALTITUDE_BOUNDS_M[0] <= altitude <= ALTITUDE_BOUNDS_M[1]:
        return None
    return altitude


def _xmp_altitude(xmp: Mapping[str, str]) -> float | None:
    return xmp_number(xmp, "drone-dji:AbsoluteAltitude", *ALTITUDE_BOUNDS_M)


def _xmp_gps(xmp: Mapping[str, str]) -> Gps | None:
    """The position that XMP states; DJI spells the longitude both ways."""
    latitude = xmp_number(xmp, "drone-dji:GpsLatitude", -1e6, 1e6)
    longitude = xmp_number(xmp, "drone-dji:GpsLongitude", -1e6, 1e6)
    if longitude is None:
        longitude = xmp_number(xmp, "drone-dji:GpsLongtitude", -1e6, 1e6)
    if latitude is None or longitude is None:
        return None
    return Gps(latitude, longitude, void=xmp.get("drone-dji:GpsStatus", "").casefold() == "invalid")
