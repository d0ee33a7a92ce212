"""Motions: moved, turned and scaled, with what that means for a splat's place and for its metres.

The frame stays and the splat moves within it, so a georeferenced splat moves on the earth and its heading and height
can be put right. Lengths are another matter: two measured points say what a metre is, and the splat keeps its place; a
bare factor makes its lengths mean nothing on the earth, and drops the place and the metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.edit.coordinates import Coordinates, parse_numbers
from splatpipe.pipeline.edit.workpiece import FAR_M, Workpiece, between, facts_without_place
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.quantities import parse_length
from splatpipe.pipeline.geometry.similarity import Similarity, rotation_from_vector
from splatpipe.pipeline.survey.frames import Origin

MOST_DEGREES = 36_000.0  # a hundred turns
FACTORS = (1e-6, 1e6)  # from micrometres to metres and back
AXES = {"up": None, "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
POINT_FORM = "X,Y,Z"
Point = tuple[float, ...]


@dataclass(frozen=True)
class Pivot:
    """What stays where it is.

    Attributes:
        point: Stated coordinates; None for the splat's middle.
        local: As of ``Coordinates.of``.
    """

    point: Point | None = None
    local: bool = False

    @staticmethod
    def parse(text: str, option: str, local: bool) -> Pivot:
        """A point, or ``middle``.

        Raises:
            UsageError: if it is anything else.
        """
        if text.strip() == "middle":
            return Pivot(None, local)
        return Pivot(parse_numbers(text, option, (3,), f"{POINT_FORM} or {option} middle"), local)

    def place(self, piece: Workpiece) -> Float64[np.ndarray, " 3"]:
        """Where it is, in the frame."""
        if self.point is None:
            return piece.middle()
        return np.asarray(Coordinates.of(piece.facts, self.local).in_frame(np.array([self.point]))[0])

    def as_text(self) -> str | list[float]:
        """For the record."""
        return "middle" if self.point is None else list(self.point)


@dataclass(frozen=True)
class Move:
    """By so many metres (units of a splat without them) east, north and up, or along a file's own axes."""

    offset: Point

    @staticmethod
    def parse(text: str, option: str) -> Move:
        """Three lengths.

        Raises:
            UsageError: if it is anything else.
        """
        return Move(parse_numbers(text, option, (3,), "EAST,NORTH,UP"))

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Move; what is recorded of it.

        Raises:
            SplatpipeError: if a georeferenced splat is moved so far that up is another direction there.
        """
        offset = Coordinates.of(piece.facts, local=True).in_frame(np.array([self.offset]))[0]
        if piece.facts.place is not None and float(np.linalg.norm(offset)) > FAR_M:
            raise SplatpipeError(
                f"{np.linalg.norm(offset) / 1000.0:,.0f} km away, the directions of east, north and up differ.",
                hint="Give the target coordinates instead: --move-to X,Y,Z.",
            )
        piece.move(Similarity(1.0, np.eye(3), offset))
        return {"step": "move", "by": list(self.offset)}


@dataclass(frozen=True)
class MoveTo:
    """The pivot comes to stated coordinates; a georeferenced splat stands upright there and keeps its heading.

    Attributes:
        point: The coordinates; without a height it stays at its own.
        pivot: What of the splat comes there.
        local: As of ``Coordinates.of``.
    """

    point: Point
    pivot: Pivot = Pivot()
    local: bool = False

    @staticmethod
    def parse(text: str, option: str, pivot: Pivot, local: bool) -> MoveTo:
        """Two or three coordinates.

        Raises:
            UsageError: if it is anything else.
        """
        return MoveTo(parse_numbers(text, option, (2, 3), "X,Y or X,Y,Z"), pivot, local)

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Move; what is recorded of it.

        Raises:
            SplatpipeError: if the CRS has no such place.
        """
        coordinates = Coordinates.of(piece.facts, self.local)
        pivot = self.pivot.place(piece)
        stated = coordinates.stated(pivot[None])[0]
        stated[: len(self.point)] = self.point
        target = coordinates.in_frame(stated[None])[0]
        piece.move(Similarity(1.0, np.eye(3), -pivot))
        place = piece.facts.place
        if place is not None:
            origin = Origin(place.latitude, place.longitude, place.height_m)
            latitude, longitude, height_m = origin.geodetic_from_enu(target[None])[0].tolist()
            there = between(Origin(latitude, longitude, height_m), origin)
            before = between(_origin_at(origin, pivot), origin)
            piece.move(Similarity(1.0, before.rotation.T, np.zeros(3)))
            piece.move(Similarity(1.0, there.rotation, target))
        else:
            piece.move(Similarity(1.0, np.eye(3), target))
        return {
            "step": "move",
            "to": list(self.point),
            "what": self.pivot.as_text(),
            "coordinates": coordinates.name,
        }


def _origin_at(origin: Origin, place: Float64[np.ndarray, " 3"]) -> Origin:
    latitude, longitude, height_m = origin.geodetic_from_enu(place[None])[0].tolist()
    return Origin(latitude, longitude, height_m)


