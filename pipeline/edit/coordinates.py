"""How places are stated: in the CRS of a splat that lies on the earth, or in the splat's own frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.splat.scene import SceneFacts, turn_of
from splatpipe.pipeline.survey.handover import frame_of
from splatpipe.pipeline.survey.world import World, open_world

LARGEST = 1e9  # of a coordinate: beyond it there is no earth
OWN, LOCAL = "own", "local"
LONGEST_SHOWN = 60  # characters of what a user wrote, in a message


@dataclass(frozen=True, eq=False)
class Coordinates:
    """What numbers mean. The frame that steps work in is the splat's, turned to z up.

    Attributes:
        name: ``own`` (the file's axes), ``local`` (metres east, north, up of the place), or the CRS.
        world: Where they are a CRS's; None else.
        frame_from_stated: Turns the axes that directions are stated along, and places without a CRS.
    """

    name: str
    world: World | None
    frame_from_stated: Float64[np.ndarray, "3 3"]

    @staticmethod
    def of(facts: SceneFacts, local: bool) -> Coordinates:
        """Those that places are stated in for a splat.

        Args:
            facts: The splat's.
            local: Numbers are metres from its place, not coordinates of its CRS.

        Raises:
            SplatpipeError: if its CRS cannot be used there.
        """
        if facts.place is None:
            return Coordinates(OWN, None, turn_of("z up", facts.axes).numpy())
        if local:
            return Coordinates(LOCAL, None, np.eye(3))
        world = open_world(frame_of(facts.place))
        return Coordinates(world.crs.text, world, np.eye(3))

    def stated(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Points of the frame as people state them."""
        if self.world is not None:
            return self.world.crs_from_local(points)
        return np.asarray(points @ self.frame_from_stated)

    def in_frame(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Stated points in the frame.

        Raises:
            UsageError: if the CRS has no such place.
        """
        if self.world is None:
            return np.asarray(points @ self.frame_from_stated.T)
        found = self.world.local_from_crs(points)
        if not (np.isfinite(found).all() and (np.abs(found) <= LARGEST).all()):
            raise UsageError(
                f"{self.name} has no place for {_shown(points[~np.isfinite(found).all(axis=1)])}.",
                hint="East (or longitude) comes first. With --local, numbers are metres from the splat's origin.",
            )
        return found


def parse_numbers(text: str, option: str, counts: Sequence[int], form: str) -> tuple[float, ...]:
    """Numbers with commas between them.

    Args:
        text: What the user wrote.
        option: Where, for the message.
        counts: How many there may be.
        form: How it is written, for the hint.

    Raises:
        UsageError: if it is anything else, or a number is larger than any of this earth.
    """
    numbers = [_number(part) for part in text.split(",")[: max(counts) + 1]]
    if len(numbers) not in counts or not all(abs(number) <= LARGEST for number in numbers):
        raise UsageError(f'Cannot understand {option} "{text[:LONGEST_SHOWN]}".', hint=f"Write it as {option} {form}.")
    return tuple(numbers)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _shown(points: Float64[np.ndarray, "n 3"]) -> str:
    return ",".join(f"{number:g}" for number in (points[0] if len(points) else np.zeros(0)))
