"""Coordinates in which positions are given: a georeferenced splat's CRS, or the splat's own frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.delivery.delivery_frame import frame_of
from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.splat.model.scene import NO_OFFSET, SceneFacts, turn_of
from splatpipe.pipeline.survey.crs.world import World, open_world

MAX_COORDINATE = 1e9  # largest magnitude of a coordinate, metres or degrees: no place on the earth has a larger one
OWN, LOCAL = "own", "local"
MAX_QUOTED_CHARACTERS = 60  # characters of what a user wrote, in a message


@dataclass(frozen=True, eq=False)
class Coordinates:
    """The meaning of coordinates that a user gives. Steps work in the splat's frame, rotated to z up.

    Attributes:
        name: ``own`` (the file's axes, with an origin that was taken off), ``local`` (metres east, north, up of the
            origin), or the CRS.
        world: Converts between the CRS and the frame; None if the coordinates are not in a CRS.
        frame_from_stated: Rotation of directions, and of positions without a CRS, into the frame.
        offset: What is added to positions of the file, without a CRS.
    """

    name: str
    world: World | None
    frame_from_stated: Float64[np.ndarray, "3 3"]
    offset: tuple[float, float, float] = NO_OFFSET

    @staticmethod
    def of(facts: SceneFacts, local: bool) -> Coordinates:
        """The coordinates in which positions are given for a splat.

        Args:
            facts: The splat's facts.
            local: Numbers are metres from its origin, not coordinates in its CRS.

        Raises:
            SplatpipeError: if its CRS cannot be used there.
        """
        if facts.place is None:
            offset = NO_OFFSET if local else facts.offset
            return Coordinates(OWN, None, turn_of("z up", facts.axes).numpy(), offset)
        if local:
            return Coordinates(LOCAL, None, np.eye(3))
        world = open_world(frame_of(facts.place))
        return Coordinates(world.crs.text, world, np.eye(3))

    def stated(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Convert points from the frame to the coordinates the user gives."""
        if self.world is not None:
            return self.world.crs_from_local(points)
        return np.asarray(points @ self.frame_from_stated + self.offset)

    def heights(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """The heights of points in the frame, along the up direction, whichever of the file's axes that is."""
        if self.world is not None:
            return np.asarray(self.stated(points)[:, 2])
        return np.asarray(points[:, 2] + (self.frame_from_stated @ self.offset)[2])

    def in_frame(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Convert points from the coordinates the user gives to the frame.

        Raises:
            UsageError: if the CRS has no such place.
        """
        if self.world is None:
            return np.asarray((points - self.offset) @ self.frame_from_stated.T)
        found = self.world.local_from_crs(points)
        if not (np.isfinite(found).all() and (np.abs(found) <= MAX_COORDINATE).all()):
            raise UsageError(
                f"{self.name} has no place for {_coordinates_text(points[~np.isfinite(found).all(axis=1)])}.",
                hint="East (or longitude) comes first. With --local, numbers are metres from the splat's origin.",
            )
        return found


def parse_numbers(text: str, option: str, counts: Sequence[int], form: str) -> tuple[float, ...]:
    """Parse comma-separated numbers.

    Args:
        text: What the user wrote.
        option: The option's name, for the message.
        counts: The allowed numbers of values.
        form: The expected form, for the hint.

    Raises:
        UsageError: if it is anything else, or a number is beyond ``MAX_COORDINATE``.
    """
    numbers = [_number(part) for part in text.split(",")[: max(counts) + 1]]
    if len(numbers) not in counts or not all(abs(number) <= MAX_COORDINATE for number in numbers):
        raise UsageError(
            f'Cannot understand {option} "{text[:MAX_QUOTED_CHARACTERS]}".', hint=f"Write it as {option} {form}."
        )
    return tuple(numbers)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _coordinates_text(points: Float64[np.ndarray, "n 3"]) -> str:
    return ",".join(f"{number:g}" for number in (points[0] if len(points) else np.zeros(0)))
