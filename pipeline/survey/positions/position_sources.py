"""Which of a photo's own statements can be read as they stand: EXIF's position and altitude, held against XMP's.

EXIF takes precedence over XMP, because corrected positions (PPK) are written back to it. Here are the exceptions: where
EXIF alone shows that it is no measurement (a frozen receiver, a hemisphere that is not stated, an altitude that is
impossible), or where XMP shows which of two readings of EXIF is right.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.metadata.exif import Gps
from splatpipe.pipeline.photos.metadata.xmp import xmp_number

ALTITUDE_BOUNDS_M = (-450.0, 9000.0)  # from the shore of the Dead Sea (-440 m) to above the highest summit
RELATIVE_BOUNDS_M = (-1000.0, 20_000.0)  # heights above take-off, least and largest
NULL_ISLAND_DEG = 1e-6  # receivers without a fix write 0, 0
PLACE_DIGITS = 8  # degrees: positions equal to a millimetre are one position
MIN_REPEATED = 3  # photos at one position: two may have been taken on the spot
MOST_DATUMS_M = 150.0  # vertical datums differ by up to 110 m (geoid) and some metres (levelling)
ELSEWHERE_M = 20.0  # between two sources' positions: too large for a correction, or for a receiver's error
SAME_ALTITUDE_M = 1.0  # two statements of one altitude, but for rounding
TAKEOFF_M = 3.0  # EXIF's altitude less the height above take-off, if it states that
MIN_CAUSE_SHARE, MIN_CAUSE_PHOTOS = 0.8, 6  # share and number of photos that a cause must explain to be acted on


@dataclass(frozen=True)
class SourceDoubts:
    """Photos whose EXIF is not read as it stands, by the reason.

    Attributes:
        frozen: EXIF states one position for most photos, and XMP's vary: XMP's are used.
        no_hemisphere: EXIF does not state north or south, or east or west, and no other source states a position: read
            as north and east.
        by_xmp: Likewise, but XMP states a position, which is used.
        sign: EXIF states an altitude below sea level, and XMP the same above it: read as above.
        above_takeoff: EXIF's altitude is the height above take-off, by XMP, whose altitude is used.
        zero: All photos state an altitude of exactly 0, which is none.
        datum: EXIF names a datum that is far from WGS84, by photo; what it states is read as WGS84.
        impossible_m: Altitudes that are none on Earth, metres, of photos without another one.
    """

    frozen: frozenset[str] = frozenset()
    no_hemisphere: frozenset[str] = frozenset()
    by_xmp: frozenset[str] = frozenset()
    sign: frozenset[str] = frozenset()
    above_takeoff: frozenset[str] = frozenset()
    zero: frozenset[str] = frozenset()
    datum: Mapping[str, str] = field(default_factory=dict)
    impossible_m: Mapping[str, float] = field(default_factory=dict)


def settle_sources(photos: Sequence[CheckedPhoto]) -> tuple[list[CheckedPhoto], SourceDoubts]:
    """Return the photos with EXIF's position as it is to be read, and where that is not as it stands.

    Args:
        photos: As checked.
    """
    by_name = {photo.name: photo for photo in photos}
    frozen = _frozen(photos)
    vague = {each.name for each in photos if _is_usable(each.exif.gps) and not _of(each).hemispheres}
    by_xmp = {name for name in vague if _is_usable(xmp_place(by_name[name].xmp))}
    zero, sign, above_takeoff = _zero(photos), _wrong_sign(photos), _above_takeoff(photos)
    corrected = []
    for photo in photos:
        gps = photo.exif.gps
        if gps is not None:
            name = photo.name
            if name in sign and gps.altitude_m is not None:
                gps = replace(gps, altitude_m=-gps.altitude_m)
            if name in zero | above_takeoff | frozen:
                gps = replace(gps, altitude_m=None)
            if name in frozen | by_xmp:
                gps = replace(gps, void=True)
            photo = replace(photo, exif=replace(photo.exif, gps=gps))
        corrected.append(photo)
    doubts = SourceDoubts(
        frozenset(frozen),
        frozenset(vague - by_xmp),
        frozenset(by_xmp - frozen),
        frozenset(sign),
        frozenset(above_takeoff),
        frozenset(zero),
        {each.name: _of(each).datum for each in corrected if _is_usable(each.exif.gps) and _of(each).datum},
        _impossible(corrected),
    )
    return corrected, doubts


def stated_places(photos: Sequence[CheckedPhoto]) -> dict[str, tuple[float, float]]:
    """Latitude and longitude by photos' own EXIF or, without, XMP, by name; those that neither states are left out."""
    found = {}
    for photo in photos:
        for gps in (xmp_place(photo.xmp), photo.exif.gps):
            if gps is not None and _is_usable(gps):
                found[photo.name] = gps.latitude, gps.longitude
    return found


def is_on_earth(latitude: float, longitude: float) -> bool:
    """Whether a position is plausible: finite, within bounds, and not the 0, 0 of a receiver without a fix."""
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        return False
    if abs(latitude) > 90.0 or abs(longitude) > 180.0:
        return False
    return abs(latitude) > NULL_ISLAND_DEG or abs(longitude) > NULL_ISLAND_DEG


def same_place(latitude: float, longitude: float) -> tuple[float, float]:
    """A key that is equal for positions that are equal to a millimetre."""
    return round(latitude, PLACE_DIGITS), round(longitude, PLACE_DIGITS)


def exif_altitude(gps: Gps | None) -> float | None:
    """EXIF's altitude, metres; None where it states none, or an impossible one."""
    altitude = gps.altitude_m if gps is not None else None
    return altitude if altitude is not None and is_altitude(altitude) else None


