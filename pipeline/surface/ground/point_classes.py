"""Classes of a cloud's points, as LAS has them, from the surface model, the terrain model and the roofs.

2 is ground: near the terrain. 6 is building: under a roof or in its edges, so that walls are included. 5 is high
vegetation: from 2 m over the ground, where normals point everywhere. 7 and 18 are low and high noise: under the
terrain, or alone over the topmost surface. 1 is everything else.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from splatpipe.pipeline.surface.ground.ground_filter import NOISE_GSD
from splatpipe.pipeline.surface.ground.terrain import BUILDING, GROUND, OTHER
from splatpipe.pipeline.surface.heights.height_field import HeightField
from splatpipe.pipeline.surface.heights.surface_file import SurfaceFile
from splatpipe.pipeline.surface.rasters.grid import Grid
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile

HIGH_VEGETATION, LOW_NOISE, HIGH_NOISE = 5, 7, 18
LOW_NOISE_GSD = 8.0  # below the ground: twice what noise makes of it
HIGH_NOISE_GSD, HIGH_NOISE_M = 20.0, 0.5  # over the topmost surface nearby, where there are few points: the sum of both
LONELY = 8  # points in a cube, of some 200 on a surface, up to which they are alone
EDGE_M = 0.35  # around a roof as seen from above: its edge, and walls without eaves
OVER_ROOF_M = 0.5  # aerials, and what noise makes of a ridge; higher points are of trees over the roof
VEGETATION_M = 2.0  # over the ground: high vegetation, by usage
CUBE = 16  # spacings of the points a side
MAX_PARALLEL = 0.9  # length of the mean normal in a cube, above which it is a surface

Points = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class PointClassifier:
    """Classifies points over a finished terrain model.

    Attributes:
        surface: The surface model.
        terrain: The terrain model, on the same grid.
        cover: What each cell shows, on the same grid.
        grid: The grid.
        gsd_m: GSD of the photos, metres.
    """

    surface: SurfaceFile
    terrain: SurfaceFile
    cover: SurfaceFile
    grid: Grid
    gsd_m: float

    def classify(
        self, positions: Points, normals: Float32[np.ndarray, "n 3"], corner: tuple[float, float], spacing_m: float
    ) -> UInt8[np.ndarray, " n"]:
        """Classify points that lie together; cubes of ``CUBE`` spacings have to be whole.

        Args:
            positions: East, north, up, metres.
            normals: Of unit length.
            corner: East and north of a corner of the cubes, metres.
            spacing_m: Spacing of the points, metres.
        """
        if not len(positions):
            return np.zeros(0, np.uint8)
        cells = self.grid.cells_from_local(positions)
        radius = max(1, round(EDGE_M / self.grid.cell_m))
        low, high = np.floor(cells[:, :2].min(axis=0)).astype(int), np.floor(cells[:, :2].max(axis=0)).astype(int)
        part = Tile(low[1] - radius, low[0] - radius, *(int(each) + 2 * radius + 1 for each in (high - low)[::-1]))
        unit_m = self.grid.crs.height_unit_m
        height = cells[:, 2] * unit_m
        row = np.floor(cells[:, 1]).astype(np.int64) - part.row
        column = np.floor(cells[:, 0]).astype(np.int64) - part.column
        over = height - self._ground_at(part, cells)
        top, roof = self._tops(part, radius)
        count, parallel = _cubes(positions, normals, corner, CUBE * spacing_m)
        classes = np.full(len(positions), OTHER, np.uint8)
        with np.errstate(invalid="ignore"):  # nothing is known where there are no heights
            above = over > NOISE_GSD * self.gsd_m
            classes[above & (over >= VEGETATION_M) & (parallel < MAX_PARALLEL)] = HIGH_VEGETATION
            classes[above & (height <= roof[row, column] + OVER_ROOF_M)] = BUILDING
            classes[np.abs(over) <= NOISE_GSD * self.gsd_m] = GROUND
            classes[over < -LOW_NOISE_GSD * self.gsd_m] = LOW_NOISE
            far = height > top[row, column] + HIGH_NOISE_GSD * self.gsd_m + HIGH_NOISE_M
            classes[far & (count <= LONELY)] = HIGH_NOISE
        return classes

    def _ground_at(self, part: Tile, cells: Points) -> Float64[np.ndarray, " n"]:
        """Heights of the ground at points, metres."""
        heights = (self.terrain.heights(part) * self.grid.crs.height_unit_m).astype(np.float32)
        lattice = Lattice(0.0, 0.0, self.grid.cell_m, part.width, part.height)
        east, south = (cells[:, 0] - part.column) * self.grid.cell_m, (cells[:, 1] - part.row) * self.grid.cell_m
        return HeightField(lattice, heights).at(east, -south)

    def _tops(self, part: Tile, radius: int) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
        """Heights of the topmost surface (infinite where unknown), and of roofs (minus infinity), metres."""
        heights = self.surface.heights(part) * self.grid.crs.height_unit_m
        is_roof = self.cover.heights(part) == BUILDING
        around = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
        top = cv2.dilate(np.where(np.isfinite(heights), heights, -np.inf), around, borderValue=-np.inf)
        roof = cv2.dilate(np.where(is_roof & np.isfinite(heights), heights, -np.inf), around, borderValue=-np.inf)
        return np.where(np.isfinite(top), top, np.inf), np.asarray(roof)


def _cubes(
    positions: Points, normals: Float32[np.ndarray, "n 3"], corner: tuple[float, float], side_m: float
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Number of points in each point's cube, and the length of their mean normal."""
    cube = np.floor((positions - [*corner, 0.0]) / side_m).astype(np.int64)
    _, place = np.unique(cube, axis=0, return_inverse=True)
    place = place.reshape(-1)
    count = np.bincount(place)
    total = np.stack([np.bincount(place, normals[:, axis].astype(np.float64)) for axis in range(3)], axis=1)
    return count[place], (np.linalg.norm(total, axis=1) / count)[place]
