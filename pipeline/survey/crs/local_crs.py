"""A CRS for programs without PROJ: a polynomial of the world's metres, exact to a tenth of a millimetre.

Over a few kilometres a projection is a power series that converges fast: its fourth-order terms are about (L / R)³ L,
which for a scene L = 10 km wide and the earth's radius R is well below a millimetre.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.survey.crs.crs import describe_vertical
from splatpipe.pipeline.survey.crs.world import World

DEGREE = 3
STEPS = 7  # samples along each side, more than there are powers
MIN_REACH_M = 500.0  # least half side of the polynomial's box: people also point at what is around the scene
REACH_PER_SCENE = 2.0


@dataclass(frozen=True, eq=False)
class LocalCrs:
    """Coordinates = origin + Σ coefficient · eᵃ nᵇ uᶜ, with e, n, u = east, north, up over ``scale_m``.

    Attributes:
        id: Identifier that PROJ accepts.
        name: Human-readable name.
        heights: Vertical datum of the heights, human-readable.
        labels: Of the three coordinates, in order: easting or longitude first.
        geographic: Whether the first two are degrees.
        origin: Coordinates of the world's zero.
        scale_m: Metres.
        powers: a, b, c of each term.
        coefficients: Of each term for each coordinate, in the CRS's units.
        largest_error: Of each coordinate against PROJ, at the samples, in the CRS's units.
    """

    id: str
    name: str
    heights: str
    labels: tuple[str, str, str]
    geographic: bool
    origin: Float64[np.ndarray, " 3"]
    scale_m: float
    powers: Int64[np.ndarray, "terms 3"]
    coefficients: Float64[np.ndarray, "terms 3"]
    largest_error: Float64[np.ndarray, " 3"]

    def coordinates(self, local: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """East, north, up (metres) to the CRS."""
        return np.asarray(self.origin + _terms(local / self.scale_m, self.powers) @ self.coefficients)

    def facts(self) -> dict[str, Any]:
        """The polynomial as JSON, for a script that evaluates it."""
        return {
            "id": self.id,
            "name": self.name,
            "labels": list(self.labels),
            "geographic": self.geographic,
            "origin": self.origin.tolist(),
            "scale_m": self.scale_m,
            "powers": self.powers.tolist(),
            "coefficients": self.coefficients.tolist(),
        }


def local_crs(world: World, box: Float64[np.ndarray, "2 3"]) -> LocalCrs:
    """Fit the polynomial.

    Args:
        world: The scene's.
        box: Least and largest east, north, up of the scene, metres.
    """
    reach = max(REACH_PER_SCENE * float(np.abs(box).max()), MIN_REACH_M)
    side = reach * np.cos(np.pi * (np.arange(STEPS) + 0.5) / STEPS)  # Chebyshev's nodes: the error is even
    samples = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    powers = np.array([p for p in itertools.product(range(DEGREE + 1), repeat=3) if 0 < sum(p) <= DEGREE], np.int64)
    origin = world.crs_from_local(np.zeros((1, 3)))[0]
    wanted = world.crs_from_local(samples) - origin
    terms = _terms(samples / reach, powers)
    coefficients = np.linalg.lstsq(terms, wanted, rcond=None)[0]
    geographic = world.crs.is_geographic
    return LocalCrs(
        id=world.crs.text,
        name=world.crs.name,
        heights=describe_vertical(world.heights),
        labels=("Lon", "Lat", "H") if geographic else ("E", "N", "H"),
        geographic=geographic,
        origin=origin,
        scale_m=reach,
        powers=powers,
        coefficients=coefficients,
        largest_error=np.abs(terms @ coefficients - wanted).max(axis=0),
    )


def _terms(steps: Float64[np.ndarray, "n 3"], powers: Int64[np.ndarray, "terms 3"]) -> Float64[np.ndarray, "n terms"]:
    return np.asarray((steps[:, None, :] ** powers[None]).prod(axis=2))
