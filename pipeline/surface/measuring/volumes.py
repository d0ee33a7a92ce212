"""Volumes between a surface model and a base inside a polygon, with their uncertainty.

The uncertainty has three parts, assumed independent. First, the noise of cells: it is correlated between neighbours,
like the depths of neighbouring pixels, so the variance of a sum is that of the cells times the number of cells that
share an error. Second, the base: a plane through the rim is as uncertain as its fit, whose residuals, correlated along
the rim, contain both the rim's noise and its roughness. Third, if the base's height is stated, a systematic height
error of the whole surface; with a base through the rim, which is off by the same amount, it cancels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.plan_area import PlanArea, Ring
from splatpipe.pipeline.geometry.robust import MAD_TO_SIGMA, huber_weights
from splatpipe.pipeline.surface.heights.surface_file import SurfaceFile
from splatpipe.pipeline.surface.measuring.ground_scale import ground_metres
from splatpipe.pipeline.surface.rasters.map_crs import MapCrs
from splatpipe.pipeline.surface.rasters.tiles import Tile, tiled
from splatpipe.pipeline.survey.boundary import DIRECTIONS

WINDOW = 1024  # cells per side
PARTS = 5  # subdivisions of a cell's side, for the share inside of a cell that the outline crosses
SHARED_CELLS = 1.0  # s of the noise correlation exp(-d² / 4 s²) of two cells at distance d, in cells: 3.5 along a line
SHARED_ALONG = 2.0 * math.sqrt(math.pi) * SHARED_CELLS  # sum of that correlation over a line of cells,
SHARED_AROUND = 4.0 * math.pi * SHARED_CELLS**2  # and over an area
RIM_CELLS = 1.0  # spacing of samples on the rim, in cells
MAX_RIM = 1_000_000  # samples: 20 km at 2 cm; a longer rim means a wrong coordinate
MIN_RIM = 12  # samples with heights needed to fit a plane
MIN_RIM_SHARE = 0.5  # least share of the rim that has heights: with less, the base is unreliable
MEDIAN_OF = 5  # neighbouring samples in the median filter: a single cell may be in a hole
DEFAULT_SIGMA_CELLS = 0.5  # assumed deviation where none is stated, in cells
ROUNDS, HUBER = 5, 1.5  # iterations of the plane's robust fit, and deviations beyond which residuals are weighted down

Kind = Literal["rim", "lowest", "stated"]


@dataclass(frozen=True, eq=False)
class Base:
    """A plane: height = terms · (1, east, north), with ground metres from a point in the middle.

    Attributes:
        kind: ``rim``: fitted to the outline's heights. ``lowest``: level, at the lowest of them. ``stated``: level.
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
        base: The plane.
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


@dataclass(frozen=True, eq=False)
class _Ground:
    """A surface inside an outline, metres in plan and height.

    Attributes:
        surface: The surface model, in the CRS's units.
        area: The outline in the CRS's unit.
        plan_m: Ground metres per unit in plan.
        height_m: Metres per unit of height.
    """

    surface: SurfaceFile
    area: PlanArea
    plan_m: float
    height_m: float

    @property
    def cell_m(self) -> float:
        return self.surface.cell * self.plan_m

    def rings(self) -> list[Ring]:
        return [ring for polygon in self.area.polygons for ring in polygon]


def measure_volume(
    surface: SurfaceFile, area: PlanArea, crs: MapCrs, base: Kind | float, datum_sigma_m: float = 0.0
) -> Volume:
    """Compute the volumes between a surface model and a base.

    Args:
        surface: The surface model.
        area: The polygon; east and north, local metres.
        crs: CRS of the surface model.
        base: ``rim``, ``lowest``, or a height in the CRS's unit.
        datum_sigma_m: Standard deviation of a height error common to the whole surface; used for a stated height.

    Raises:
        SplatpipeError: if the outline is absurdly long, lies outside of the surface, or too little of it has heights
            for its base.
    """
    rings = [tuple(_in_crs(ring, crs) for ring in polygon) for polygon in area.polygons]
    ground = _Ground(surface, PlanArea.seen_from_above(rings), ground_metres(crs), crs.height_unit_m)
    if not sum(_lengths(ring)[-1] for ring in ground.rings()) <= MAX_RIM * RIM_CELLS * surface.cell:
        raise SplatpipeError("The polygon's outline is far too long.", "Check its coordinates and its CRS.")
    _require_near(ground)
    plane = _base(ground, base, datum_sigma_m)
    sums = _CutFillSums.zero()
    for part in _windows(ground):
        sums = sums.plus(_part(ground, plane, part))
    whole_m2 = ground.area.size() * ground.plan_m**2
    if sums.known_m2 == 0.0:
        raise SplatpipeError("The surface model has no heights inside the polygon.", "Check its place and its CRS.")
    cut, fill = (_amount(sums, plane, side) for side in (0, 1))
    net = Amount(cut.m3 - fill.m3, _sigma(float(sums.noise.sum()), sums.lever[0] + sums.lever[1], plane))
    return Volume(plane, whole_m2, min(sums.known_m2, whole_m2), cut, fill, net)