def xmp_altitude(xmp: Mapping[str, str]) -> float | None:
    """XMP's altitude, likewise."""
    return xmp_number(xmp, "drone-dji:AbsoluteAltitude", *ALTITUDE_BOUNDS_M)


def relative_altitude(xmp: Mapping[str, str]) -> float | None:
    """The height above take-off by the drone, metres, or None."""
    return xmp_number(xmp, "drone-dji:RelativeAltitude", *RELATIVE_BOUNDS_M)


def is_altitude(altitude_m: float) -> bool:
    """Whether a photo can have been taken at this altitude."""
    return ALTITUDE_BOUNDS_M[0] <= altitude_m <= ALTITUDE_BOUNDS_M[1]


def xmp_place(xmp: Mapping[str, str]) -> Gps | None:
    """The position that XMP states; DJI spells the longitude both ways."""
    latitude = xmp_number(xmp, "drone-dji:GpsLatitude", -1e6, 1e6)
    longitude = xmp_number(xmp, "drone-dji:GpsLongitude", -1e6, 1e6)
    if longitude is None:
        longitude = xmp_number(xmp, "drone-dji:GpsLongtitude", -1e6, 1e6)
    if latitude is None or longitude is None:
        return None
    return Gps(latitude, longitude, void=xmp.get("drone-dji:GpsStatus", "").casefold() == "invalid")


def _is_usable(gps: Gps | None) -> bool:
    return gps is not None and not gps.void and is_on_earth(gps.latitude, gps.longitude)


def _of(photo: CheckedPhoto) -> Gps:
    assert photo.exif.gps is not None
    return photo.exif.gps


def _frozen(photos: Sequence[CheckedPhoto]) -> set[str]:
    """Photos that share one EXIF position with most others although XMP's vary."""
    stated = {each.name: _of(each) for each in photos if _is_usable(each.exif.gps)}
    at = {name: same_place(gps.latitude, gps.longitude) for name, gps in stated.items()}
    place, repeated = Counter(at.values()).most_common(1)[0] if at else (None, 0)
    if repeated < MIN_REPEATED or 2 * repeated <= len(at):
        return set()
    group = {name for name, where in at.items() if where == place}
    others = {each.name: xmp_place(each.xmp) for each in photos if each.name in group}
    known = {name: gps for name, gps in others.items() if gps is not None and _is_usable(gps)}
    distinct = {same_place(gps.latitude, gps.longitude) for gps in known.values()}
    return set(known) if len(distinct) >= max(MIN_REPEATED, len(group) / 2) else set()


def _zero(photos: Sequence[CheckedPhoto]) -> set[str]:
    """All photos with an EXIF altitude if each of these is exactly 0: what is written where none is known."""
    stated = {each.name: each.exif.gps.altitude_m for each in photos if each.exif.gps is not None}
    known = {name: altitude for name, altitude in stated.items() if altitude is not None}
    return set(known) if len(known) >= MIN_REPEATED and not any(known.values()) else set()


def _pairs(photos: Sequence[CheckedPhoto]) -> dict[str, tuple[float, float]]:
    """EXIF's altitude, whatever it is, and XMP's, of the photos that state both."""
    pairs = {}
    for photo in photos:
        altitude = photo.exif.gps.altitude_m if photo.exif.gps is not None else None
        other = xmp_altitude(photo.xmp)
        if altitude is not None and other is not None:
            pairs[photo.name] = (altitude, other)
    return pairs


def _wrong_sign(photos: Sequence[CheckedPhoto]) -> set[str]:
    """Photos whose EXIF altitude agrees with XMP's only with the other sign.

    Two datums can look alike near sea level (-20 m above the ellipsoid, 20 m above the sea). So close to it both must
    be equal but for the sign, and, over all photos, rise together less well as stated than with the other sign.
    """
    pairs = _pairs(photos)
    apart = {name: (abs(exif - xmp), abs(exif + xmp)) for name, (exif, xmp) in pairs.items()}
    wrong = {name for name, (stated, turned) in apart.items() if stated > MOST_DATUMS_M and turned <= MOST_DATUMS_M / 2}
    wrong = {name for name in wrong if 4.0 * apart[name][1] < apart[name][0]}
    near = {name for name, (stated, turned) in apart.items() if turned <= SAME_ALTITUDE_M < stated / 2.0}
    if near and len(near) >= MIN_CAUSE_SHARE * len(pairs):
        values = np.array([pairs[name] for name in near])
        if np.std(values[:, 0] + values[:, 1]) <= np.std(values[:, 0] - values[:, 1]):
            wrong |= near
    return wrong


def _above_takeoff(photos: Sequence[CheckedPhoto]) -> set[str]:
    """Photos whose EXIF altitude is the height above take-off, if that explains nearly all of them."""
    heights = {each.name: relative_altitude(each.xmp) for each in photos}
    far = {name: exif for name, (exif, xmp) in _pairs(photos).items() if abs(exif - xmp) > MOST_DATUMS_M}
    explained = {
        name for name, exif in far.items() if (height := heights[name]) is not None and abs(exif - height) <= TAKEOFF_M
    }
    return explained if len(explained) >= max(MIN_CAUSE_PHOTOS, MIN_CAUSE_SHARE * len(far)) else set()


def _impossible(photos: Sequence[CheckedPhoto]) -> dict[str, float]:
    found = {}
    for photo in photos:
        altitude = photo.exif.gps.altitude_m if photo.exif.gps is not None else None
        if altitude is None:
            altitude = xmp_number(photo.xmp, "drone-dji:AbsoluteAltitude", -1e9, 1e9)
        if altitude is not None and not is_altitude(altitude) and xmp_altitude(photo.xmp) is None:
            found[photo.name] = altitude
    return found
