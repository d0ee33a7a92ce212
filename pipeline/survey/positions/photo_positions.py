"""Each photo's position and camera angles, and their accuracies.

Each value comes from the first of three sources that states it: the position file, EXIF (where corrected positions are
written back; ``position_sources`` has the exceptions), XMP. Angles are from the file, then the gimbal's in XMP, then
the ``Camera:`` tags. Accuracies are from the file, then XMP, then EXIF, else the default for the type of fix.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.photos.files.names import printable
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.metadata.camera_angles import Convention, detect_convention, gimbal_from_nadir
from splatpipe.pipeline.photos.metadata.exif import Gps
from splatpipe.pipeline.photos.metadata.position_outliers import find_misplaced, median_distance_m
from splatpipe.pipeline.photos.metadata.xmp import xmp_number
from splatpipe.pipeline.survey.crs.crs_names import ELLIPSOIDAL, UNKNOWN, parse_vertical
from splatpipe.pipeline.survey.positions.flight_steps import seconds_of
from splatpipe.pipeline.survey.positions.flights import Stamp, assign_flights
from splatpipe.pipeline.survey.positions.position_sources import (
    ELSEWHERE_M,
    MIN_REPEATED,
    SourceDoubts,
    exif_altitude,
    is_on_earth,
    relative_altitude,
    same_place,
    settle_sources,
    xmp_altitude,
    xmp_place,
)
from splatpipe.pipeline.survey.positions.stated_positions import FilePlace

FIXED, SINGLE = 50, 16  # drone-dji:RtkFlag (DJI's user manuals); 32 to 49 are kinds of float
FLOAT = range(32, 50)
# Horizontal (per axis) and vertical standard deviations, metres, where a photo does not state its own.
DEFAULT_SIGMAS_M = {"fixed": (0.02, 0.03), "float": (0.5, 1.0), "single": (3.0, 5.0), None: (3.0, 5.0)}
MIN_SIGMA_M = 0.005  # smaller stated accuracies are the receiver's noise, not the accuracy of the camera's position
VERTICAL_OVER_HORIZONTAL = 1.5  # ratio of GNSS errors, where only the horizontal one is stated
BAROMETER_SIGMA_M = 1.0  # sigma of heights above take-off, whatever the receiver's accuracy
DATUM_STEP_M = 1.0  # EXIF and XMP altitudes further apart than this are not roundings of one value
NOWHERE = "states a position that is none on Earth"


@dataclass(frozen=True)
class Position:
    """A photo's position and angles; angles are degrees, yaw clockwise from north, pitch -90 straight down.

    Attributes:
        name: The photo.
        latitude: Degrees north, WGS84.
        longitude: Degrees east, WGS84.
        altitude_m: As stated; None when there is none.
        altitude_source: ``file``, ``exif``, ``xmp``, or ``takeoff``: no photo of the capture states an altitude, and
            this is the height above the take-off point. None when there is none.
        relative_altitude_m: Above the take-off point, by the drone.
        sigma_horizontal_m: Standard deviation in east and in north each.
        sigma_vertical_m: Standard deviation of the altitude.
        rtk: ``fixed``, ``float``, ``single``; None when the drone does not state it.
        yaw_deg: Of the camera (gimbal).
        pitch_deg: Likewise.
        roll_deg: Likewise.
        flight_yaw_deg: Of the aircraft.
        flight_pitch_deg: Likewise.
        flight_roll_deg: Likewise.
        orientation: EXIF's, 1 to 8: how the stored grid was turned when the camera was upright.
        source: Of latitude and longitude: ``file``, ``exif`` or ``xmp``.
        sigma_source: Of the standard deviations: ``file``, ``xmp``, ``exif``, or ``default``.
        vertical: Datum of the altitude: ``ellipsoidal``, ``EPSG:n`` or ``unknown``. EXIF's AltitudeRef declares none.
        flight: Number of the flight, from 0: photos of one flight share their receiver's error.
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
    source: str = "exif"
    sigma_source: str = "default"
    vertical: str = UNKNOWN
    flight: int = 0


