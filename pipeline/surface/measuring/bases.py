"""What volumes are measured over: a plane, or the ground under the surface."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.robust import MAD_TO_SIGMA, huber_weights
from splatpipe.pipeline.surface.measuring.correlation import SHARED_ALONG
from splatpipe.pipeline.surface.measuring.outlined import MIN_RIM, RIM_CELLS, OutlinedSurface, sample_ring
from splatpipe.pipeline.surface.rasters.tiles import Tile

MIN_RIM_SHARE = 0.5  # least share of the rim that has heights: with less, the base is unreliable
MEDIAN_OF = 5  # neighbouring samples in the median filter: a single cell may be in a hole
ROUNDS, HUBER = 5, 1.5  # iterations of the plane's robust fit, and deviations beyond which residuals are weighted down
DIGITS = 4  # decimals of its facts: a tenth of a millimetre

Plane = Literal["rim", "lowest"]
Kind = Literal["rim", "lowest", "stated", "ground"]


@dataclass(frozen=True, eq=False)
class BaseCells:
    """A base at some cells.

    Attributes:
        height_m: Its heights, metres.
        lever: Derivatives of the heights with respect to what the base's covariance is of.
        surface: Whether the measured surface itself is the base there: its errors are the base's, and cancel.
    """

    height_m: Float64[np.ndarray, " n"]
    lever: Float64[np.ndarray, "n k"]
    surface: Bool[np.ndarray, " n"]


class Base(ABC):
    """What volumes are measured over.

    Attributes:
        kind: ``rim``: a plane fitted to the outline's heights. ``lowest``: level, at the lowest of them. ``stated``:
            level. ``ground``: the terrain model.
        covariance: Covariance of the terms that its heights depend on: (k, k).
    """

    kind: Kind
    covariance: Float64[np.ndarray, "k k"]

    @abstractmethod
    def at(self, outlined: OutlinedSurface, part: Tile, known: Bool[np.ndarray, "h w"]) -> BaseCells:
        """The base at some cells of a part of the raster; NaN where it has no height."""

    @abstractmethod
    def facts(self) -> dict[str, Any]:
        """Its figures as JSON values."""


@dataclass(frozen=True, eq=False)
class PlaneBase(Base):
    """A plane: height = terms · (1, east, north), with ground metres from a point in the middle.

    Attributes:
        kind: ``rim``, ``lowest`` or ``stated``.
        middle: Easting and northing of that point, in the CRS's unit.
        terms: Height in the middle, slope towards east, slope towards north.
        covariance: Covariance of the terms.
        misfit_m: RMS distance of the rim from the plane, metres; None for a level base.
    """

    kind: Kind
    middle: Float64[np.ndarray, " 2"]
    terms: Float64[np.ndarray, " 3"]
    covariance: Float64[np.ndarray, "3 3"]
    misfit_m: float | None

    def at(self, outlined: OutlinedSurface, part: Tile, known: Bool[np.ndarray, "h w"]) -> BaseCells:
        """The plane at some cells."""
        places = (outlined.surface.lattice.centres(part)[known] - self.middle) * outlined.plan_m
        lever = np.column_stack([np.ones(len(places)), places])
        return BaseCells(lever @ self.terms, lever, np.zeros(len(places), np.bool_))

    def facts(self) -> dict[str, Any]:
        """Its height in metres in the CRS's datum, its position in the CRS's unit, its slopes and its misfit."""
        return {
            "kind": self.kind,
            "place": [round(float(value), DIGITS) for value in self.middle],
            "height_m": round(float(self.terms[0]), DIGITS),
            "height_sigma_m": round(float(self.covariance[0, 0]) ** 0.5, DIGITS),
            "rise_to_east_percent": round(100.0 * float(self.terms[1]), DIGITS),
            "rise_to_north_percent": round(100.0 * float(self.terms[2]), DIGITS),
            "rim_misfit_m": None if self.misfit_m is None else round(self.misfit_m, DIGITS),
        }


@dataclass(frozen=True, eq=False)
class GroundBase(Base):
    """The terrain model: the surface where it is ground, and what is filled in under all else.

    Errors of filled ground are shared by all of it inside an outline, which is the worst case: it hangs on the same
    few metres of ground around.

    Attributes:
        terrain: The terrain model inside the outline, on the surface model's grid.
        kind: ``ground``.
        covariance: 1: one error, in its expected deviations.
    """

    terrain: OutlinedSurface
    kind: Kind
    covariance: Float64[np.ndarray, "1 1"]

    @staticmethod
    def of(terrain: OutlinedSurface) -> GroundBase:
        """The base on a terrain model."""
        return GroundBase(terrain, "ground", np.ones((1, 1)))

    def at(self, outlined: OutlinedSurface, part: Tile, known: Bool[np.ndarray, "h w"]) -> BaseCells:
        """The ground at some cells."""
        terrain = self.terrain.surface.heights(part)[known]
        own = terrain == outlined.surface.heights(part)[known]
        sigma_m = np.where(own, 0.0, self.terrain.sigmas_m(part)[known])
        return BaseCells(terrain * self.terrain.height_m, sigma_m[:, None], own)

    def facts(self) -> dict[str, Any]:
        """Only what it is: it has no height of its own."""
        return {"kind": self.kind}


def stated_base(outlined: OutlinedSurface, height: float, datum_sigma_m: float) -> Base:
    """A level base at a height in the CRS's unit."""
    terms = np.array([height * outlined.height_m, 0.0, 0.0])
    return PlaneBase("stated", outlined.middle, terms, np.diag([datum_sigma_m**2, 0.0, 0.0]), None)


