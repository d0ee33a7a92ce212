"""The options that the node offers: ours, under OpenDroneMap's names where they mean the same. Light to import.

Clients draw a form from them and send what was changed, numbers as text and switches as ``true`` or ``"true"``. A
switch can only be turned on, so every one is off by default. Options that are not offered are dropped without an error,
as NodeODM does, and the task's log names them.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.files.json_file import parse_json
from splatpipe.pipeline.engine.quantities import parse_duration

Kind = Literal["bool", "int", "float", "string", "enum"]

QUALITIES = ("ultra", "high", "medium", "low", "lowest")
PRESETS = ("preview", "standard", "high")
MAX_OPTIONS_CHARACTERS = 2 << 20  # of all options together; a boundary may have many corners
MAX_OPTIONS = 200  # sent by a client; ODM has about a hundred
MAX_BOUNDARY_CHARACTERS = 1 << 20
MAX_TEXT_CHARACTERS = 20_000


class OptionValueError(ValueError):
    """A value that an option does not take; the message is a sentence."""


class WrongOptionsError(ValueError):
    """Options with wrong values.

    Attributes:
        errors: Name of each and what is wrong with it.
    """

    def __init__(self, errors: list[tuple[str, str]]) -> None:
        super().__init__("; ".join(f"{name}: {text}" for name, text in errors))
        self.errors = errors


@dataclass(frozen=True)
class Option:
    """An option as ``/options`` lists it.

    Attributes:
        name: Its name.
        kind: The type of its value.
        default: Its default as text.
        domain: What values it takes: a rule in ODM's words, or the choices of an ``enum``.
        help: What it does.
        check: Converts a value of the right type further; raises OptionValueError.
        listed: Whether ``/options`` has it: only the node's own page knows what to do after the others.
    """

    name: str
    kind: Kind
    default: str
    domain: str | tuple[str, ...]
    help: str
    check: Callable[[Any], Any] = lambda value: value
    listed: bool = True

    def as_json(self) -> dict[str, Any]:
        """The item of ``/options``: clients take exactly these keys, and only a text as value."""
        domain = list(self.domain) if isinstance(self.domain, tuple) else self.domain
        return {"name": self.name, "type": self.kind, "value": self.default, "domain": domain, "help": self.help}

    def typed(self, value: Any) -> Any:
        """The value with the option's type.

        Raises:
            OptionValueError: if it is not one.
        """
        return self.check(_CONVERSIONS[self.kind](value, self.domain))


def _to_bool(value: Any, _domain: object) -> bool:
    if isinstance(value, bool):
        return value
    if isinstance(value, str) and value.strip().lower() in ("true", "false", ""):
        return value.strip().lower() == "true"
    raise OptionValueError("is not true or false")


def _to_float(value: Any, _domain: object) -> float:
    try:
        number = float(value.strip() if isinstance(value, str) else value)
    except (TypeError, ValueError, OverflowError):
        raise OptionValueError("is not a number") from None
    if isinstance(value, bool) or not math.isfinite(number):
        raise OptionValueError("is not a number")
    return number


def _to_int(value: Any, domain: object) -> int:
    number = _to_float(value, domain)
    if number != round(number) or abs(number) > 2**53:
        raise OptionValueError("is not a whole number")
    return int(number)


def _to_text(value: Any, _domain: object) -> str:
    text = json.dumps(value) if isinstance(value, dict | list) else value
    if not isinstance(text, str):
        text = str(value) if isinstance(value, int | float) else ""
    if len(text) > MAX_BOUNDARY_CHARACTERS or any(letter == "\0" or "\ud800" <= letter <= "\udfff" for letter in text):
        raise OptionValueError("is too long, or is no text")
    return text.strip()


def _to_choice(value: Any, domain: object) -> str:
    assert isinstance(domain, tuple)
    if not isinstance(value, str) or value.strip() not in domain:
        raise OptionValueError(f"is not one of: {', '.join(domain)}")
    return value.strip()


_CONVERSIONS: dict[Kind, Callable[[Any, object], Any]] = {
    "bool": _to_bool,
    "int": _to_int,
    "float": _to_float,
    "string": _to_text,
    "enum": _to_choice,
}


def _positive(most: float) -> Callable[[float], float]:
    def check(value: float) -> float:
        if not 0.0 < value <= most:
            raise OptionValueError(f"is not between 0 and {most:g}")
        return value

    return check


def _count(least: int, most: int) -> Callable[[int], int]:
    def check(value: int) -> int:
        if not least <= value <= most:
            raise OptionValueError(f"is not between {least} and {most}")
        return value

    return check


def _short(value: str) -> str:
    if len(value) > MAX_TEXT_CHARACTERS or re.search(r"[\x00-\x1f]", value):
        raise OptionValueError("is too long, or has control characters")
    return value


def _crs(value: str) -> str:
    # `gcp`: WebODM's word for that of the control file
    return _named(value, "crs") if _short(value).lower() not in ("", "gcp", "auto") else "auto"


def _vertical(value: str) -> str:
    return _named(value, "vertical") if _short(value).lower() not in ("", "auto") else "auto"


def _named(value: str, kind: str) -> str:
    """Check a CRS or a vertical datum as the run does, which would say so only after the upload."""
    from splatpipe.pipeline.survey.crs.crs_names import checked  # loads PROJ

    try:
        checked(value, kind)
    except ValueError as error:
        raise OptionValueError(str(error)) from error
    return value


def _duration(value: str) -> str:
    try:
        parse_duration(value, "time-budget")
    except UsageError as error:
        raise OptionValueError(f"is not a duration such as 90m or 1h30m: {error.hint}") from error
    return value


def _geojson(value: str) -> str:
    try:
        found = parse_json(value.encode())
    except (ValueError, UnicodeError) as error:
        raise OptionValueError("is not GeoJSON") from error
    if not isinstance(found, dict) or "type" not in found:
        raise OptionValueError("is not GeoJSON")
    return value


CATALOGUE = (
    Option(
        "preset",
        "enum",
        "standard",
        PRESETS,
        "How much work to put in: preview (minutes, splat only), standard, or high (full photo size, hours). "
        "Can be one of: %(choices)s. Default: %(default)s",
    ),
    Option("dsm", "bool", "false", "bool", "Make the surface model (DSM) with preset preview, too."),
    Option("dtm", "bool", "false", "bool", "Make the terrain model (DTM) with preset preview, too."),
    Option(
        "orthophoto-resolution",
        "float",
        "0",
        "positive float",
        "Pixel size of the orthophoto in cm. 0: as fine as the photos. Default: %(default)s",
        _positive(10_000.0),
    ),
    Option(
        "dem-resolution",
        "float",
        "0",
        "positive float",
        "Cell size of DSM and DTM in cm. 0: two pixels of the photos. Default: %(default)s",
        _positive(10_000.0),
    ),
    Option(
        "fast-orthophoto",
        "bool",
        "false",
        "bool",
        "Make the orthophoto and the surface model only: no splat is trained, and there is no mesh. With dtm also the "
        "terrain model, and with it the point cloud.",
    ),
    Option(
        "pc-quality",
        "enum",
        "medium",
        QUALITIES,
        "Size of the photos that depths are estimated from: each step halves or doubles the time for orthophoto, DSM, "
        "cloud and mesh. Can be one of: %(choices)s. Default: %(default)s",
    ),
    Option(
        "feature-quality",
        "enum",
        "medium",
        QUALITIES,
        "Size of the photos that keypoints are detected in. Can be one of: %(choices)s. Default: %(default)s",
    ),
    Option("mesh", "bool", "false", "bool", "Make the textured mesh (GLB, OBJ, 3D Tiles)."),
    Option(
        "mesh-size",
        "int",
        "200000",
        "positive integer",
        "Most triangles of the textured mesh; sending this option makes it. Default: %(default)s",
        _count(100, 20_000_000),
    ),
    Option("facades", "bool", "false", "bool", "Draw elevations of the walls to scale (images, DXF, SVG)."),
    Option(
        "boundary",
        "string",
        "",
        "json",
        "GeoJSON polygon (longitude, latitude) of the area of interest: quality is spent inside. Default: none",
        _geojson,
    ),
    Option(
        "crs",
        "string",
        "auto",
        "string",
        "CRS of the results, such as EPSG:25832 or EPSG:25832+7837. auto: that of the control file, or the UTM zone. "
        "Default: %(default)s",
        _crs,
    ),
    Option(
        "vertical",
        "string",
        "auto",
        "string",
        "Vertical datum of the photos' heights: ellipsoidal, EPSG:n or unknown. Default: %(default)s",
        _vertical,
    ),
    Option(
        "check-points",
        "string",
        "auto",
        "string",
        "Points that measure the accuracy instead of entering the fit: names separated by commas, auto or none. "
        "Default: %(default)s",
        _short,
    ),
    Option(
        "time-budget",
        "string",
        "",
        "string",
        "Time for the whole run, such as 90m or 2h: training is planned to fit. Default: as long as the preset takes",
        _duration,
    ),
    Option("sky", "bool", "false", "bool", "Keep the sky as a picture around the splat."),
    Option(
        "mark-first",
        "bool",
        "false",
        "bool",
        "Stop before the training, so that control points can be marked on the node's page.",
        listed=False,
    ),
)
LISTED = tuple(option for option in CATALOGUE if option.listed)
BY_NAME = {option.name: option for option in CATALOGUE}


@dataclass(frozen=True)
class GivenOptions:
    """The options of a task.

    Attributes:
        values: Those that the node offers, typed, in the order in which they were sent.
        dropped: Names of the others.
    """

    values: Mapping[str, Any]
    dropped: tuple[str, ...] = ()


NO_OPTIONS = GivenOptions({})

INSTEAD = {
    "gps-accuracy": "the accuracy of positions is read from the photos and from geo.txt",
    "auto-boundary": "maps end where three photos see the ground; give a boundary for a smaller area",
}
"""What takes the place of options that clients often send."""


def dropped_notes(dropped: Sequence[str]) -> tuple[str, ...]:
    """Lines for a task's log on the options that were dropped."""
    instead = [f"{name}: {INSTEAD[name]}." for name in dropped if name in INSTEAD]
    said = f"Options that this node does not offer were ignored: {', '.join(dropped)}"
    return (said, *instead) if dropped else ()


