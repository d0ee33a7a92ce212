"""The terrain model as files: `dtm.tif`, `dtm_confidence.tif`, `chm.tif`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.surface.ground.part_files import Arrays
from splatpipe.pipeline.surface.ground.terrain import BUILDING, GROUND, NOTHING, TerrainSource, TerrainSteps
from splatpipe.pipeline.surface.heights.surface_file import SurfaceFile
from splatpipe.pipeline.surface.rasters.geotiff import (
    COVER,
    GROUND_CONFIDENCE,
    HEIGHTS,
    HEIGHTS_OVER_GROUND,
    RasterForm,
    raster_file,
)
from splatpipe.pipeline.surface.rasters.grid import Grid
from splatpipe.pipeline.surface.rasters.tiles import Tile

CLASSES = 256  # of the cover, at most
CELL_GSD = 2.0  # cell of a surface model over the GSD, unless depths are coarser


@dataclass(frozen=True, eq=False)
class DtmTask:
    """Inputs of a terrain model.

    Attributes:
        surface: The surface model's files.
        grid: Its grid.
        gsd_m: GSD of the photos, metres.
        threads: Parts in parallel.
    """

    surface: SurfaceFile
    grid: Grid
    gsd_m: float
    threads: int

    def source(self) -> TerrainSource:
        """The surface model in metres."""
        gsd_m = noise_gsd(self.gsd_m, self.grid)
        return TerrainSource(self.surface, self.grid.cell_m, self.grid.crs.height_unit_m, gsd_m)


def noise_gsd(gsd_m: float, grid: Grid) -> float:
    """The GSD that the noise of heights follows from: the photos', or, for coarser depths, half a cell."""
    return max(gsd_m, grid.cell_m / CELL_GSD)


def make_dtm(task: DtmTask, work: Path, out: Path, cover: Path, report: Reporter) -> dict[str, Any]:
    """Write the terrain model; a killed run resumes after its last finished part.

    Args:
        task: Inputs.
        work: Folder for intermediate files.
        out: Output folder.
        cover: Output file: what each cell of the surface model shows, for the cloud's classes.
        report: Receives progress.

    Returns:
        Statistics: number of cells, and the shares of those with a height that are ground and building.

    Raises:
        StageError: if the grid is not the surface model's.
        MachineError: if the disk is full.
    """
    lattice, grid = task.surface.lattice, task.grid
    if (lattice.height, lattice.width) != (grid.height, grid.width):
        raise StageError("The surface model has another grid than the site.", "Run again with --rerun dsm.")
    steps = TerrainSteps(task.source(), work, task.threads)
    steps.compute(lambda done, total: report.progress(done, total, "terrain model", "parts"))
    _write(steps, out / "dtm.tif", grid, "terrain", HEIGHTS)
    _write(steps, out / "chm.tif", grid, "over", HEIGHTS_OVER_GROUND)
    _write(steps, out / "dtm_confidence.tif", grid, "confidence", GROUND_CONFIDENCE)
    _write(steps, cover, grid, "cover", COVER)
    counts, filled = np.zeros(CLASSES, np.int64), 0
    for _, arrays in _cut(steps, grid, "cover", "terrain"):
        counts += np.bincount(arrays["cover"].ravel(), minlength=CLASSES)
        filled += int(np.isfinite(arrays["terrain"]).sum())
    seen = max(1, int(counts.sum() - counts[NOTHING]))
    return {
        "cells": filled,
        "ground_share": round(int(counts[GROUND]) / seen, 4),
        "building_share": round(int(counts[BUILDING]) / seen, 4),
    }


def _cut(steps: TerrainSteps, grid: Grid, *names: str) -> Iterator[tuple[Tile, Arrays]]:
    """Arrays of the finished parts, without what blocks reach beyond the grid."""
    for cells, arrays in steps.finished(*names):
        part = Tile(
            cells.row,
            cells.column,
            min(cells.height, grid.height - cells.row),
            min(cells.width, grid.width - cells.column),
        )
        yield part, {name: values[: part.height, : part.width] for name, values in arrays.items()}


def _write(steps: TerrainSteps, path: Path, grid: Grid, name: str, form: RasterForm) -> None:
    with raster_file(path, grid, form) as file:
        for part, arrays in _cut(steps, grid, name):
            values = arrays[name]
            file.write(part, np.moveaxis(values, -1, 0) if values.ndim == 3 else values)
