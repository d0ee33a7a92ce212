"""How far positions are spread: whether they can determine a model's scale and rotation at all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatpipe.pipeline.geometry.correspondences import MIN_NOISE_FACTOR
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.placing.fitting import MAX_SIGMA_SCALE, MIN_POSITIONS
from splatpipe.pipeline.survey.positions.position_sources import same_place

LINE_SIGMAS = 1.0  # root mean square distance from a line, over the stated accuracy
LINE_WIDTH = 0.1  # width of a line over its length, both root mean squares: a small loop is no line, however inaccurate
NUMBERS = {1: "one", 2: "two"}


@dataclass(frozen=True)
class PositionSpread:
    """The spread of a set of positions.

    Attributes:
        photos: How many there are.
        places: How many of them are different.
        root_squares_m: Root of the sum of squared distances from their mean, along their three main axes, longest
            first.
        extent_m: The diagonal of their bounding box.
    """

    photos: int
    places: int
    root_squares_m: tuple[float, float, float]
    extent_m: float

    @property
    def too_few(self) -> str:
        """Why they determine no similarity, a clause; empty if they are enough."""
        if self.places >= MIN_POSITIONS:
            return ""
        if self.photos == self.places:
            return f"only {self.photos} photo{'s have' if self.photos > 1 else ' has'} a position"
        if self.places == 1:
            return f"all {self.photos} photo positions are one and the same"
        return f"the {self.photos} photo positions are only {NUMBERS[self.places]} different places"

    def is_too_close(self, sigma_m: float) -> bool:
        """Whether no fit can determine the scale, even if the positions are much better than stated."""
        return MIN_NOISE_FACTOR * sigma_m > MAX_SIGMA_SCALE * math.hypot(*self.root_squares_m)

    def is_line(self, sigma_m: float) -> bool:
        """Whether the positions do not depart from a line by more than their accuracy."""
        length, width, _ = self.root_squares_m
        return width < min(LINE_SIGMAS * sigma_m * math.sqrt(self.photos), LINE_WIDTH * length)


def spread_of(geodetic: Sequence[tuple[float, float, float]]) -> PositionSpread:
    """Measure the spread of positions.

    Args:
        geodetic: Latitude and longitude in degrees, height in metres; at least one.
    """
    places = {(*same_place(latitude, longitude), round(height, 3)) for latitude, longitude, height in geodetic}
    local = Origin(*geodetic[0]).enu_from_geodetic(np.array(geodetic, dtype=np.float64))
    values = np.linalg.svd(local - local.mean(axis=0), compute_uv=False)
    first, second, third = (float(value) for value in np.pad(values, (0, 3))[:3])
    return PositionSpread(
        len(geodetic), len(places), (first, second, third), float(np.linalg.norm(np.ptp(local, axis=0)))
    )