@dataclass(frozen=True)
class PositionList:
    """The positions of all photos that state one.

    Attributes:
        positions: Sorted by the photos' names.
        wrong: Why a stated position is unusable, by photo: the end of a sentence that starts with the photo's name.
        altitude_step_m: Median of EXIF's altitude less XMP's where both are given, else None.
        orientations: EXIF orientation of every photo where it is not 1, by name.
        doubts: Where EXIF was not read as it stands.
        elsewhere: Median distance in metres between the positions and those of a source (``exif``, ``xmp``) that is not
            used, where it is too large for a correction.
        file_step_m: Median of the file's altitudes less the photos' own, of EXIF or else XMP, where both are given.
    """

    positions: tuple[Position, ...]
    wrong: Mapping[str, str]
    altitude_step_m: float | None
    orientations: Mapping[str, int]
    doubts: SourceDoubts = field(default_factory=SourceDoubts)
    elsewhere: Mapping[str, float] = field(default_factory=dict)
    file_step_m: float | None = None

    @property
    def impossible(self) -> tuple[str, ...]:
        """Photos whose position cannot be on Earth."""
        return tuple(name for name, reason in self.wrong.items() if reason == NOWHERE)


def read_positions(photos: Sequence[CheckedPhoto], places: Mapping[str, FilePlace] | None = None) -> PositionList:
    """Read positions and angles from the photos' metadata and from the position file.

    Args:
        photos: The photos in use, sorted by name.
        places: Entries of the position file, by photo.
    """
    found: list[Position] = []
    stamps: list[Stamp] = []
    wrong: dict[str, str] = {}
    steps: list[float] = []
    file_steps: list[float] = []
    others: dict[str, list[tuple[Gps, Gps]]] = {"exif": [], "xmp": []}
    conventions = _conventions(photos)
    photos, doubts = settle_sources(photos)
    for photo in photos:
        place = (places or {}).get(photo.name)
        sources = {"file": _file_gps(place), "exif": photo.exif.gps, "xmp": xmp_place(photo.xmp)}
        stated = {source: gps for source, gps in sources.items() if gps is not None and not gps.void}
        good = {source: gps for source, gps in stated.items() if is_on_earth(gps.latitude, gps.longitude)}
        if stated and not good:
            wrong[photo.name] = NOWHERE
        if not good:
            continue
        source, gps = next(iter(good.items()))
        position = _position(photo, gps, source, place)
        for other in others.keys() & good.keys() - {source}:
            others[other].append((gps, good[other]))
        yaw, pitch, roll = _angles(photo, place, conventions.get(_camera(photo), "nadir"))
        position = replace(position, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)
        found.append(position)
        stamps.append(_stamp(photo, position))
        ours, theirs = exif_altitude(photo.exif.gps), xmp_altitude(photo.xmp)
        if ours is not None and theirs is not None:
            steps.append(ours - theirs)
        own = theirs if ours is None else ours
        if position.altitude_source == "file" and position.altitude_m is not None and own is not None:
            file_steps.append(position.altitude_m - own)
    found = _above_takeoff(found)
    wrong |= _repeated(found, photos)
    wrong |= find_misplaced({each.name: (each.latitude, each.longitude) for each in found})
    flights = assign_flights(stamps)
    numbered = [replace(each, flight=flight) for each, flight in zip(found, flights, strict=True)]
    return PositionList(
        tuple(each for each in numbered if each.name not in wrong),
        dict(sorted(wrong.items())),
        float(np.median(steps)) if steps else None,
        {photo.name: photo.exif.orientation for photo in photos if photo.exif.orientation != 1},
        doubts,
        _elsewhere(others),
        float(np.median(file_steps)) if file_steps else None,
    )


def _elsewhere(others: Mapping[str, Sequence[tuple[Gps, Gps]]]) -> dict[str, float]:
    """How far positions of each source lie from those used, where that is another place."""
    apart = {
        source: median_distance_m(
            *([(gps.latitude, gps.longitude) for gps in side] for side in zip(*pairs, strict=True))
        )
        for source, pairs in others.items()
        if len(pairs) >= MIN_REPEATED
    }
    return {source: metres for source, metres in apart.items() if metres > ELSEWHERE_M}


