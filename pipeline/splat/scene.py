"""A splat as a file holds it: the Gaussians, which way is up, where it lies on the earth, and what was done to it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float64
from torch import Tensor

from splatpipe.pipeline.splat.gaussians import Gaussians

Axes = Literal["z up", "y up", "y down"]
"""``z up``: east, north, up (a survey's). ``y up``: east, up, south (glTF, SPZ). ``y down``: east, down, north, which
viewers take a 3DGS PLY for (a COLMAP camera's habit)."""

FORMAT = 1
MOST_RECORD_BYTES = 60_000  # of the record in a file: gzip's extra field holds 65,535
MOST_EDITS = 200
_MOST_TEXT = 4000  # characters of a CRS in WKT, the longest text
_Z_UP_FROM: Mapping[Axes, tuple[tuple[float, ...], ...]] = {
    "z up": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "y up": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    "y down": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
}


@dataclass(frozen=True)
class SplatOrigin:
    """Where a splat's zero lies on the earth; its axes, turned to z up, are east, north, up there.

    Attributes:
        latitude: Degrees, WGS 84.
        longitude: The same.
        height_m: In the vertical datum, metres.
        vertical_datum: ``ellipsoidal``, ``EPSG:n``, or ``unknown``.
        crs: That coordinates are read out in, as ``survey.crs.parse_crs`` takes it; empty for the UTM zone.
        approximate_crs: The user accepts it though a grid of it is missing.
    """

    latitude: float
    longitude: float
    height_m: float
    vertical_datum: str = "unknown"
    crs: str = ""
    approximate_crs: bool = False


@dataclass(frozen=True)
class SceneFacts:
    """What a file says of its Gaussians.

    Attributes:
        axes: Which way is up.
        antialias: Whether opacities allow for the blur on screen (Mip-Splatting).
        metres: Whether a unit is a metre.
        place: Where it lies on the earth; None where nobody knows.
        edits: What was done to it since it was trained, in order, each as JSON.
    """

    axes: Axes = "z up"
    antialias: bool = False
    metres: bool = False
    place: SplatOrigin | None = None
    edits: tuple[Mapping[str, Any], ...] = ()

    def record(self) -> str:
        """One line of ASCII JSON, which files carry under the name ``splatpipe`` and ``facts_of_record`` reads.

        Raises:
            ValueError: if it is larger than a file may carry.
        """
        text = json.dumps({"format": FORMAT, **asdict(self)}, separators=(",", ":"), allow_nan=False)
        if len(text) > MOST_RECORD_BYTES:
            raise ValueError(f"a record of {len(text)} bytes is larger than {MOST_RECORD_BYTES}")
        return text


def facts_of_record(text: str | bytes | None, otherwise: SceneFacts) -> SceneFacts:
    """What a file's record says; ``otherwise`` where there is none, or it is not one of ours: files come from anybody.

    Args:
        text: The record.
        otherwise: What the format means by itself.
    """
    if text is None or len(text) > MOST_RECORD_BYTES:
        return otherwise
    try:
        return _facts(json.loads(text))
    except (ValueError, KeyError, TypeError, RecursionError):
        return otherwise


def _facts(value: Mapping[str, Any]) -> SceneFacts:
    if value["format"] != FORMAT or value["axes"] not in get_args(Axes):
        raise ValueError("of another format")
    edits = value["edits"]
    if not isinstance(edits, list) or len(edits) > MOST_EDITS or not all(isinstance(edit, dict) for edit in edits):
        raise ValueError("edits")
    place = None if value["place"] is None else _place(value["place"])
    facts = SceneFacts(value["axes"], value["antialias"] is True, value["metres"] is True, place, tuple(edits))
    facts.record()  # fails where it could not be written again: JSON reads 1e400 as infinity
    return facts


def _place(value: Mapping[str, Any]) -> SplatOrigin:
    latitude, longitude, height_m = (float(value[name]) for name in ("latitude", "longitude", "height_m"))
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0 and math.isfinite(height_m)):
        raise ValueError("nowhere on the earth")
    vertical_datum, crs = (str(value[name])[:_MOST_TEXT] for name in ("vertical_datum", "crs"))
    return SplatOrigin(latitude, longitude, height_m, vertical_datum, crs, value["approximate_crs"] is True)


@dataclass(frozen=True, eq=False)
class Scene:
    """What a splat file holds.

    Attributes:
        gaussians: On the CPU, float32, in the frame that ``facts.axes`` names.
        facts: What it says of them.
    """

    gaussians: Gaussians
    facts: SceneFacts = field(default_factory=SceneFacts)

    def turned(self, axes: Axes) -> Scene:
        """The same with other axes; itself, to the bit, where they are these."""
        if axes == self.facts.axes:
            return self
        turn, nowhere = turn_of(axes, self.facts.axes), torch.zeros(3, dtype=torch.float64)
        pieces = (piece.transformed(1.0, turn, nowhere) for piece in self.gaussians.pieces())
        return Scene(Gaussians.gathered(pieces, self.gaussians), replace(self.facts, axes=axes))


def turn_of(axes: Axes, from_axes: Axes) -> Float64[Tensor, "3 3"]:
    """Rotation to axes from other ones."""
    matrices = {name: torch.tensor(rows, dtype=torch.float64) for name, rows in _Z_UP_FROM.items()}
    return matrices[axes].T @ matrices[from_axes]