@dataclass(frozen=True)
class Rotate:
    """By an angle about an axis through the pivot, anticlockwise as seen from the axis' tip.

    Attributes:
        degrees: The angle.
        axis: A direction along the axes of ``Move``; None for up.
        pivot: What stays.
    """

    degrees: float
    axis: Point | None = None
    pivot: Pivot = Pivot()

    @staticmethod
    def parse(text: str, option: str, pivot: Pivot) -> Rotate:
        """An angle, and perhaps an axis: its name or three numbers.

        Raises:
            UsageError: if it is anything else.
        """
        form = "DEGREES, DEGREES,AXIS (up, x, y or z) or DEGREES,X,Y,Z"
        first, _, rest = (part.strip() for part in text.partition(","))
        degrees = parse_numbers(first, option, (1,), form)[0]
        axis = AXES[rest] if rest in AXES else parse_numbers(rest, option, (3,), form) if rest else None
        if abs(degrees) > MOST_DEGREES or (axis is not None and math.hypot(*axis) == 0.0):
            raise UsageError(f'Cannot rotate by "{text[:60]}".', hint=f"Write it as {option} {form}.")
        return Rotate(degrees, axis, pivot)

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Turn; what is recorded of it."""
        axis = np.array([0.0, 0.0, 1.0])
        if self.axis is not None:
            axis = Coordinates.of(piece.facts, local=True).in_frame(np.array([self.axis]))[0]
        rotation = rotation_from_vector(math.radians(self.degrees) * axis / np.linalg.norm(axis))
        piece.move(_about(self.pivot.place(piece), 1.0, rotation))
        return {
            "step": "rotate",
            "degrees": self.degrees,
            "axis": "up" if self.axis is None else list(self.axis),
            "about": self.pivot.as_text(),
        }


@dataclass(frozen=True)
class ScaleBy:
    """By a factor about the pivot. What a metre is is not known any more, so neither is where it lies.

    Attributes:
        factor: New lengths an old one.
        pivot: What stays.
    """

    factor: float
    pivot: Pivot = Pivot()

    @staticmethod
    def parse(text: str, option: str, pivot: Pivot) -> ScaleBy:
        """A factor.

        Raises:
            UsageError: if it is none, or absurd.
        """
        factor = parse_numbers(text, option, (1,), "FACTOR")[0]
        if not FACTORS[0] <= factor <= FACTORS[1]:
            raise UsageError(
                f"Cannot scale by {text[:60]}.", hint=f"The factor must be between {FACTORS[0]:g} and {FACTORS[1]:g}."
            )
        return ScaleBy(factor, pivot)

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Scale; what is recorded of it."""
        piece.move(_about(self.pivot.place(piece), self.factor, np.eye(3)))
        if piece.facts.place is not None:
            piece.notes.append("Scaling by a factor drops the splat's georeference. --scale-from A B LENGTH keeps it.")
        piece.facts = facts_without_place(piece.facts)
        return {"step": "scale", "factor": self.factor, "about": self.pivot.as_text()}


@dataclass(frozen=True)
class ScaleFrom:
    """By what the distance between two of its points is in truth. The first of them stays; lengths are metres then.

    Attributes:
        first: Stated coordinates.
        second: The same.
        length_m: Their true distance.
        local: As of ``Coordinates.of``.
    """

    first: Point
    second: Point
    length_m: float
    local: bool = False

    @staticmethod
    def parse(texts: tuple[str, str, str], option: str, local: bool) -> ScaleFrom:
        """Two points and a length with its unit.

        Raises:
            UsageError: if it is anything else.
        """
        first, second = (parse_numbers(text, option, (3,), "X,Y,Z X,Y,Z 12.40m") for text in texts[:2])
        length_m = parse_length(texts[2], option)
        if length_m <= 0.0:
            raise UsageError(f"The length of {option} is zero.", hint=f"Write it as {option} A B 12.40m.")
        return ScaleFrom(first, second, length_m, local)

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Scale; what is recorded of it.

        Raises:
            SplatpipeError: if the points are one, or the factor is absurd.
        """
        coordinates = Coordinates.of(piece.facts, self.local)
        first, second = coordinates.in_frame(np.array([self.first, self.second]))
        distance = float(np.linalg.norm(second - first))
        factor = self.length_m / distance if distance > 0.0 else math.inf
        if not FACTORS[0] <= factor <= FACTORS[1]:
            raise SplatpipeError(
                f"The points of --scale-from are {distance:g} apart in the splat, for {self.length_m:g} m.",
                hint="Take both points' coordinates from the splat, at the ends of the measured length.",
            )
        piece.move(_about(first, factor, np.eye(3)))
        piece.facts = replace(piece.facts, metres=True)
        return {
            "step": "scale",
            "factor": factor,
            "from": [list(self.first), list(self.second)],
            "length_m": self.length_m,
            "coordinates": coordinates.name,
        }


def _about(pivot: Float64[np.ndarray, " 3"], scale: float, rotation: Float64[np.ndarray, "3 3"]) -> Similarity:
    return Similarity(scale, rotation, pivot - scale * (rotation @ pivot))
