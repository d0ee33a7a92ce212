"""Parse coordinate reference systems as named in surveyors' files and options; input may be hostile, so is limited."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cache

import pyproj
from pyproj.exceptions import CRSError

from splatpipe.pipeline.engine.errors import SplatpipeError

ELLIPSOIDAL = "ellipsoidal"
UNKNOWN = "unknown"
LONGEST_TEXT = 500  # characters; the longest PROJ strings in use have some 200
FORMS = "State it as EPSG:25832, EPSG:25832+7837 (with its heights), +proj=… or WGS84 UTM 32N."
# fmt: off
PROJ_KEYS = frozenset((
    "proj", "zone", "south", "datum", "ellps", "a", "b", "rf", "f", "R", "units", "to_meter", "lat_0", "lat_1",
    "lat_2", "lat_ts", "lon_0", "lonc", "alpha", "gamma", "k", "k_0", "x_0", "y_0", "towgs84", "nadgrids", "no_defs",
    "type", "wktext", "pm", "axis", "no_uoff", "vunits", "approx", "over"
))
# fmt: on
HEIGHT_UNITS_M = {"m": 1.0, "ft": 0.3048, "us-ft": 1200.0 / 3937.0}
LIKE_WGS84 = ("WGS84", "GRS80")  # ellipsoids within a tenth of a millimetre of each other

_EPSG = re.compile(r"EPSG\s*:\s*(\d{1,6})(?:\s*\+\s*(?:EPSG\s*:\s*)?(\d{1,6}))?", re.IGNORECASE | re.ASCII)
_UTM = re.compile(r"WGS\s?84\s*/?\s*UTM\s*(?:zone\s*)?(\d{1,2})\s*([NS])", re.IGNORECASE | re.ASCII)
_WGS84 = re.compile(r"WGS[ _]?(?:19)?84", re.IGNORECASE)


@dataclass(frozen=True)
class Crs:
    """A projected or geographic CRS, with what is known about its heights.

    Attributes:
        text: Its shortest form; ``parse_crs`` accepts it again.
        name: Human-readable name.
        vertical: Datum of its heights: ``ellipsoidal``, ``EPSG:n`` of a vertical CRS, or ``unknown``.
        height_unit_m: Unit of its heights in metres.
        area: Area of use: west, south, east, north in degrees; None where not stated.
        assumed: What was assumed where its text is incomplete: a sentence, or empty.
        horizontal: The pyproj CRS, with heights above its own ellipsoid.
    """

    text: str
    name: str
    vertical: str
    height_unit_m: float
    area: tuple[float, float, float, float] | None
    assumed: str
    horizontal: pyproj.CRS = field(repr=False, compare=False)

    @property
    def is_geographic(self) -> bool:
        """Whether its coordinates are degrees, longitude first."""
        return bool(self.horizontal.is_geographic)

    @property
    def unit_m(self) -> float:
        """Unit of eastings and northings in metres; 1 for degrees."""
        return 1.0 if self.is_geographic else float(self.horizontal.axis_info[0].unit_conversion_factor)


def parse_crs(text: str) -> Crs:
    """Read a CRS as surveyors' files and options name it.

    Args:
        text: ``EPSG:n``, ``EPSG:n+m`` (m: its heights), ``+proj=…``, ``WGS84 UTM 33N`` or ``WGS 84`` (degrees).

    Raises:
        SplatpipeError: if it has none of these forms, is unknown to PROJ, or is neither projected nor geographic.
    """
    text = " ".join(text.split()) if len(text) <= LONGEST_TEXT else text
    if len(text) > LONGEST_TEXT or not text.isascii() or not text.isprintable():
        raise SplatpipeError("The coordinate reference system is not in a known form.", FORMS)
    if match := _EPSG.fullmatch(text):
        return _from_epsg(*match.groups())
    if match := _UTM.fullmatch(text):
        zone, side = int(match[1]), match[2].upper()
        if not 1 <= zone <= 60:
            raise SplatpipeError(f"There is no UTM zone {zone}.", "UTM has the zones 1 to 60.")
        return _from_epsg(str((32600 if side == "N" else 32700) + zone), None)
    if _WGS84.fullmatch(text):
        return _from_epsg("4326", None)
    if text.startswith("+"):
        return _from_proj(text)
    raise SplatpipeError(f'"{text}" is not a coordinate reference system in a known form.', FORMS)


def parse_vertical(text: str) -> str:
    """Read a vertical datum: ``ellipsoidal``, ``unknown`` or ``EPSG:n`` of a vertical CRS in metres or feet, upwards.

    Raises:
        SplatpipeError: if it is none of these.
    """
    text = text.strip()
    if text.lower() in (ELLIPSOIDAL, UNKNOWN):
        return text.lower()
    hint = "State it as ellipsoidal, unknown, or EPSG:7837 (DHHN2016), EPSG:5703 (NAVD88), EPSG:5773 (EGM96)."
    match = _EPSG.fullmatch(text) if len(text) <= LONGEST_TEXT else None
    if match is None or match[2]:
        raise SplatpipeError(f'"{text[:60]}" is not a vertical datum.', hint)
    crs = _authority(match[1])
    if not crs.is_vertical:
        raise SplatpipeError(f"EPSG:{match[1]} ({crs.name}) is not a vertical datum.", hint)
    _height_unit(crs)
    return f"EPSG:{int(match[1])}"


def checked(text: str, kind: str) -> str:
    """The shortest form of a CRS (``kind`` is ``crs``) or of a vertical datum, for a configuration's validator.

    Raises:
        ValueError: if the text is invalid; includes the hint.
    """
    try:
        return parse_crs(text).text if kind == "crs" else parse_vertical(text)
    except SplatpipeError as error:
        raise ValueError(f"{error.message} {error.hint}".rstrip(".")) from error


def utm_of(latitude: float, longitude: float) -> Crs:
    """The UTM zone (WGS 84) of a place, by EPSG's bounds of 6°; beyond 84° N and 80° S the polar stereographic UPS."""
    if latitude > 84.0 or latitude < -80.0:
        return _from_epsg("5041" if latitude > 0.0 else "5042", None)
    zone = int((longitude + 180.0) // 6.0) % 60 + 1
    return _from_epsg(str((32600 if latitude >= 0.0 else 32700) + zone), None)


def same_datum(a: str, b: str) -> bool:
    """Whether two vertical datums are the same, possibly in different units (NAVD88 in metres and in feet)."""
    if a == b or not (a.startswith("EPSG:") and b.startswith("EPSG:")):
        return a == b
    datums = [_authority(text.removeprefix("EPSG:")).datum for text in (a, b)]
    return datums[0] is not None and datums[1] is not None and datums[0].name == datums[1].name


def describe_vertical(vertical: str) -> str:
    """A vertical datum in human-readable form."""
    return (
        f"{vertical} ({_authority(vertical.removeprefix('EPSG:')).name})" if vertical.startswith("EPSG:") else vertical
    )


def _from_epsg(code: str, heights: str | None) -> Crs:
    crs = _authority(code)
    vertical, unit_m = UNKNOWN, 1.0
    horizontal = crs
    if crs.is_compound:
        horizontal, upper = crs.sub_crs_list[0], crs.sub_crs_list[1]
        authority = upper.to_authority()
        vertical, unit_m = (f"EPSG:{authority[1]}" if authority else UNKNOWN), _height_unit(upper)
    elif len(crs.axis_info) == 3 and not crs.is_geocentric:
        vertical = ELLIPSOIDAL
    elif crs.is_projected:  # eastings in feet imply heights in feet
        unit_m = float(crs.axis_info[0].unit_conversion_factor)
    text, name = f"EPSG:{int(code)}", crs.name
    if heights is not None:
        if vertical != UNKNOWN:
            raise SplatpipeError(f"{text} ({name}) already has a vertical datum.", f"Give {text} alone.")
        vertical = parse_vertical(f"EPSG:{heights}")
        upper = _authority(heights)
        unit_m, text, name = _height_unit(upper), f"{text}+{int(heights)}", f"{name} + {upper.name}"
    if not (horizontal.is_projected or horizontal.is_geographic):
        raise SplatpipeError(f"{text} ({name}) is neither a projected nor a geographic CRS.", FORMS)
    use = horizontal.area_of_use
    area = None if use is None else (use.west, use.south, use.east, use.north)
    return Crs(text, name, vertical, unit_m, area, "", horizontal.to_3d())


def _from_proj(text: str) -> Crs:
    """Parse a PROJ string with allowed parameters only: some of PROJ's name files, and a pipeline is not a CRS."""
    keys = dict(token.removeprefix("+").partition("=")[::2] for token in text.split(" "))
    if match := _EPSG.fullmatch(keys.get("init", "")):
        return _from_epsg(match[1], match[2])
    if "geoidgrids" in keys:
        raise SplatpipeError(
            "A PROJ string with +geoidgrids is not supported.",
            "Omit it, and state the vertical datum: --set georef.vertical=EPSG:n.",
        )
    wrong = sorted(set(keys) - PROJ_KEYS)
    if wrong or keys.get("nadgrids", "@null") != "@null" or not all(part.startswith("+") for part in text.split(" ")):
        named = f" with +{(wrong or ['nadgrids'])[0][:30]}"
        raise SplatpipeError(f"A PROJ string{named} is not supported.", "Give the CRS by its EPSG code.")
    unit = keys.get("vunits") or keys.get("units", "m")
    kept = [token for token in text.split(" ") if not token.startswith(("+vunits", "+type", "+no_defs"))]
    stated = " ".join([*kept, "+no_defs"])
    assumed = ""
    if keys.get("ellps") in LIKE_WGS84 and not {"datum", "towgs84", "nadgrids"} & set(keys):
        kept.append("+towgs84=0,0,0")
        assumed = "Its datum is not stated and taken for WGS 84."
    try:
        crs = pyproj.CRS(" ".join([*kept, "+no_defs", "+type=crs"]))
    except CRSError as error:
        raise SplatpipeError(f"PROJ does not take the CRS {text[:120]}.", FORMS) from error
    if not (crs.is_projected or crs.is_geographic):
        raise SplatpipeError(f"{text[:120]} is neither a projected nor a geographic CRS.", FORMS)
    unit_m = 1.0 if crs.is_geographic and "vunits" not in keys else HEIGHT_UNITS_M.get(unit, 0.0)
    if unit_m == 0.0:
        raise SplatpipeError(f"The unit {unit[:20]} of {text[:120]} is not known.", "Known are m, ft and us-ft.")
    return Crs(stated, stated, UNKNOWN, unit_m, None, assumed, crs.to_3d())


@cache
def _authority(code: str) -> pyproj.CRS:
    try:
        return pyproj.CRS.from_epsg(int(code))
    except CRSError as error:
        raise SplatpipeError(f"There is no EPSG:{int(code)}.", "Look it up at epsg.org. " + FORMS) from error


def _height_unit(vertical: pyproj.CRS) -> float:
    axis = vertical.axis_info[0]
    if axis.direction != "up":
        raise SplatpipeError(
            f"{vertical.name} counts downwards: depths are not supported.", "Give a vertical datum of heights."
        )
    return float(axis.unit_conversion_factor)
