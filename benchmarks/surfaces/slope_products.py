"""The terrain model and the point classes of a made site, by the pipeline's own functions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from slope_scene import SlopeScene

from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.surface.ground.dtm import DtmTask, make_dtm
from splatpipe.pipeline.surface.ground.point_classes import PointClassifier
from splatpipe.pipeline.surface.heights.surface_file import open_surface
from splatpipe.pipeline.surface.rasters.geotiff import CONFIDENCE, HEIGHTS, raster_file
from splatpipe.pipeline.surface.rasters.grid import Grid, make_grid
from splatpipe.pipeline.surface.rasters.tiles import Tile
from splatpipe.pipeline.survey.crs.frames import Frame

PHOTOS = 8  # that confirm each height


@dataclass(frozen=True, eq=False)
class SlopeProducts:
    """What is made of a site.

    Attributes:
        grid: The rasters' grid.
        terrain: Heights of the ground, NaN where there are none.
        cover: Classes of the surface model's cells.
        classes: Classes of the site's points.
    """

    grid: Grid
    terrain: Float64[np.ndarray, "h w"]
    cover: UInt8[np.ndarray, "h w"]
    classes: UInt8[np.ndarray, " n"]


class Silent:
    """A Reporter that says nothing."""

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None: ...
    def metric(self, name: str, value: float, step: int | None = None) -> None: ...
    def note(self, message: str) -> None: ...
    def warning(self, message: str, hint: str = "") -> None: ...


def slope_grid(scene: SlopeScene) -> Grid:
    """Return the grid of a site's rasters, in local metres."""
    rows, columns = scene.surface.shape
    inset = scene.cell_m / 2.0
    west, north = scene.west, scene.north
    east, south = west + columns * scene.cell_m, north - rows * scene.cell_m
    box = np.array([[west + inset, south + inset, -50.0], [east - inset, north - inset, 50.0]])
    return make_grid(Frame("arbitrary", Similarity.identity(), metres=True), box, scene.cell_m)


def write_slope(scene: SlopeScene, folder: Path) -> Grid:
    """Write `dsm.tif` and `dsm_confidence.tif` of a site."""
    grid = slope_grid(scene)
    tile = Tile(0, 0, *scene.surface.shape)
    with raster_file(folder / "dsm.tif", grid, HEIGHTS) as file:
        file.write(tile, scene.surface.astype(np.float32))
    known = np.isfinite(scene.surface)
    bands = np.stack([known * PHOTOS, known * round(500.0 * scene.gsd_m)]).astype(np.uint16)
    with raster_file(folder / "dsm_confidence.tif", grid, CONFIDENCE) as file:
        file.write(tile, bands)
    return grid


def classified_slope(scene: SlopeScene, folder: Path, threads: int = 1) -> SlopeProducts:
    """Make the terrain model of a site and classify its cloud.

    Args:
        scene: The site.
        folder: Folder for files.
        threads: Parts in parallel.
    """
    grid = write_slope(scene, folder)
    dsm, cover = open_surface(folder / "dsm.tif", folder / "dsm_confidence.tif"), folder / "cover.tif"
    make_dtm(DtmTask(dsm, grid, scene.gsd_m, threads), folder / "parts", folder, cover, Silent())
    terrain, covered = open_surface(folder / "dtm.tif"), open_surface(cover)
    classifier = PointClassifier(dsm, terrain, covered, grid, scene.gsd_m)
    normals = np.zeros(scene.points.shape, np.float32)
    classes = classifier.classify(scene.points, normals, (scene.west, scene.north), scene.cell_m)
    tile = Tile(0, 0, grid.height, grid.width)
    cells = np.nan_to_num(covered.heights(tile)).astype(np.uint8)
    return SlopeProducts(grid, terrain.heights(tile), cells, classes)
