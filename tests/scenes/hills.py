"""A smooth surface around a place, and the files made from it."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.surface.rasters.geotiff import HEIGHTS, raster_file
from splatpipe.pipeline.surface.rasters.grid import Grid, make_grid
from splatpipe.pipeline.survey.crs.frames import Frame, Origin

Array = NDArray[np.float64]
GERMANY = Origin(52.2, 9.97, 110.0)
IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


def placed(crs: str = "EPSG:25832+7837", vertical: str = "EPSG:7837", origin: Origin = GERMANY) -> Frame:
    """Return a georeferenced frame."""
    return Frame("enu", IDENTITY, origin, vertical, crs=crs)


def box(half_east: float, half_north: float, low: float = -10.0, high: float = 30.0) -> Array:
    """Return a scene's box about the origin, metres."""
    return np.array([[-half_east, -half_north, low], [half_east, half_north, high]])


def hill_grid(frame: Frame | None = None, gsd_m: float = 0.1) -> Grid:
    """Return about 400 by 300 cells: they span several GDAL blocks only if a test requests smaller cells."""
    return make_grid(frame or placed(), box(20.0, 15.0), gsd_m)


def hill(x: Array, y: Array) -> Array:
    """Return the height above 100 at metres from the centre: a hill, and waves around it."""
    return np.asarray(104.0 + 6.0 * np.exp(-(x**2 + y**2) / 80.0) + np.sin(x / 4.0) * np.cos(y / 5.0))


def from_middle(grid: Grid, columns: Array, rows: Array) -> tuple[Array, Array]:
    """Return metres from the centre of the grid."""
    return (columns - grid.width / 2.0) * grid.cell, (grid.height / 2.0 - rows) * grid.cell


def write_hill(path: Path, grid: Grid, hole: bool = True) -> None:
    """Write the heights as `dsm.tif`; with ``hole``, a square of 4 m beside the top has no data."""
    with raster_file(path, grid, HEIGHTS) as file:
        for tile in grid.tiles():
            columns, rows = np.meshgrid(np.arange(tile.width) + 0.5, np.arange(tile.height) + 0.5)
            x, y = from_middle(grid, columns + tile.column, rows + tile.row)
            heights = hill(x, y)
            heights[hole & (np.abs(x - 8.0) < 2.0) & (np.abs(y) < 2.0)] = np.nan
            file.write(tile, heights.astype(np.float32))