def _require_near(ground: _Ground) -> None:
    """Reject a polygon that lies beside the surface model.

    Raises:
        SplatpipeError: if no part of its bounding box is on the raster; says how far away it is.
    """
    lattice, vertices = ground.surface.lattice, np.concatenate(ground.rings())
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    east, north = lattice.east_m, lattice.north_m  # in the CRS's unit
    first = np.array([east, north - lattice.height * lattice.cell_m])
    last = np.array([east + lattice.width * lattice.cell_m, north])
    beside = np.maximum(0.0, np.maximum(first - high, low - last)) * np.where(low > last, 1.0, -1.0) * ground.plan_m
    away = float(np.hypot(*beside))
    if away == 0.0:
        return
    direction = DIRECTIONS[round(math.atan2(beside[1], beside[0]) / (math.pi / 4.0)) % 8]
    distance = f"{away / 1000.0:,.1f} km" if away >= 1000.0 else f"{away:,.0f} m"
    raise SplatpipeError(
        f"The polygon lies {distance} {direction} of the surface model.",
        "Check its CRS (GeoJSON without one is in degrees of WGS 84), and that longitude or easting comes first.",
    )


def _in_crs(ring: Ring, crs: MapCrs) -> Ring:
    return np.asarray(crs.crs_from_local(np.column_stack([ring, np.zeros(len(ring))]))[:, :2])


def _base(ground: _Ground, stated: Kind | float, datum_sigma_m: float) -> Base:
    vertices = np.concatenate(ground.rings())
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    if not isinstance(stated, str):
        height = float(stated) * ground.height_m
        return Base("stated", middle, np.array([height, 0.0, 0.0]), np.diag([datum_sigma_m**2, 0.0, 0.0]), None)
    places = [_sample_ring(ring, ground.surface.cell * RIM_CELLS) for ring in ground.rings()]
    heights = [ground.surface.along(place) for place in places]
    up = np.concatenate([height for height, _ in heights]) * ground.height_m
    sigma = _or_default(np.concatenate([sigma for _, sigma in heights]), ground.cell_m)
    known = np.isfinite(up)
    if known.sum() < MIN_RIM or known.mean() < MIN_RIM_SHARE:
        raise SplatpipeError(
            f"Only {100.0 * known.mean():.0f} % of the polygon's outline has heights, which is too little for a base.",
            "Draw it where the surface has heights, or give the base's height.",
        )
    if stated == "lowest":
        return _lowest_base(middle, up[known], sigma[known])
    east, north = ((np.concatenate(places) - middle)[known] * ground.plan_m).T
    return _fit_rim(middle, np.stack([np.ones(len(east)), east, north], axis=1), up[known], sigma[known])


def _sample_ring(ring: Ring, step: float) -> Float64[np.ndarray, "n 2"]:
    """Evenly spaced points on a closed outline."""
    closed, way = np.concatenate([ring, ring[:1]]), _lengths(ring)
    count = max(MIN_RIM, round(way[-1] / step))
    at = np.arange(count) / count * way[-1]
    return np.stack([np.interp(at, way, closed[:, axis]) for axis in (0, 1)], axis=1)


def _lengths(ring: Ring) -> Float64[np.ndarray, " n"]:
    """Cumulative length of a closed outline at each vertex, and its total length."""
    closed = np.concatenate([ring, ring[:1]])
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])


def _or_default(sigma: Float64[np.ndarray, " *n"], cell_m: float) -> Float64[np.ndarray, " *n"]:
    return np.where(np.isfinite(sigma), sigma, DEFAULT_SIGMA_CELLS * cell_m)