def _above_takeoff(found: Sequence[Position]) -> list[Position]:
    """Positions with heights above take-off as altitudes, if none has an altitude: they at least agree mutually."""
    if any(each.altitude_m is not None for each in found):
        return list(found)
    return [
        each
        if each.relative_altitude_m is None
        else replace(
            each,
            altitude_m=each.relative_altitude_m,
            altitude_source="takeoff",
            sigma_vertical_m=max(each.sigma_vertical_m, BAROMETER_SIGMA_M),
        )
        for each in found
    ]


def _repeated(found: Sequence[Position], photos: Sequence[CheckedPhoto]) -> dict[str, str]:
    """Photos that repeat one position which most photos state, where the others state several.

    A receiver that lost its fix repeats the last one. The first such photo may be right; the others, as a majority,
    would make any fit contract the model to a point.
    """
    times = {photo.name: photo.exif.time or "" for photo in photos}
    by_place: dict[tuple[float, float], list[str]] = {}
    for each in found:
        if each.source != "file":
            by_place.setdefault(same_place(each.latitude, each.longitude), []).append(each.name)
    largest = max(by_place.values(), key=len, default=[])
    if len(largest) < MIN_REPEATED or 2 * len(largest) <= len(found) or len(by_place) < MIN_REPEATED:
        return {}
    first, *others = sorted(largest, key=lambda name: (times[name], name))
    return dict.fromkeys(others, f"repeats the position of {printable(first)}")


def positions_json(positions: PositionList) -> JSON:
    """The contents of ``positions.json``."""
    value = {
        "positions": [asdict(position) for position in positions.positions],
        "orientations": dict(positions.orientations),
    }
    doubtful = {"wrong": dict(positions.wrong), "elsewhere": dict(positions.elsewhere)}
    return value | {key: entries for key, entries in doubtful.items() if entries}


def _position(photo: CheckedPhoto, gps: Gps, source: str, place: FilePlace | None) -> Position:
    """The photo's position without its angles."""
    xmp = photo.xmp
    altitudes = {
        "file": place.altitude_m if place is not None else None,
        # Post-processed positions (PPK) are written to EXIF, so it takes precedence over XMP.
        "exif": exif_altitude(photo.exif.gps),
        "xmp": xmp_altitude(xmp),
    }
    altitude_source = next((name for name, altitude in altitudes.items() if altitude is not None), None)
    rtk = _rtk(xmp)
    sigma_source, horizontal, vertical = _sigmas(photo, rtk, place)
    return Position(
        name=photo.name,
        latitude=gps.latitude,
        longitude=gps.longitude,
        altitude_m=altitudes[altitude_source] if altitude_source else None,
        altitude_source=altitude_source,
        relative_altitude_m=relative_altitude(xmp),
        sigma_horizontal_m=horizontal,
        sigma_vertical_m=vertical,
        rtk=rtk,
        yaw_deg=None,
        pitch_deg=None,
        roll_deg=None,
        flight_yaw_deg=xmp_number(xmp, "drone-dji:FlightYawDegree", -720.0, 720.0),
        flight_pitch_deg=xmp_number(xmp, "drone-dji:FlightPitchDegree", -180.0, 180.0),
        flight_roll_deg=xmp_number(xmp, "drone-dji:FlightRollDegree", -360.0, 360.0),
        orientation=photo.exif.orientation,
        source=source,
        sigma_source=sigma_source,
        vertical=_vertical(xmp, rtk, place if altitude_source == "file" else None, altitude_source),
    )


def _rtk(xmp: Mapping[str, str]) -> str | None:
    flag = xmp_number(xmp, "drone-dji:RtkFlag", 0, 255)
    if flag is None:
        return None
    return "fixed" if flag == FIXED else "float" if flag in FLOAT else "single" if flag == SINGLE else None


def _vertical(xmp: Mapping[str, str], rtk: str | None, place: FilePlace | None, source: str | None) -> str:
    """The vertical datum declared by the file's CRS, by RTK or by Pix4D's tags."""
    if place is not None:
        return place.vertical
    if source is None:
        return UNKNOWN
    if rtk in ("fixed", "float") and xmp.get("drone-dji:AltitudeType", "").casefold() == "rtkalt":
        return ELLIPSOIDAL  # DJI's developer guide on altitudes: RTK's are ellipsoidal heights
    try:
        return parse_vertical(xmp.get("Camera:VertCS", UNKNOWN))
    except SplatpipeError:
        return UNKNOWN


