"""Volumes between a surface model and a base inside a polygon, with their uncertainty.

The uncertainty has three parts, assumed independent. First, the noise of cells: it is correlated between neighbours,
like the depths of neighbouring pixels, so the variance of a sum is that of the cells times the number of cells that
share an error. Second, the base: a plane through the rim is as uncertain as its fit, whose residuals, correlated along
the rim, contain both the rim's noise and its roughness; ground that was filled in is as uncertain as the terrain model
says. Third, if the base's height is stated, a systematic height error of the whole surface; with any other base, which
is off by the same amount, it cancels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.plan_area import PlanArea, Ring
from splatpipe.pipeline.surface.heights.surface_file import SurfaceFile
from splatpipe.pipeline.surface.measuring.bases import Base, GroundBase, Plane, rim_base, stated_base
from splatpipe.pipeline.surface.measuring.correlation import SHARED_AROUND
from splatpipe.pipeline.surface.measuring.ground_scale import ground_metres
from splatpipe.pipeline.surface.measuring.outlined import OutlinedSurface
from splatpipe.pipeline.surface.rasters.map_crs import MapCrs
from splatpipe.pipeline.surface.rasters.tiles import Tile


@dataclass(frozen=True)
class Amount:
    """A volume.

    Attributes:
        m3: Cubic metres.
        sigma_m3: Its expected deviation.
    """

    m3: float
    sigma_m3: float


@dataclass(frozen=True, eq=False)
class Volume:
    """Volumes above and below a base.

    Attributes:
        base: The base.
        area_m2: Ground area of the polygon.
        known_m2: The part of it with heights, to which the volumes refer.
        cut: Volume above the base, to be removed.
        fill: Volume below it, to be filled.
        net: Cut minus fill.
    """

    base: Base
    area_m2: float
    known_m2: float
    cut: Amount
    fill: Amount
    net: Amount


def measure_volume(
    surface: SurfaceFile, area: PlanArea, crs: MapCrs, base: Plane | SurfaceFile | float, datum_sigma_m: float = 0.0
) -> Volume:
    """Compute the volumes between a surface model and a base.

    Args:
        surface: The surface model.
        area: The polygon; east and north, local metres.
        crs: CRS of the surface model.
        base: ``rim``, ``lowest``, a height in the CRS's unit, or the terrain model on the same grid.
        datum_sigma_m: Standard deviation of a height error common to the whole surface; used for a stated height.

    Raises:
        SplatpipeError: if the outline is absurdly long, lies outside of the surface, or too little of it has heights
            for its base.
    """
    rings = [tuple(_in_crs(ring, crs) for ring in polygon) for polygon in area.polygons]
    inside = PlanArea.seen_from_above(rings)
    outlined = OutlinedSurface(surface, inside, ground_metres(crs), crs.height_unit_m)
    outlined.require_near()
    if isinstance(base, SurfaceFile):
        found: Base = GroundBase.of(OutlinedSurface(base, inside, outlined.plan_m, outlined.height_m))
    else:
        found = rim_base(outlined, base) if isinstance(base, str) else stated_base(outlined, base, datum_sigma_m)
    sums = _CutFillSums.zero(len(found.covariance))
    for part in outlined.windows():
        sums = sums.plus(_part(outlined, found, part))
    whole_m2 = outlined.area_m2
    if sums.known_m2 == 0.0:
        raise SplatpipeError("The surface model has no heights inside the polygon.", "Check its place and its CRS.")
    cut, fill = (_amount(sums, found, side) for side in (0, 1))
    net = Amount(cut.m3 - fill.m3, _sigma(float(sums.noise.sum()), sums.lever[0] + sums.lever[1], found))
    return Volume(found, whole_m2, min(sums.known_m2, whole_m2), cut, fill, net)


def _in_crs(ring: Ring, crs: MapCrs) -> Ring:
    return np.asarray(crs.crs_from_local(np.column_stack([ring, np.zeros(len(ring))]))[:, :2])


@dataclass(frozen=True, eq=False)
class _CutFillSums:
    """Sums over cells, for cut and fill each.

    Attributes:
        known_m2: Area with heights.
        m3: Volumes.
        noise: Variance from the cells' own noise.
        lever: Derivatives with respect to the base's terms: cut falls and fill grows by these, net falls by their sum.
    """

    known_m2: float
    m3: Float64[np.ndarray, " 2"]
    noise: Float64[np.ndarray, " 2"]
    lever: Float64[np.ndarray, "2 k"]

    @staticmethod
    def zero(terms: int) -> _CutFillSums:
        return _CutFillSums(0.0, np.zeros(2), np.zeros(2), np.zeros((2, terms)))

    def plus(self, other: _CutFillSums) -> _CutFillSums:
        return _CutFillSums(
            self.known_m2 + other.known_m2, self.m3 + other.m3, self.noise + other.noise, self.lever + other.lever
        )


def _part(outlined: OutlinedSurface, base: Base, part: Tile) -> _CutFillSums:
    share = outlined.shares(part)
    height = outlined.surface.heights(part) * outlined.height_m
    known = (share > 0.0) & np.isfinite(height)
    below = base.at(outlined, part, known)
    both = np.isfinite(below.height_m)
    if not both.any():
        return _CutFillSums.zero(len(base.covariance))
    over = (height[known] - below.height_m)[both]
    cells_m2 = (share[known] * outlined.cell_m**2)[both]
    noise = np.square(cells_m2 * outlined.sigmas_m(part)[known][both]) * SHARED_AROUND
    noise = np.where(below.surface[both], 0.0, noise)
    above = over > 0.0
    sides = [cells_m2 * above, cells_m2 * ~above]
    return _CutFillSums(
        float(cells_m2.sum()),
        np.array([(side * np.abs(over)).sum() for side in sides]),
        np.array([(noise * (side > 0.0)).sum() for side in sides]),
        np.stack([side @ below.lever[both] for side in sides]),
    )


def _amount(sums: _CutFillSums, base: Base, side: int) -> Amount:
    return Amount(float(sums.m3[side]), _sigma(float(sums.noise[side]), sums.lever[side], base))


def _sigma(noise: float, lever: Float64[np.ndarray, " k"], base: Base) -> float:
    return math.sqrt(noise + float(lever @ base.covariance @ lever))