def _lowest_base(
    middle: Float64[np.ndarray, " 2"], up: Float64[np.ndarray, " n"], sigma: Float64[np.ndarray, " n"]
) -> Base:
    wide = np.concatenate([up[-(MEDIAN_OF // 2) :], up, up[: MEDIAN_OF // 2]])
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(wide, MEDIAN_OF), axis=1)
    least = int(np.argmin(smooth))
    variance = float(sigma[least] ** 2)
    return Base("lowest", middle, np.array([smooth[least], 0.0, 0.0]), np.diag([variance, 0.0, 0.0]), None)


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
    return Base("rim", middle, terms, covariance, float(np.sqrt(np.mean(np.square(off)))))


def _windows(ground: _Ground) -> Iterator[Tile]:
    """Parts of the raster that the outline's bounding box covers."""
    vertices = np.concatenate(ground.rings())
    column, row = ground.surface.lattice.places(vertices[:, 0], vertices[:, 1])
    lattice = ground.surface.lattice
    left, right = np.clip([math.floor(column.min()), math.ceil(column.max())], 0, lattice.width).tolist()
    top, bottom = np.clip([math.floor(row.min()), math.ceil(row.max())], 0, lattice.height).tolist()
    for part in tiled(bottom - top, right - left, WINDOW):
        yield Tile(part.row + top, part.column + left, part.height, part.width)


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
    lever: Float64[np.ndarray, "2 3"]

    @staticmethod
    def zero() -> _CutFillSums:
        return _CutFillSums(0.0, np.zeros(2), np.zeros(2), np.zeros((2, 3)))

    def plus(self, other: _CutFillSums) -> _CutFillSums:
        return _CutFillSums(
            self.known_m2 + other.known_m2, self.m3 + other.m3, self.noise + other.noise, self.lever + other.lever
        )


def _part(ground: _Ground, base: Base, part: Tile) -> _CutFillSums:
    share = _shares(ground, part)
    height = ground.surface.heights(part) * ground.height_m
    known = (share > 0.0) & np.isfinite(height)
    if not known.any():
        return _CutFillSums.zero()
    places = (ground.surface.lattice.centres(part)[known] - base.middle) * ground.plan_m
    terms = np.column_stack([np.ones(len(places)), places])
    over = height[known] - terms @ base.terms
    cells_m2 = share[known] * ground.cell_m**2
    noise = np.square(cells_m2 * _or_default(ground.surface.sigmas_m(part)[known], ground.cell_m)) * SHARED_AROUND
    above = over > 0.0
    sides = [cells_m2 * above, cells_m2 * ~above]
    return _CutFillSums(
        float(cells_m2.sum()),
        np.array([(side * np.abs(over)).sum() for side in sides]),
        np.array([(noise * (side > 0.0)).sum() for side in sides]),
        np.stack([side @ terms for side in sides]),
    )


def _shares(ground: _Ground, part: Tile) -> Float64[np.ndarray, "h w"]:
    """The share of each cell that lies inside."""
    lattice = ground.surface.lattice
    centres = lattice.centres(part)
    shape = centres.shape[:2]
    share = ground.area.contains(_flat(centres.reshape(-1, 2))).astype(np.float64).reshape(shape)
    crossed = np.zeros(shape, np.bool_)
    for ring in ground.rings():
        column, row = lattice.places(*_sample_ring(ring, lattice.cell_m / PARTS).T)
        for down in (-1, 0, 1):  # also a sample's neighbours: an outline may cut a corner between two samples
            for right in (-1, 0, 1):
                j = np.floor(column).astype(np.int64) - part.column + right
                i = np.floor(row).astype(np.int64) - part.row + down
                inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])
                crossed[i[inside], j[inside]] = True
    off = ((np.arange(PARTS) + 0.5) / PARTS - 0.5) * lattice.cell_m
    finer = centres[crossed][:, None] + np.stack(np.meshgrid(off, off), axis=-1).reshape(1, -1, 2)
    within = ground.area.contains(_flat(finer.reshape(-1, 2))).reshape(-1, PARTS * PARTS)
    share[crossed] = within.mean(axis=1)
    return share


def _flat(plan: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    return np.column_stack([plan, np.zeros(len(plan))])


def _amount(sums: _CutFillSums, base: Base, side: int) -> Amount:
    return Amount(float(sums.m3[side]), _sigma(float(sums.noise[side]), sums.lever[side], base))


def _sigma(noise: float, lever: Float64[np.ndarray, " 3"], base: Base) -> float:
    return math.sqrt(noise + float(lever @ base.covariance @ lever))