def _camera(photo: CheckedPhoto) -> tuple[str, str]:
    return photo.exif.make, photo.exif.model


def _conventions(photos: Sequence[CheckedPhoto]) -> dict[tuple[str, str], Convention]:
    """The zero of each camera's ``Camera:Pitch``."""
    pitches: dict[tuple[str, str], list[float]] = {}
    for photo in photos:
        pitch = xmp_number(photo.xmp, "Camera:Pitch", -360.0, 360.0)
        if pitch is not None:
            pitches.setdefault(_camera(photo), []).append(pitch)
    return {camera: detect_convention(values) for camera, values in pitches.items()}


def _angles(
    photo: CheckedPhoto, place: FilePlace | None, convention: Convention
) -> tuple[float | None, float | None, float | None]:
    xmp = photo.xmp
    yaw, pitch, roll = (
        xmp_number(xmp, f"drone-dji:Gimbal{name}Degree", -limit, limit)
        for name, limit in (("Yaw", 720.0), ("Pitch", 180.0), ("Roll", 360.0))
    )
    if place is not None and place.angles_deg is not None:
        yaw, pitch, roll = place.angles_deg
    elif yaw is None and pitch is None:
        yaw, pitch, roll = (xmp_number(xmp, f"Camera:{name}", -720.0, 720.0) for name in ("Yaw", "Pitch", "Roll"))
        if convention == "nadir" and yaw is not None and pitch is not None:
            yaw, pitch, roll = gimbal_from_nadir(yaw, pitch, roll or 0.0)
    return yaw, pitch, roll


def _sigmas(photo: CheckedPhoto, rtk: str | None, place: FilePlace | None) -> tuple[str, float, float]:
    """Source of the standard deviations, then horizontal and vertical in metres."""
    xmp, exif = photo.xmp, photo.exif.gps
    east = xmp_number(xmp, "drone-dji:RtkStdLon", 1e-6, 1000.0)
    north = xmp_number(xmp, "drone-dji:RtkStdLat", 1e-6, 1000.0)
    up = xmp_number(xmp, "drone-dji:RtkStdHgt", 1e-6, 1000.0)
    stated = xmp_number(xmp, "Camera:GPSXYAccuracy", 1e-4, 1e4)
    source = "default"
    horizontal, vertical = DEFAULT_SIGMAS_M[rtk]
    if east is not None and north is not None and up is not None:
        source, horizontal, vertical = "xmp", max(east, north), up
    elif stated is not None:
        above = xmp_number(xmp, "Camera:GPSZAccuracy", 1e-4, 1e4)
        source, horizontal, vertical = "xmp", stated, above or VERTICAL_OVER_HORIZONTAL * stated
    elif exif is not None and exif.horizontal_error_m is not None:
        source, horizontal = "exif", exif.horizontal_error_m
        vertical = VERTICAL_OVER_HORIZONTAL * horizontal
    if place is not None and place.sigma_m[0] is not None:
        source, horizontal = "file", place.sigma_m[0]
        vertical = place.sigma_m[1] or VERTICAL_OVER_HORIZONTAL * horizontal
    return source, max(horizontal, MIN_SIGMA_M), max(vertical, MIN_SIGMA_M)


def _stamp(photo: CheckedPhoto, position: Position) -> Stamp:
    xmp = photo.xmp
    serial = xmp.get("drone-dji:DroneSerialNumber") or photo.exif.serial or " ".join(_camera(photo))
    device = (position.source, position.altitude_source or "", serial, xmp.get("Camera:FlightUUID", ""))
    takeoff = math.nan
    if position.altitude_m is not None and position.relative_altitude_m is not None:
        takeoff = position.altitude_m - position.relative_altitude_m
    return Stamp(device, seconds_of(photo.exif.time), takeoff)


def _file_gps(place: FilePlace | None) -> Gps | None:
    return None if place is None else Gps(place.latitude, place.longitude)
