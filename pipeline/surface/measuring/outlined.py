"""A surface model inside an outline: the parts of its raster, and how much of each cell lies inside."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.plan_area import PlanArea, Ring
from splatpipe.pipeline.surface.heights.surface_file import SurfaceFile
from splatpipe.pipeline.surface.rasters.tiles import Tile, tiled
from splatpipe.pipeline.survey.boundary import DIRECTIONS

WINDOW = 1024  # cells per side
PARTS = 5  # subdivisions of a cell's side, for the share inside of a cell that the outline crosses
RIM_CELLS = 1.0  # spacing of samples on the rim, in cells
MAX_RIM = 1_000_000  # samples: 20 km at 2 cm; a longer rim means a wrong coordinate
MIN_RIM = 12  # samples with heights needed to fit a plane
DEFAULT_SIGMA_CELLS = 0.5  # assumed deviation where none is stated, in cells


@dataclass(frozen=True, eq=False)
class OutlinedSurface:
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
        """Cell size on the ground, metres."""
        return self.surface.cell * self.plan_m

    @property
    def area_m2(self) -> float:
        """Ground area of the outline."""
        return self.area.size() * self.plan_m**2

    @property
    def middle(self) -> Float64[np.ndarray, " 2"]:
        """Easting and northing in the middle of the outline's box, in the CRS's unit."""
        vertices = np.concatenate(self.rings())
        return np.asarray((vertices.min(axis=0) + vertices.max(axis=0)) / 2.0)

    def rings(self) -> list[Ring]:
        """The outline's rings."""
        return [ring for polygon in self.area.polygons for ring in polygon]

    def sigmas_m(self, part: Tile) -> Float64[np.ndarray, "h w"]:
        """Expected deviations of heights, metres, with half a cell where none is stated."""
        return self.or_default(self.surface.sigmas_m(part))

    def or_default(self, sigma: Float64[np.ndarray, " *n"]) -> Float64[np.ndarray, " *n"]:
        """Deviations in metres, with half a cell where one is unknown."""
        return np.where(np.isfinite(sigma), sigma, DEFAULT_SIGMA_CELLS * self.cell_m)

    def require_near(self) -> None:
        """Reject an outline that is absurdly long, or lies beside the surface model.

        Raises:
            SplatpipeError: if no part of its bounding box is on the raster; says how far away it is.
        """
        if not sum(_lengths(ring)[-1] for ring in self.rings()) <= MAX_RIM * RIM_CELLS * self.surface.cell:
            raise SplatpipeError("The polygon's outline is far too long.", "Check its coordinates and its CRS.")
        lattice, vertices = self.surface.lattice, np.concatenate(self.rings())
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        east, north = lattice.east_m, lattice.north_m  # in the CRS's unit
        first = np.array([east, north - lattice.height * lattice.cell_m])
        last = np.array([east + lattice.width * lattice.cell_m, north])
        beside = np.maximum(0.0, np.maximum(first - high, low - last)) * np.where(low > last, 1.0, -1.0) * self.plan_m
        away = float(np.hypot(*beside))
        if away == 0.0:
            return
        direction = DIRECTIONS[round(math.atan2(beside[1], beside[0]) / (math.pi / 4.0)) % 8]
        distance = f"{away / 1000.0:,.1f} km" if away >= 1000.0 else f"{away:,.0f} m"
        raise SplatpipeError(
            f"The polygon lies {distance} {direction} of the surface model.",
            "Check its CRS (GeoJSON without one is in degrees of WGS 84), and that longitude or easting comes first.",
        )

    def windows(self) -> Iterator[Tile]:
        """Parts of the raster that the outline's bounding box covers."""
        vertices, lattice = np.concatenate(self.rings()), self.surface.lattice
        column, row = lattice.places(vertices[:, 0], vertices[:, 1])
        left, right = np.clip([math.floor(column.min()), math.ceil(column.max())], 0, lattice.width).tolist()
        top, bottom = np.clip([math.floor(row.min()), math.ceil(row.max())], 0, lattice.height).tolist()
        for part in tiled(bottom - top, right - left, WINDOW):
            yield Tile(part.row + top, part.column + left, part.height, part.width)

    def shares(self, part: Tile) -> Float64[np.ndarray, "h w"]:
        """The share of each cell that lies inside."""
        lattice = self.surface.lattice
        centres = lattice.centres(part)
        shape = centres.shape[:2]
        share = self.area.contains(_flat(centres.reshape(-1, 2))).astype(np.float64).reshape(shape)
        crossed = np.zeros(shape, np.bool_)
        for ring in self.rings():
            column, row = lattice.places(*sample_ring(ring, lattice.cell_m / PARTS).T)
            for down in (-1, 0, 1):  # also a sample's neighbours: an outline may cut a corner between two samples
                for right in (-1, 0, 1):
                    j = np.floor(column).astype(np.int64) - part.column + right
                    i = np.floor(row).astype(np.int64) - part.row + down
                    inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])
                    crossed[i[inside], j[inside]] = True
        off = ((np.arange(PARTS) + 0.5) / PARTS - 0.5) * lattice.cell_m
        finer = centres[crossed][:, None] + np.stack(np.meshgrid(off, off), axis=-1).reshape(1, -1, 2)
        within = self.area.contains(_flat(finer.reshape(-1, 2))).reshape(-1, PARTS * PARTS)
        share[crossed] = within.mean(axis=1)
        return share


def sample_ring(ring: Ring, step: float) -> Float64[np.ndarray, "n 2"]:
    """Evenly spaced points on a closed outline."""
    closed, way = np.concatenate([ring, ring[:1]]), _lengths(ring)
    count = max(MIN_RIM, round(way[-1] / step))
    at = np.arange(count) / count * way[-1]
    return np.stack([np.interp(at, way, closed[:, axis]) for axis in (0, 1)], axis=1)


def _lengths(ring: Ring) -> Float64[np.ndarray, " n"]:
    """Cumulative length of a closed outline at each vertex, and its total length."""
    closed = np.concatenate([ring, ring[:1]])
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])


def _flat(plan: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    return np.column_stack([plan, np.zeros(len(plan))])