def rim_base(outlined: OutlinedSurface, kind: Plane) -> Base:
    """A base from the heights of the outline.

    Raises:
        SplatpipeError: if too little of it has heights, or it encloses no area.
    """
    middle = outlined.middle
    places = [sample_ring(ring, outlined.surface.cell * RIM_CELLS) for ring in outlined.rings()]
    heights = [outlined.surface.along(place) for place in places]
    up = np.concatenate([height for height, _ in heights]) * outlined.height_m
    sigma = outlined.or_default(np.concatenate([sigma for _, sigma in heights]))
    known = np.isfinite(up)
    if known.sum() < MIN_RIM or known.mean() < MIN_RIM_SHARE:
        raise SplatpipeError(
            f"Only {100.0 * known.mean():.0f} % of the polygon's outline has heights, which is too little for a base.",
            "Draw it where the surface has heights, or give the base's height.",
        )
    if kind == "lowest":
        return _lowest_base(middle, up[known], sigma[known])
    east, north = ((np.concatenate(places) - middle)[known] * outlined.plan_m).T
    return _fit_rim(middle, np.stack([np.ones(len(east)), east, north], axis=1), up[known], sigma[known])


def _lowest_base(
    middle: Float64[np.ndarray, " 2"], up: Float64[np.ndarray, " n"], sigma: Float64[np.ndarray, " n"]
) -> Base:
    wide = np.concatenate([up[-(MEDIAN_OF // 2) :], up, up[: MEDIAN_OF // 2]])
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(wide, MEDIAN_OF), axis=1)
    least = int(np.argmin(smooth))
    variance = float(sigma[least] ** 2)
    return PlaneBase("lowest", middle, np.array([smooth[least], 0.0, 0.0]), np.diag([variance, 0.0, 0.0]), None)


def _fit_rim(
    middle: Float64[np.ndarray, " 2"],
    design: Float64[np.ndarray, "n 3"],
    up: Float64[np.ndarray, " n"],
    sigma: Float64[np.ndarray, " n"],
) -> Base:
    """Robust fit of the plane through the rim (Huber weights), with a covariance that allows for correlated noise."""
    weight = np.ones(len(up))
    terms = np.zeros(3)
    spread = 0.0
    for _ in range(ROUNDS):
        normal = design.T @ (weight[:, None] * design)
        if np.linalg.cond(normal) > 1e12:
            raise SplatpipeError("The polygon's outline encloses no area to fit a plane to.", "Draw another one.")
        terms = np.linalg.solve(normal, design.T @ (weight * up))
        off = up - design @ terms
        spread = max(MAD_TO_SIGMA * float(np.median(np.abs(off))), 1e-6)
        weight = huber_weights(off, HUBER * spread)
    off = up - design @ terms
    variance = max(float(np.average(np.square(off), weights=weight)), float(np.mean(np.square(sigma))))
    covariance = np.linalg.inv(design.T @ (weight[:, None] * design)) * variance * SHARED_ALONG / RIM_CELLS
    return PlaneBase("rim", middle, terms, covariance, float(np.sqrt(np.mean(np.square(off)))))
