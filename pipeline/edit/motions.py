"""Motions: move, rotate and scale, and their effect on a splat's georeference and metric scale.

The frame stays and the splat moves within it, so a georeferenced splat moves on the earth and its heading and height
can be corrected. Scaling differs: with the measured distance between two points, the scale is metric and the splat
keeps its place; with a bare factor, the scale is no longer metric, and the place and the metres are dropped.
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
from splatpipe.pipeline.survey.crs.frames import Origin

MAX_DEGREES = 36_000.0  # a hundred turns
SCALE_BOUNDS = (1e-6, 1e6)  # from micrometres to metres and back
AXES = {"up": None, "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
POINT_FORM = "X,Y,Z"
Point = tuple[float, ...]


@dataclass(frozen=True)
class Pivot:
    """The fixed point of a motion.

    Attributes:
        point: Its coordinates as given; None for the splat's middle.
        local: As for ``Coordinates.of``.
    """

    point: Point | None = None
    local: bool = False

    @staticmethod
    def parse(text: str, option: str, local: bool) -> Pivot:
        """Parse a point, or ``middle``.

        Raises:
            UsageError: if it is anything else.
        """
        if text.strip() == "middle":
            return Pivot(None, local)
        return Pivot(parse_numbers(text, option, (3,), f"{POINT_FORM} or {option} middle"), local)

    def place(self, piece: Workpiece) -> Float64[np.ndarray, " 3"]:
        """The pivot's position in the frame."""
        if self.point is None:
            return piece.middle()
        return np.asarray(Coordinates.of(piece.facts, self.local).in_frame(np.array([self.point]))[0])

    def as_text(self) -> str | list[float]:
        """The pivot for the record of the step."""
        return "middle" if self.point is None else list(self.point)


@dataclass(frozen=True)
class Move:
    """An offset in metres (in a splat's units if not metric) east, north and up, or along the file's own axes."""

    offset: Point

    @staticmethod
    def parse(text: str, option: str) -> Move:
        """Parse three lengths.

        Raises:
            UsageError: if it is anything else.
        """
        return Move(parse_numbers(text, option, (3,), "EAST,NORTH,UP"))

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Move the splat; returns the record of the step.

        Raises:
            SplatpipeError: if a georeferenced splat is moved so far that the up direction differs.
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
    """Moves the pivot to given coordinates; a georeferenced splat is upright there and keeps its heading.

    Attributes:
        point: The target coordinates; without a height, the pivot keeps its own.
        pivot: The point of the splat to move there.
        local: As for ``Coordinates.of``.
    """

    point: Point
    pivot: Pivot = Pivot()
    local: bool = False

    @staticmethod
    def parse(text: str, option: str, pivot: Pivot, local: bool) -> MoveTo:
        """Parse two or three coordinates.

        Raises:
            UsageError: if it is anything else.
        """
        return MoveTo(parse_numbers(text, option, (2, 3), "X,Y or X,Y,Z"), pivot, local)

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Move the splat; returns the record of the step.

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
    """A rotation about an axis through the pivot, anticlockwise as seen from the axis' tip.

    Attributes:
        degrees: The angle.
        axis: A direction along the axes of ``Move``; None for up.
        pivot: The fixed point.
    """

    degrees: float
    axis: Point | None = None
    pivot: Pivot = Pivot()

    @staticmethod
    def parse(text: str, option: str, pivot: Pivot) -> Rotate:
        """Parse an angle and optionally an axis: its name or three numbers.

        Raises:
            UsageError: if it is anything else.
        """
        form = "DEGREES, DEGREES,AXIS (up, x, y or z) or DEGREES,X,Y,Z"
        first, _, rest = (part.strip() for part in text.partition(","))
        degrees = parse_numbers(first, option, (1,), form)[0]
        axis = AXES[rest] if rest in AXES else parse_numbers(rest, option, (3,), form) if rest else None
        if abs(degrees) > MAX_DEGREES or (axis is not None and math.hypot(*axis) == 0.0):
            raise UsageError(f'Cannot rotate by "{text[:60]}".', hint=f"Write it as {option} {form}.")
        return Rotate(degrees, axis, pivot)

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Rotate the splat; returns the record of the step."""
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
    """Scaling by a factor about the pivot. The scale is no longer metric, so the georeference is lost too.

    Attributes:
        factor: Ratio of new to old lengths.
        pivot: The fixed point.
    """

    factor: float
    pivot: Pivot = Pivot()

    @staticmethod
    def parse(text: str, option: str, pivot: Pivot) -> ScaleBy:
        """Parse a factor.

        Raises:
            UsageError: if it is not a number or out of range.
        """
        factor = parse_numbers(text, option, (1,), "FACTOR")[0]
        if not SCALE_BOUNDS[0] <= factor <= SCALE_BOUNDS[1]:
            raise UsageError(
                f"Cannot scale by {text[:60]}.",
                hint=f"The factor must be between {SCALE_BOUNDS[0]:g} and {SCALE_BOUNDS[1]:g}.",
            )
        return ScaleBy(factor, pivot)

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Scale the splat; returns the record of the step."""
        piece.move(_about(self.pivot.place(piece), self.factor, np.eye(3)))
        if piece.facts.place is not None:
            piece.notes.append("Scaling by a factor drops the splat's georeference. --scale-from A B LENGTH keeps it.")
        piece.facts = facts_without_place(piece.facts)
        return {"step": "scale", "factor": self.factor, "about": self.pivot.as_text()}


@dataclass(frozen=True)
class ScaleFrom:
    """Scaling by the true distance between two points. The first stays fixed; lengths are metres afterwards.

    Attributes:
        first: Coordinates of the first point.
        second: Coordinates of the second point.
        length_m: Their true distance.
        local: As for ``Coordinates.of``.
    """

    first: Point
    second: Point
    length_m: float
    local: bool = False

    @staticmethod
    def parse(texts: tuple[str, str, str], option: str, local: bool) -> ScaleFrom:
        """Parse two points and a length with its unit.

        Raises:
            UsageError: if it is anything else.
        """
        first, second = (parse_numbers(text, option, (3,), "X,Y,Z X,Y,Z 12.40m") for text in texts[:2])
        length_m = parse_length(texts[2], option)
        if length_m <= 0.0:
            raise UsageError(f"The length of {option} is zero.", hint=f"Write it as {option} A B 12.40m.")
        return ScaleFrom(first, second, length_m, local)

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Scale the splat; returns the record of the step.

        Raises:
            SplatpipeError: if the points coincide, or the factor is out of range.
        """
        coordinates = Coordinates.of(piece.facts, self.local)
        first, second = coordinates.in_frame(np.array([self.first, self.second]))
        distance = float(np.linalg.norm(second - first))
        factor = self.length_m / distance if distance > 0.0 else math.inf
        if not SCALE_BOUNDS[0] <= factor <= SCALE_BOUNDS[1]:
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
