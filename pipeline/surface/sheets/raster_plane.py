"""Sheets: planes of cells on which rasters are computed, level for the ground and vertical for façades.

Cameras are transformed into the sheet's frame, in which the surface nearest to the viewer is the highest. A large
raster is computed on many small sheets, so that each is practically plane: at the border of a sheet 100 m wide, the
earth's curvature amounts to 0.2 mm, and plumb lines lean by 1 in 100,000.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource
from splatpipe.pipeline.surface.depths.sources import DepthSource, HeightRange, MetricMap, PosedDepthMap
from splatpipe.pipeline.surface.rasters.grid import Grid
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile, tiled

SIDE = 2048  # cells per side of a ground sheet: four blocks of the files


@dataclass(frozen=True, eq=False)
class RasterPlane:
    """A plane with cells, and the height range to consider over it.

    Attributes:
        from_local: Rigid, from local metres to the plane's: along the rows, against the columns, towards the viewer.
        lattice: Its cells.
        relief: Range of heights over the plane.
    """

    from_local: Float64[np.ndarray, "4 4"]
    lattice: Lattice
    relief: HeightRange

    def plane_from_local(self, local: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """East, north, up (metres) in the plane's frame."""
        return np.asarray(local @ self.from_local[:3, :3].T + self.from_local[:3, 3])

    def local_from_plane(self, places: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """The inverse of ``plane_from_local``."""
        return np.asarray((places - self.from_local[:3, 3]) @ self.from_local[:3, :3])

    def transform_camera(self, camera: Camera) -> Camera:
        """Transform a camera from the local to the plane's frame."""
        back = np.eye(4)
        back[:3, :3] = self.from_local[:3, :3].T
        back[:3, 3] = -back[:3, :3] @ self.from_local[:3, 3]
        return replace(camera, cam_from_world=camera.cam_from_world @ back)

    def transform_depths(self, source: DepthSource) -> DepthSource:
        """Transform a photo's depths from the local to the plane's frame."""
        camera = self.transform_camera(source.camera)

        def load() -> PosedDepthMap:
            found = source.load()
            return MetricMap(camera, found.depth, found.confidence)

        return DepthSource(camera, load)

    def transform_photo(self, photo: PhotoSource) -> PhotoSource:
        """Transform a photo with its depths from the local to the plane's frame."""
        depths = None if photo.depths is None else self.transform_depths(photo.depths)
        return replace(photo, camera=self.transform_camera(photo.camera), depths=depths)


@dataclass(frozen=True, eq=False)
class GridSheet:
    """A part of a raster's grid as a sheet, level at the middle of the part.

    Attributes:
        grid: The raster's grid.
        part: The grid's cells that the sheet's lattice has.
        plane: The plane of its cells.
    """

    grid: Grid
    part: Tile
    plane: RasterPlane

    def heights(
        self, tile: Tile, over: Float64[np.ndarray, "h w"] | Float32[np.ndarray, "h w"]
    ) -> Float64[np.ndarray, "h w"]:
        """Convert heights over the sheet to heights in the CRS's unit.

        Args:
            tile: Tile of the sheet's lattice.
            over: Heights of its cells over the sheet, metres; NaN where there are none.
        """
        places = np.concatenate([self.plane.lattice.centres(tile), over.astype(np.float64)[..., None]], axis=-1)
        cells = self.grid.cells_from_local(self.plane.local_from_plane(places.reshape(-1, 3)))
        return np.asarray(cells[:, 2].reshape(over.shape))

    def lattice_of(self, other: Grid, part: Tile) -> Lattice:
        """The lattice of another grid's cells on this sheet; the grid has the same CRS."""
        scale = self.plane.lattice.cell_m / self.grid.cell  # metres of the sheet in a unit of the CRS
        west, north = (other.left + part.column) * other.cell, (other.top - part.row) * other.cell
        left, top = (
            (self.grid.left + self.part.column) * self.grid.cell,
            (self.grid.top - self.part.row) * self.grid.cell,
        )
        lattice = self.plane.lattice
        east_m, north_m = lattice.east_m + (west - left) * scale, lattice.north_m + (north - top) * scale
        return Lattice(east_m, north_m, other.cell * scale, part.width, part.height)

    def heights_over(self, other: Grid, part: Tile, heights: Float64[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
        """Convert heights of another grid's cells in the CRS's unit to metres over this sheet."""
        local = other.centres_in_local(part, heights)
        return np.asarray(self.plane.plane_from_local(local)[..., 2])


def divide_into_sheets(grid: Grid, low: float, high: float, side: int = SIDE) -> Iterator[GridSheet]:
    """Divide a grid into sheets, row by row.

    Args:
        grid: The raster's grid.
        low: Lowest height of the scene, in the CRS's unit.
        high: Highest height of the scene, in the CRS's unit.
        side: Cells per side of a sheet.
    """
    for part in tiled(grid.height, grid.width, side):
        yield GridSheet(grid, part, _level_plane(grid, part, low, high))


def _level_plane(grid: Grid, part: Tile, low: float, high: float) -> RasterPlane:
    middle, unit_m = (low + high) / 2.0, grid.crs.height_unit_m
    column, row = part.column + part.width / 2.0, part.row + part.height / 2.0
    steps = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    here, right, back, above = grid.local_from_cells(np.array([column, row, middle]) + steps)
    up = (above - here) / np.linalg.norm(above - here)
    east = right - here
    cell_m = float(np.linalg.norm(east) + np.linalg.norm(back - here)) / 2.0
    east = east - up * (up @ east)
    east /= np.linalg.norm(east)
    from_local = np.eye(4)
    from_local[:3, :3] = [east, np.cross(up, east), up]
    from_local[:3, 3] = -from_local[:3, :3] @ here
    lattice = Lattice(-part.width / 2.0 * cell_m, part.height / 2.0 * cell_m, cell_m, part.width, part.height)
    return RasterPlane(from_local, lattice, HeightRange((low - middle) * unit_m, (high - middle) * unit_m))
