"""The contents of a splat file: Gaussians, axes, position on the earth, and edit history."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float64
from torch import Tensor

from splatpipe.pipeline.splat.model.gaussians import Gaussians

Axes = Literal["z up", "y up", "y down"]
"""``z up``: east, north, up (surveying). ``y up``: east, up, south (glTF, SPZ). ``y down``: east, down, north, which
viewers assume for a 3DGS PLY (a COLMAP camera's axes)."""

FORMAT = 1
MAX_RECORD_BYTES = 60_000  # largest record in a file: gzip's extra field holds 65,535
MAX_EDITS = 200
MAX_OFFSET = 1e12  # largest coordinate of an offset, in any unit a place on the earth has
_MAX_TEXT_LENGTH = 4000  # characters of a CRS in WKT, the longest text
NO_OFFSET = (0.0, 0.0, 0.0)
_Z_UP_FROM: Mapping[Axes, tuple[tuple[float, ...], ...]] = {
    "z up": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "y up": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    "y down": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
}


@dataclass(frozen=True)
class SplatOrigin:
    """Position of a splat's origin on the earth; its axes, turned to z up, are east, north, up there.

    Attributes:
        latitude: Degrees, WGS 84.
        longitude: Degrees, WGS 84.
        height_m: In the vertical datum, metres.
        vertical_datum: ``ellipsoidal``, ``EPSG:n``, or ``unknown``.
        crs: CRS for displayed coordinates, as accepted by ``survey.crs.crs.parse_crs``; empty for the UTM zone.
        approximate_crs: Whether the user accepts the CRS although one of its grids is missing.
    """

    latitude: float
    longitude: float
    height_m: float
    vertical_datum: str = "unknown"
    crs: str = ""
    approximate_crs: bool = False


@dataclass(frozen=True)
class SceneFacts:
    """Metadata of a splat file.

    Attributes:
        axes: Which way is up.
        antialias: Whether opacities account for the screen-space blur (Mip-Splatting).
        metres: Whether a unit is a metre.
        place: Position on the earth; None if unknown.
        edits: Edits since training, in order, each as JSON.
        offset: What was taken off the coordinates of another program, along ``axes``, so that float32 can hold them:
            its coordinates are the file's plus this. Zero if the splat has a place.
    """

    axes: Axes = "z up"
    antialias: bool = False
    metres: bool = False
    place: SplatOrigin | None = None
    edits: tuple[Mapping[str, Any], ...] = ()
    offset: tuple[float, float, float] = NO_OFFSET

    def turned(self, axes: Axes) -> SceneFacts:
        """The facts of the same splat turned to other axes."""
        offset = turn_of(axes, self.axes) @ torch.tensor(self.offset, dtype=torch.float64)
        x, y, z = (offset + 0.0).tolist()  # no negative zeros
        return replace(self, axes=axes, offset=(x, y, z))

    def record(self) -> str:
        """One line of ASCII JSON, stored in files under the name ``splatpipe``; ``facts_of_record`` reads it.

        Raises:
            ValueError: if it is longer than ``MAX_RECORD_BYTES``.
        """
        facts = {"format": FORMAT, **asdict(self)}
        if self.offset == NO_OFFSET:
            del facts["offset"]
        text = json.dumps(facts, separators=(",", ":"), allow_nan=False)
        if len(text) > MAX_RECORD_BYTES:
            raise ValueError(f"a record of {len(text)} bytes is larger than {MAX_RECORD_BYTES}")
        return text


def facts_of_record(text: str | bytes | None, otherwise: SceneFacts) -> SceneFacts:
    """Parse a file's record; returns ``otherwise`` if there is none or it is not a valid record of ours.

    Args:
        text: The record, untrusted.
        otherwise: The format's defaults.
    """
    if text is None or len(text) > MAX_RECORD_BYTES:
        return otherwise
    try:
        return _facts(json.loads(text))
    except (ValueError, KeyError, TypeError, RecursionError):
        return otherwise


def _facts(value: Mapping[str, Any]) -> SceneFacts:
    if value["format"] != FORMAT or value["axes"] not in get_args(Axes):
        raise ValueError("of another format")
    edits = value["edits"]
    if not isinstance(edits, list) or len(edits) > MAX_EDITS or not all(isinstance(edit, dict) for edit in edits):
        raise ValueError("edits")
    place = None if value["place"] is None else _place(value["place"])
    x, y, z = (float(number) for number in value.get("offset", NO_OFFSET))
    if not all(abs(number) <= MAX_OFFSET for number in (x, y, z)) or (place is not None and any((x, y, z))):
        raise ValueError("offset")
    facts = SceneFacts(
        value["axes"], value["antialias"] is True, value["metres"] is True, place, tuple(edits), (x, y, z)
    )
    facts.record()  # raises if it could not be written again: JSON reads 1e400 as infinity
    return facts


def _place(value: Mapping[str, Any]) -> SplatOrigin:
    latitude, longitude, height_m = (float(value[name]) for name in ("latitude", "longitude", "height_m"))
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0 and math.isfinite(height_m)):
        raise ValueError("nowhere on the earth")
    vertical_datum, crs = (str(value[name])[:_MAX_TEXT_LENGTH] for name in ("vertical_datum", "crs"))
    return SplatOrigin(latitude, longitude, height_m, vertical_datum, crs, value["approximate_crs"] is True)


@dataclass(frozen=True, eq=False)
class Scene:
    """The contents of a splat file.

    Attributes:
        gaussians: On the CPU, float32, in the frame given by ``facts.axes``.
        facts: Metadata.
        notes: What its reader has to tell the user about it.
    """

    gaussians: Gaussians
    facts: SceneFacts = field(default_factory=SceneFacts)
    notes: tuple[str, ...] = ()

    def turned(self, axes: Axes) -> Scene:
        """The scene turned to other axes; the scene itself if it has these already."""
        if axes == self.facts.axes:
            return self
        turn, nowhere = turn_of(axes, self.facts.axes), torch.zeros(3, dtype=torch.float64)
        pieces = (piece.transformed(1.0, turn, nowhere) for piece in self.gaussians.pieces())
        return Scene(Gaussians.gathered(pieces, self.gaussians), self.facts.turned(axes), self.notes)


def turn_of(axes: Axes, from_axes: Axes) -> Float64[Tensor, "3 3"]:
    """Rotation to ``axes`` from ``from_axes``."""
    matrices = {name: torch.tensor(rows, dtype=torch.float64) for name, rows in _Z_UP_FROM.items()}
    return matrices[axes].T @ matrices[from_axes]
