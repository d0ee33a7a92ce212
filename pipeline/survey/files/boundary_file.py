"""Boundaries drawn in QGIS or similar programs: the polygons of an untrusted GeoJSON file.

RFC 7946 (GeoJSON) allows only WGS 84; the earlier specification of 2008 has a member `crs`, which programs still write.
Both put east (or longitude) first.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.small_file import read_small
from splatpipe.pipeline.geometry.plan_area import Polygon, Ring, signed_area

MAX_FILE_BYTES = 8 << 20  # bytes: a hundred times the size of a detailed outline
MAX_VERTICES = 20_000  # in all rings: finer than any drawn or measured boundary
MAX_NESTING = 8  # nested collections
MAX_NAME_CHARACTERS = 80  # characters of a feature's name that fit a label
MAX_COORDINATE = 1e9  # absolute coordinate; no CRS of the earth has larger ones
EXPECTED = "Draw it as a polygon in QGIS or geojson.io, and save it as GeoJSON."
WGS84 = "EPSG:4326"
Vertex = Float64[np.ndarray, " 2"]

_EPSG_NAMES = re.compile(
    r"(?:urn:(?:x-)?ogc:def:crs:EPSG:[\d.]{0,8}:|https?://www\.opengis\.net/(?:def/crs/EPSG/[\d.]{1,8}/|gml/srs/epsg\.xml#)"
    r"|EPSG:{1,2})(\d{1,6})",
    re.IGNORECASE | re.ASCII,
)
_CRS84 = re.compile(
    r"(?:urn:(?:x-)?ogc:def:crs:)?OGC:[\d.]{0,8}:?CRS84h?|.{0,40}/OGC/[\d.]{1,8}/CRS84h?", re.IGNORECASE
)


@dataclass(frozen=True, eq=False)
class BoundaryFile:
    """The contents of a boundary file.

    Attributes:
        name: File name, for messages.
        polygons: In the file's coordinates: east (or longitude), north (or latitude).
        names: Name of each polygon's feature; empty if it has none.
        crs: In the form that ``parse_crs`` accepts; empty if the file names none.
        passed_over: Number of ignored points and lines.
        crossing: A point where an outline crosses itself; empty if none does.
    """

    name: str
    polygons: tuple[Polygon, ...]
    names: tuple[str, ...]
    crs: str
    passed_over: int
    crossing: tuple[float, ...]


def read_boundary(path: Path) -> BoundaryFile:
    """Read a boundary.

    Args:
        path: A GeoJSON file with polygons, multipolygons, or features with such geometries.

    Raises:
        SplatpipeError: if it is not GeoJSON, has no polygon, or exceeds the limits on size, nesting or vertices.
    """
    value = _value(path)
    try:
        geometries = list(_geometries(value, 0, ""))
        named = list(_polygons(geometries))
    except _BrokenError as error:
        raise SplatpipeError(f"The boundary {path.name} {error}.", EXPECTED) from error
    if not named:
        raise SplatpipeError(f"The boundary {path.name} has no polygon.", EXPECTED)
    polygons, names = tuple(polygon for polygon, _ in named), tuple(name for _, name in named)
    crossing = next((place for polygon in polygons for ring in polygon if (place := crossing_of(ring))), ())
    others = sum(geometry["type"] not in ("Polygon", "MultiPolygon") for geometry, _ in geometries)
    return BoundaryFile(path.name, polygons, names, _crs(value, path.name), others, crossing)


class _BrokenError(ValueError):
    """An invalid file; the message completes a sentence about it."""


def _value(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(read_small(path, MAX_FILE_BYTES).decode("utf-8-sig"), parse_constant=_no_number)
    except OSError as error:
        raise SplatpipeError(f"The boundary {path.name} cannot be read: {error.strerror}.", EXPECTED) from error
    except (ValueError, RecursionError) as error:  # not text, not JSON, a number of a million digits, deep nesting
        raise SplatpipeError(f"The boundary {path.name} is not valid GeoJSON.", EXPECTED) from error
    if not isinstance(value, dict):
        raise SplatpipeError(f"The boundary {path.name} is not valid GeoJSON.", EXPECTED)
    return value


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number")


def _geometries(value: Any, depth: int, name: str) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield the geometries in an object, with collections flattened, each with its feature's name."""
    if depth > MAX_NESTING:
        raise _BrokenError(f"has collections within collections, more than {MAX_NESTING} deep")
    kind = value.get("type") if isinstance(value, dict) else None
    if kind == "FeatureCollection":
        parts = value.get("features")
    elif kind == "GeometryCollection":
        parts = value.get("geometries")
    elif kind == "Feature":
        parts = [] if value.get("geometry") is None else [value["geometry"]]  # a table row without a geometry
        name = _name(value.get("properties"))
    elif kind in ("Point", "MultiPoint", "LineString", "MultiLineString", "Polygon", "MultiPolygon"):
        yield value, name
        return
    else:
        raise _BrokenError("is not valid GeoJSON: something in it has an unknown type")
    if not isinstance(parts, list):
        raise _BrokenError(f"has a {kind} that is no list")
    for part in parts:
        yield from _geometries(part, depth + 1, name)