def parse_options(text: str | None) -> GivenOptions:
    """Parse the options that a client sent.

    Args:
        text: JSON: ``[{"name": …, "value": …}]``; empty or None for none.

    Raises:
        WrongOptionsError: naming every wrong value.
    """
    if text is None or not text.strip():
        return NO_OPTIONS
    try:
        if len(text) > MAX_OPTIONS_CHARACTERS:
            raise ValueError("they are too long")
        listed = parse_json(text.encode())
        if not isinstance(listed, list) or len(listed) > MAX_OPTIONS:
            raise ValueError("they are not a list")
    except (ValueError, UnicodeError) as error:
        raise WrongOptionsError([("options", f"are not JSON as [{{name, value}}]: {error}")]) from error
    values: dict[str, Any] = {}
    dropped: list[str] = []
    errors: list[tuple[str, str]] = []
    for each in listed:
        name = each.get("name") if isinstance(each, dict) else None
        if not isinstance(name, str):
            errors.append(("options", "has an entry without a name"))
        elif name not in BY_NAME:
            dropped.append("".join(letter if letter.isprintable() else "?" for letter in name[:60]))
        else:
            try:
                values[name] = BY_NAME[name].typed(each.get("value"))
            except OptionValueError as error:
                errors.append((name, str(error)))
    if errors:
        raise WrongOptionsError(errors)
    return GivenOptions(values, tuple(dropped))
