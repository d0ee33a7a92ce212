"""A photo's EXIF, from untrusted bytes: every value is checked, and an invalid one is None."""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from PIL import ExifTags, Image

TAG = ExifTags.Base
GPS = ExifTags.GPS
MAX_TEXT_CHARS = 64
MAX_SIDE_PX = 1_000_000
MM_PER_FOCAL_PLANE_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # EXIF 2.32, FocalPlaneResolutionUnit; 4, 5 by TIFF/EP
BELOW_SEA_LEVEL = (1, 3)  # GPSAltitudeRef: below sea level; EXIF 3.0 adds 3, below the ellipsoid
NO_FIX = "V"  # GPSStatus of a receiver without a fix
# Names of datums that are 50 m or more off WGS84; EXIF 2.32 itself names TOKYO. Others are metres off, or no datum.
FAR_DATUMS: tuple[str, ...] = ("TOKYO", "NAD27", "NAD1927", "ED50", "OSGB", "PULKOVO", "AGD66", "AGD84", "DHDN")
FAR_DATUMS += ("POTSDAM", "CH1903", "NTF", "GCJ02", "BD09", "BEIJING", "XIAN", "INDIAN", "ARC19", "CAPE")
SIXTY = 60.0  # minutes in a degree; 60 itself is what 59.9999 is rounded to
WHOLE = 1e-6  # largest deviation from a whole number: fractions of large terms
LATITUDE_SIGNS = {"N": 1.0, "S": -1.0}  # first letters of GPSLatitudeRef; some programs write whole words
LONGITUDE_SIGNS = {"E": 1.0, "W": -1.0}


@dataclass(frozen=True)
class Gps:
    """A position as EXIF states it: NaN where a value is present but invalid; not yet checked for plausibility.

    Attributes:
        latitude: Degrees north, WGS84.
        longitude: Degrees east, WGS84.
        altitude_m: Metres above the reference that GPSAltitudeRef names (sea level), or None.
        horizontal_error_m: GPSHPositioningError, or None.
        void: Whether the receiver reported that it had no fix.
        hemispheres: Whether both hemispheres are stated, by their tags or by a sign; else they are read as north and
            east.
        datum: GPSMapDatum if it is one that is far from WGS84; else empty.
    """

    latitude: float
    longitude: float
    altitude_m: float | None = None
    horizontal_error_m: float | None = None
    void: bool = False
    hemispheres: bool = True
    datum: str = ""


@dataclass(frozen=True)
class Exif:
    """The tags that photogrammetry uses.

    Attributes:
        make: Without NULs and surrounding blanks; empty when unknown.
        model: Likewise.
        orientation: 1 to 8; 1 when unknown.
        time: ISO 8601 local time, or None.
        focal_mm: Focal length, or None.
        focal_35mm: Rounded 35 mm equivalent, or None.
        focal_plane_px_per_mm: FocalPlaneXResolution per millimetre, or None.
        width: The image's width as taken (PixelXDimension), or None.
        height: Likewise.
        gps: Position, or None when EXIF has none.
        serial: Serial number of the camera body; empty when unknown.
        exposure_ev: Exposure value at ISO 100, from shutter, aperture and sensitivity, or None.
    """

    make: str = ""
    model: str = ""
    orientation: int = 1
    time: str | None = None
    focal_mm: float | None = None
    focal_35mm: float | None = None
    focal_plane_px_per_mm: float | None = None
    width: int | None = None
    height: int | None = None
    gps: Gps | None = None
    serial: str = ""
    exposure_ev: float | None = None


def read_exif(picture: Image.Image) -> Exif:
    """Read an image's EXIF; never raises, and leaves what cannot be read at its default.

    Args:
        picture: Opened and not yet loaded (on loading, Pillow rotates a TIFF and drops its orientation).
    """
    base = _tags(picture, None)
    tags = {**base, **_tags(picture, ExifTags.IFD.Exif)}
    orientation = _number(base.get(TAG.Orientation), 1, 8)
    width = _number(tags.get(TAG.ExifImageWidth), 1, MAX_SIDE_PX)
    height = _number(tags.get(TAG.ExifImageHeight), 1, MAX_SIDE_PX)
    return Exif(
        make=_text(base.get(TAG.Make)),
        model=_text(base.get(TAG.Model)),
        orientation=int(orientation) if orientation is not None else 1,
        time=_time(tags),
        focal_mm=_number(tags.get(TAG.FocalLength), 0.1, 10_000),
        focal_35mm=_number(tags.get(TAG.FocalLengthIn35mmFilm), 1, 10_000),
        focal_plane_px_per_mm=_focal_plane(tags),
        width=int(width) if width is not None else None,
        height=int(height) if height is not None else None,
        gps=_gps(_tags(picture, ExifTags.IFD.GPSInfo)),
        serial=_text(tags.get(TAG.BodySerialNumber)),
        exposure_ev=_exposure_ev(tags),
    )


def _tags(picture: Image.Image, ifd: int | None) -> dict[int, Any]:
    try:
        exif = picture.getexif()
        return dict(exif.items()) if ifd is None else dict(exif.get_ifd(ifd).items())
    except Exception:  # Pillow's reader raises almost anything on hostile EXIF; the photo itself may be good
        return {}