def _name(properties: Any) -> str:
    """Return a feature's name as one line of valid text."""
    stated = properties.get("name") if isinstance(properties, dict) else None
    text = " ".join(stated.split()) if isinstance(stated, str) else ""
    return text[:MAX_NAME_CHARACTERS].encode("utf-8", "replace").decode("utf-8")  # JSON may contain lone surrogates


def _polygons(geometries: list[tuple[dict[str, Any], str]]) -> Iterator[tuple[Polygon, str]]:
    left = MAX_VERTICES
    for geometry, name in geometries:
        if geometry["type"] not in ("Polygon", "MultiPolygon"):
            continue
        stated = geometry.get("coordinates")
        for rings in [stated] if geometry["type"] == "Polygon" else _listed(stated):
            polygon = []
            for ring in _listed(rings):
                left -= len(_listed(ring))
                if left < 0:
                    raise _BrokenError(f"has more than {MAX_VERTICES:,} vertices")
                polygon.append(_ring(ring))
            if polygon:  # an empty polygon is valid
                yield tuple(polygon), name


def _listed(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise _BrokenError("has coordinates that are no list of positions")
    return value


def _ring(stated: list[Any]) -> Ring:
    """Return a ring's vertices without consecutive duplicates, and without the closing one."""
    ring = np.array([_position(position) for position in stated], np.float64).reshape(-1, 2)
    ring = ring[np.any(ring != np.roll(ring, -1, axis=0), axis=1)] if len(ring) else ring
    if len(ring) < 3 or signed_area(ring) == 0.0:
        raise _BrokenError("has a ring without an area")
    return ring


def _position(stated: Any) -> tuple[float, float]:
    numbers = _listed(stated)[:2]
    for number in numbers:
        if isinstance(number, bool) or not isinstance(number, (int, float)) or not abs(number) <= MAX_COORDINATE:
            raise _BrokenError("has a coordinate that is out of range")
    if len(numbers) < 2:
        raise _BrokenError("has a position without two coordinates")
    return float(numbers[0]), float(numbers[1])


def _crs(value: dict[str, Any], name: str) -> str:
    """Return the CRS that a file names by the specification of 2008; empty if it names none."""
    stated = value.get("crs")
    if stated is None:
        return ""
    properties = stated.get("properties") if isinstance(stated, dict) else None
    text = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(text, str) or stated.get("type") not in ("name", "EPSG"):
        hint = "Save it in WGS 84 (EPSG:4326), which GeoJSON has by default."
        raise SplatpipeError(f"The boundary {name} gives its CRS as a link, not by name.", hint)
    if match := _EPSG_NAMES.fullmatch(text.strip()):
        return f"EPSG:{int(match[1])}"
    return WGS84 if _CRS84.fullmatch(text.strip()) else text.strip()


def crossing_of(ring: Ring) -> tuple[float, ...]:
    """Return a point where a ring crosses itself, two coordinates; empty if it does not.

    Args:
        ring: Vertices without consecutive duplicates.
    """
    following = np.roll(ring, -1, axis=0)
    low, high = np.minimum(ring, following), np.maximum(ring, following)
    order = np.argsort(low[:, 0], kind="stable")
    starts = low[order, 0]
    for place, k in enumerate(order.tolist()):
        others = order[place + 1 : np.searchsorted(starts, high[k, 0], side="right")]
        near = (low[others, 1] <= high[k, 1]) & (high[others, 1] >= low[k, 1])
        apart = (others - k) % len(ring)
        others = others[near & (apart != 1) & (apart != len(ring) - 1)]
        if not len(others):
            continue
        met = others[_meet(ring[k], following[k], ring[others], following[others])]
        if len(met):
            there = _meeting(ring[k], following[k], ring[met[0]], following[met[0]])
            return float(there[0]), float(there[1])
    return ()


def _side(
    a: Float64[np.ndarray, "*n 2"], b: Float64[np.ndarray, "*n 2"], c: Float64[np.ndarray, "*m 2"]
) -> Float64[np.ndarray, "*k"]:
    """Return the side of the line from a to b on which each c lies, by sign."""
    first, second = b - a, c - a
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


def _meet(a: Vertex, b: Vertex, c: Ring, d: Ring) -> Bool[np.ndarray, " k"]:
    """Return which segments from c to d the segment from a to b crosses; touching does not count."""
    return np.asarray((_side(a, b, c) * _side(a, b, d) < 0.0) & (_side(c, d, a) * _side(c, d, b) < 0.0))


def _meeting(a: Vertex, b: Vertex, c: Vertex, d: Vertex) -> Vertex:
    """Return the point where the line from a to b crosses the segment from c to d."""
    from_c, from_d = float(_side(a, b, c)), float(_side(a, b, d))
    return np.asarray(c + from_c / (from_c - from_d) * (d - c))
