"""The digital surface model (DSM) as files: `dsm.tif` and `dsm_confidence.tif`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.surface.depths.run_sources import RunSurface
from splatpipe.pipeline.surface.depths.site_extent import SiteExtent
from splatpipe.pipeline.surface.depths.sources import LruCache
from splatpipe.pipeline.surface.heights.heights import TILE, HeightInput, surface_heights
from splatpipe.pipeline.surface.rasters.geotiff import CONFIDENCE, HEIGHTS, raster_file
from splatpipe.pipeline.surface.rasters.grid import Grid, make_grid
from splatpipe.pipeline.surface.rasters.tiles import Tile
from splatpipe.pipeline.surface.sheets.raster_plane import GridSheet, divide_into_sheets
from splatpipe.pipeline.surface.sheets.sheet_work import Arrays, SheetWork

CACHE_BYTES = 512 << 20  # limit for depths in memory
MILLIMETRES = 1000.0
MAX_MILLIMETRES = np.iinfo(np.uint16).max


@dataclass(frozen=True, eq=False)
class DsmTask:
    """Inputs of a surface model.

    Attributes:
        surface: The run's photos and depths.
        site: The area that they cover.
        cell_m: Cell size on the ground, metres.
        threads: Tiles in parallel.
    """

    surface: RunSurface
    site: SiteExtent
    cell_m: float
    threads: int


def height_range(site: SiteExtent, grid: Grid) -> tuple[float, float]:
    """Lowest and highest height of a site, in the CRS's unit."""
    mapped = grid.crs_from_local(
        np.array([[e, n, up] for e in site.box[:, 0] for n in site.box[:, 1] for up in site.box[:, 2]])
    )
    return float(mapped[:, 2].min()), float(mapped[:, 2].max())


def make_dsm(task: DsmTask, work: Path, out: Path, report: Reporter) -> dict[str, Any]:
    """Write the surface model; a killed run resumes after its last finished sheet.

    Args:
        task: Inputs.
        work: Folder for intermediate files.
        out: Output folder.
        report: Receives progress.

    Returns:
        Statistics: number and size of cells, share of the covered area with heights, expected accuracy, and so on.

    Raises:
        SplatpipeError: if the grid would be absurdly large.
        MachineError: if the disk is full.
    """
    grid = make_grid(task.surface.frame, task.site.box, task.cell_m)
    grid_sheets = list(divide_into_sheets(grid, *height_range(task.site, grid)))
    making = SheetWork(
        grid_sheets, partial(_is_seen, task.site), task.surface.area, TILE, work, report, "surface model"
    )

    def heights(grid_sheet: GridSheet, tiles: Sequence[Tile]) -> Iterator[tuple[Tile, Arrays]]:
        sources = [grid_sheet.plane.transform_depths(source) for source in task.surface.depths]
        capture = HeightInput(sources, grid_sheet.plane.lattice, grid_sheet.plane.relief, LruCache(CACHE_BYTES))
        for part in surface_heights(capture, tiles, task.threads):
            sigma = np.nan_to_num(np.ceil(part.sigma.astype(np.float64) * MILLIMETRES))
            confidence = np.stack([part.photos, np.minimum(sigma, MAX_MILLIMETRES)], axis=-1).astype(np.uint16)
            over = grid_sheet.heights(part.tile, part.height).astype(np.float32)
            yield part.tile, {"height": over, "confidence": confidence}

    making.run(heights)
    sigmas = _write_rasters(making, out, grid)
    known = int(sigmas.sum())
    typical = int(np.searchsorted(np.cumsum(sigmas), known / 2)) / MILLIMETRES if known else None
    return {
        "cell": grid.cell,
        "cell_m": round(grid.cell_m, 6),
        "width": grid.width,
        "height": grid.height,
        "cells": known,
        "area_m2": round(known * grid.cell_m**2, 1),
        "covered": round(known * grid.cell_m**2 / max(task.site.area_m2(), 1e-9), 4),
        "expected_deviation_m": typical,
        "crs": grid.crs.horizontal.name,
        "heights": grid.crs.described_heights(),
    }


def _is_seen(site: SiteExtent, grid_sheet: GridSheet, tile: Tile) -> bool:
    """Whether enough photos see any part of a tile."""
    corners = grid_sheet.plane.lattice.centres(tile)[[0, 0, -1, -1], [0, -1, 0, -1]]
    local = grid_sheet.plane.local_from_plane(np.concatenate([corners, np.zeros((4, 1))], axis=1))[:, :2]
    return site.sees(np.stack([local.min(axis=0), local.max(axis=0)]))


def _write_rasters(making: SheetWork, out: Path, grid: Grid) -> Int64[np.ndarray, " 65536"]:
    """Write both rasters; returns a histogram of the cells' expected deviations in millimetres, with 0 left empty."""
    with raster_file(out / "dsm.tif", grid, HEIGHTS) as file:
        for part, arrays in making.finished():
            file.write(part, arrays["height"])
    sigmas = np.zeros(MAX_MILLIMETRES + 1, np.int64)
    with raster_file(out / "dsm_confidence.tif", grid, CONFIDENCE) as file:
        for part, arrays in making.finished():
            file.write(part, np.moveaxis(arrays["confidence"], -1, 0))
            sigmas += np.bincount(arrays["confidence"][..., 1].ravel(), minlength=len(sigmas))
    sigmas[0] = 0  # cells without a height
    return sigmas