def _number(value: Any, low: int | float, high: int | float) -> float | None:
    """A finite number within bounds, else None; a sequence of one element counts as that element."""
    if isinstance(value, (tuple, list)) and len(value) == 1:
        value = value[0]
    if isinstance(value, (str, bytes, bool)) or value is None:
        return None
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and low <= number <= high else None


def _text(value: Any) -> str:
    """A short text without NULs, control characters and surrounding blanks."""
    if isinstance(value, bytes):
        value = value.decode("ascii", errors="replace")
    if not isinstance(value, str):
        return ""
    kept = "".join(sign if sign.isprintable() else " " for sign in value.partition("\0")[0])
    return " ".join(kept.split())[:MAX_TEXT_CHARS]


def _time(tags: Mapping[int, Any]) -> str | None:
    for tag, fraction in (
        (TAG.DateTimeOriginal, TAG.SubsecTimeOriginal),
        (TAG.DateTimeDigitized, TAG.SubsecTimeDigitized),
        (TAG.DateTime, TAG.SubsecTime),
    ):
        try:
            time = datetime.datetime.strptime(_text(tags.get(tag)), "%Y:%m:%d %H:%M:%S")
        except ValueError:
            continue
        digits = _text(tags.get(fraction))
        decimals = f".{digits[:6]}" if digits.isascii() and digits.isdigit() else ""
        return time.isoformat() + decimals
    return None


def _exposure_ev(tags: Mapping[int, Any]) -> float | None:
    """log2(N²/t) - log2(S/100), as EXIF 2.32 (annex C, APEX) defines it."""
    seconds = _number(tags.get(TAG.ExposureTime), 1e-7, 1e4)
    aperture = _number(tags.get(TAG.FNumber), 0.1, 1e3)
    speed = _number(tags.get(TAG.ISOSpeedRatings), 1, 1e7)
    if seconds is None or aperture is None or speed is None:
        return None
    return math.log2(aperture**2 / seconds) - math.log2(speed / 100.0)


def _focal_plane(tags: Mapping[int, Any]) -> float | None:
    resolution = _number(tags.get(TAG.FocalPlaneXResolution), 1e-6, 1e9)
    unit = _number(tags.get(TAG.FocalPlaneResolutionUnit), 2, 5)
    if resolution is None:
        return None
    return resolution / MM_PER_FOCAL_PLANE_UNIT.get(int(unit) if unit is not None else 2, 25.4)


def _gps(tags: Mapping[int, Any]) -> Gps | None:
    if GPS.GPSLatitude not in tags or GPS.GPSLongitude not in tags:
        return None
    altitude = _number(tags.get(GPS.GPSAltitude), -1e9, 1e9)
    reference = tags.get(GPS.GPSAltitudeRef)
    if isinstance(reference, bytes):
        reference = reference[0] if reference else 0
    if altitude is not None and reference in BELOW_SEA_LEVEL:
        altitude = -abs(altitude)
    latitude, latitude_stated = _degrees(tags[GPS.GPSLatitude], tags.get(GPS.GPSLatitudeRef), LATITUDE_SIGNS)
    longitude, longitude_stated = _degrees(tags[GPS.GPSLongitude], tags.get(GPS.GPSLongitudeRef), LONGITUDE_SIGNS)
    return Gps(
        latitude=latitude,
        longitude=longitude,
        altitude_m=altitude,
        horizontal_error_m=_number(tags.get(GPS.GPSHPositioningError), 1e-4, 1e5),
        void=_text(tags.get(GPS.GPSStatus)).upper() == NO_FIX,
        hemispheres=latitude_stated and longitude_stated,
        datum=_far_datum(_text(tags.get(GPS.GPSMapDatum))),
    )


def _far_datum(name: str) -> str:
    """The name if it is that of a datum far from WGS84, else an empty one."""
    letters = "".join(filter(str.isalnum, name.upper()))
    return name if letters.startswith(FAR_DATUMS) else ""


def _degrees(value: Any, reference: Any, signs: Mapping[str, float]) -> tuple[float, bool]:
    """Convert degrees, minutes, seconds (or fewer of them) to signed degrees.

    A sign of any of them is that of all. Minutes or seconds above 60, and a fraction of a number that others follow,
    are no angle: decimals written as minutes would be kilometres off.

    Args:
        value: The numbers.
        reference: The hemisphere: a word whose first letter counts.
        signs: Of the hemispheres by their first letters.

    Returns:
        The degrees, NaN if they or the hemisphere are invalid; and whether the hemisphere is stated.
    """
    parts = value if isinstance(value, (tuple, list)) else (value,)
    numbers = [_number(part, -1e6, 1e6) for part in parts]
    if not 1 <= len(numbers) <= 3 or any(number is None for number in numbers):
        return math.nan, True
    sizes = [abs(number) for number in numbers if number is not None]
    cut = any(abs(size - round(size)) > WHOLE and any(sizes[at + 1 :]) for at, size in enumerate(sizes))
    if cut or any(size > SIXTY for size in sizes[1:]):
        return math.nan, True
    degrees = 0.0
    for power, size in enumerate(sizes):  # not sum(), which gives other bits since Python 3.12
        degrees += size / 60.0**power
    degrees = -degrees if any(number is not None and number < 0.0 for number in numbers) else degrees
    word = _text(reference).upper()
    if not word:
        return degrees, degrees < 0.0
    sign = signs.get(word[0], math.nan)
    return (degrees if sign > 0.0 else sign * abs(degrees)), True
