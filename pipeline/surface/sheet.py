"""Sheets: planes of cells that things are drawn on, seen from above, whichever way the plane lies.

The ground's is level, a façade's upright. Cameras are moved into the sheet's frame, and what is nearest to the viewer
is the highest there. A large raster is drawn on many small sheets, so that each is as good as plane: of one that is
100 m wide, the earth falls away by 0.2 mm at its border, and plumb lines lean by 1 in 100,000.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.grid import Grid
from splatpipe.pipeline.surface.lattice import Lattice
from splatpipe.pipeline.surface.photo_samples import PhotoSource
from splatpipe.pipeline.surface.sources import DepthSource, HeightRange, MetricMap, PosedDepthMap
from splatpipe.pipeline.surface.tiles import Tile, tiled

SIDE = 2048  # cells of a sheet of the ground: four blocks of the files


@dataclass(frozen=True, eq=False)
class Sheet:
    """A plane, and what of the space about it counts.

    Attributes:
        from_local: Rigid, from local metres to the sheet's: along the rows, against the columns, towards the viewer.
        lattice: Its cells.
        relief: Between which heights over the plane things are looked for.
    """

    from_local: Float64[np.ndarray, "4 4"]
    lattice: Lattice
    relief: HeightRange

    def place(self, local: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """East, north, up (metres) in the sheet's frame."""
        return np.asarray(local @ self.from_local[:3, :3].T + self.from_local[:3, 3])

    def local(self, places: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        """What ``place`` undoes."""
        return np.asarray((places - self.from_local[:3, 3]) @ self.from_local[:3, :3])

    def moved(self, camera: Camera) -> Camera:
        """A camera of the local frame in the sheet's."""
        back = np.eye(4)
        back[:3, :3] = self.from_local[:3, :3].T
        back[:3, 3] = -back[:3, :3] @ self.from_local[:3, 3]
        return replace(camera, cam_from_world=camera.cam_from_world @ back)

    def moved_depths(self, source: DepthSource) -> DepthSource:
        """Depths of a photo of the local frame in the sheet's."""
        camera = self.moved(source.camera)

        def load() -> PosedDepthMap:
            found = source.load()
            return MetricMap(camera, found.depth, found.confidence)

        return DepthSource(camera, load)

    def moved_photo(self, photo: PhotoSource) -> PhotoSource:
        """A photo of the local frame, with its depths, in the sheet's."""
        depths = None if photo.depths is None else self.moved_depths(photo.depths)
        return replace(photo, camera=self.moved(photo.camera), depths=depths)


@dataclass(frozen=True, eq=False)
class GridSheet:
    """A part of a raster's grid as a sheet, level at the middle of the part.

    Attributes:
        grid: The raster's.
        part: Which of its cells; the sheet's lattice has the same.
        sheet: The sheet.
    """

    grid: Grid
    part: Tile
    sheet: Sheet

    def heights(
        self, tile: Tile, over: Float64[np.ndarray, "h w"] | Float32[np.ndarray, "h w"]
    ) -> Float64[np.ndarray, "h w"]:
        """Heights over the sheet (metres, nan where there are none) in the CRS's unit.

        Args:
            tile: Of the sheet's lattice.
            over: Of its cells.
        """
        places = np.concatenate([self.sheet.lattice.centres(tile), over.astype(np.float64)[..., None]], axis=-1)
        cells = self.grid.cells_from_local(self.sheet.local(places.reshape(-1, 3)))
        return np.asarray(cells[:, 2].reshape(over.shape))

    def lattice_of(self, other: Grid, part: Tile) -> Lattice:
        """Cells of another grid of the same CRS on this sheet."""
        scale = self.sheet.lattice.cell_m / self.grid.cell  # metres of the sheet in a unit of the CRS
        west, north = (other.left + part.column) * other.cell, (other.top - part.row) * other.cell
        left, top = (
            (self.grid.left + self.part.column) * self.grid.cell,
            (self.grid.top - self.part.row) * self.grid.cell,
        )
        lattice = self.sheet.lattice
        east_m, north_m = lattice.east_m + (west - left) * scale, lattice.north_m + (north - top) * scale
        return Lattice(east_m, north_m, other.cell * scale, part.width, part.height)

    def over(self, other: Grid, part: Tile, heights: Float64[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
        """Heights in the CRS's unit of another grid's cells, over this sheet in metres."""
        local = other.centres_in_local(part, heights)
        return np.asarray(self.sheet.place(local)[..., 2])


def grid_sheets(grid: Grid, low: float, high: float, side: int = SIDE) -> Iterator[GridSheet]:
    """All of a grid in sheets, row by row.

    Args:
        grid: The raster's.
        low: No height of the scene is lower, the CRS's unit.
        high: Nor higher.
        side: Cells of a sheet.
    """
    for part in tiled(grid.height, grid.width, side):
        yield GridSheet(grid, part, _sheet(grid, part, low, high))


def _sheet(grid: Grid, part: Tile, low: float, high: float) -> Sheet:
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
    return Sheet(from_local, lattice, HeightRange((low - middle) * unit_m, (high - middle) * unit_m))
