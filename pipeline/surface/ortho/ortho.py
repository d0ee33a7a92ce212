"""The true orthophoto as a file: `ortho.tif`, computed sheet by sheet on the surface model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from rasterio.windows import Window

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.surface.depths.exposures import COMPARED_POINTS, exposure_levels
from splatpipe.pipeline.surface.depths.photo_gains import PhotoGains
from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource
from splatpipe.pipeline.surface.depths.pixel_file import pixels_on_disk
from splatpipe.pipeline.surface.depths.run_sources import RunSurface
from splatpipe.pipeline.surface.depths.site_extent import SiteExtent
from splatpipe.pipeline.surface.depths.sources import LruCache
from splatpipe.pipeline.surface.heights.dsm import CACHE_BYTES, height_range
from splatpipe.pipeline.surface.heights.height_field import HeightField
from splatpipe.pipeline.surface.ortho.mosaic import MARGIN
from splatpipe.pipeline.surface.ortho.orthophoto import EXTENDED_CELLS, TILE, OrthoInput, orthophotos
from splatpipe.pipeline.surface.rasters.geotiff import COLOURS, gdal, open_raster, raster_file
from splatpipe.pipeline.surface.rasters.grid import Grid, make_grid
from splatpipe.pipeline.surface.rasters.tiles import Tile
from splatpipe.pipeline.surface.sheets.raster_plane import GridSheet, divide_into_sheets
from splatpipe.pipeline.surface.sheets.sheet_work import Arrays, SheetWork

PIXEL_BYTES = 1 << 30  # limit for decoded photos in memory; beyond it, all are kept on disk
BLOCK = 64  # cells a side that are known together: a plan of 16 million cells is 4,000 blocks
HEIGHT_MARGIN_CELLS = 3  # margin in cells of the surface model around the pixels, for interpolation


@dataclass(frozen=True, eq=False)
class OrthoTask:
    """Inputs of an orthophoto.

    Attributes:
        surface: The run's photos and depths.
        site: The area that they cover.
        dsm: Path of `dsm.tif`.
        dsm_cell_m: Cell size of the DSM on the ground, metres.
        gsd_m: Ground sampling distance (GSD), metres per pixel.
        threads: Tiles in parallel.
    """

    surface: RunSurface
    site: SiteExtent
    dsm: Path
    dsm_cell_m: float
    gsd_m: float
    threads: int


def make_ortho(task: OrthoTask, work: Path, out: Path, report: Reporter) -> dict[str, Any]:
    """Write the orthophoto; a killed run resumes after its last finished sheet.

    Args:
        task: Inputs.
        work: Folder for intermediate files.
        out: Output folder.
        report: Receives progress.

    Returns:
        Statistics: number and size of pixels, range of the exposure corrections in stops, and so on.

    Raises:
        SplatpipeError: if the grid would be absurdly large, or a photo has changed.
        MachineError: if the disk is full.
    """
    grid = make_grid(task.surface.frame, task.site.box, task.gsd_m)
    heights = make_grid(task.surface.frame, task.site.box, task.dsm_cell_m)
    grid_sheets = list(divide_into_sheets(grid, *height_range(task.site, grid)))
    known = partial(_has_heights, known_cells(task.dsm), heights)
    making = SheetWork(grid_sheets, known, task.surface.area, TILE, work, report, "orthophoto")
    work.mkdir(exist_ok=True)
    with pixels_on_disk(task.surface.photos, work, PIXEL_BYTES) as photos:
        levels = exposure_levels(photos, _places(task.dsm, heights), 2.0 * grid.cell_m, task.threads)
        making.run(partial(_colours, task, heights, _Pictures(photos, levels, LruCache(PIXEL_BYTES))))
    pixels = 0
    with raster_file(out / "ortho.tif", grid, COLOURS) as file:
        for part, arrays in making.finished():
            file.write(part, np.moveaxis(arrays["colour"], -1, 0))
            pixels += int(np.count_nonzero(arrays["colour"][..., 3]))
    return {
        "pixel": grid.cell,
        "pixel_m": round(grid.cell_m, 6),
        "width": grid.width,
        "height": grid.height,
        "pixels": pixels,
        "exposures_stops": round(float(np.ptp(np.log2(levels.gain[:, 1]))), 3) if len(photos) else 0.0,
        "crs": grid.crs.horizontal.name,
    }


@dataclass(frozen=True, eq=False)
class KnownCells:
    """Where a surface model has heights, in coarse blocks of its cells.

    Attributes:
        blocks: Whether any cell of each block has a height.
    """

    blocks: Bool[np.ndarray, "rows columns"]

    def any_in(self, part: Tile) -> bool:
        """Whether any block that overlaps a part has heights; there are none outside of the raster."""
        rows = slice(max(part.row, 0) // BLOCK, max(part.row + part.height - 1, -1) // BLOCK + 1)
        columns = slice(max(part.column, 0) // BLOCK, max(part.column + part.width - 1, -1) // BLOCK + 1)
        return bool(self.blocks[rows, columns].any())


def known_cells(dsm: Path) -> KnownCells:
    """Read where a surface model has heights.

    Args:
        dsm: A tiled GeoTIFF of heights; it is read once, one row of blocks at a time.
    """
    with gdal(dsm.parent), open_raster(dsm) as raster:
        rows = []
        for top in range(0, raster.height, BLOCK):
            window = Window(0, top, raster.width, min(BLOCK, raster.height - top))
            known = raster.read_masks(1, window=window).any(axis=0)
            rows.append(np.logical_or.reduceat(known, np.arange(0, raster.width, BLOCK)))
    return KnownCells(np.stack(rows))


@dataclass(frozen=True, eq=False)
class _Pictures:
    """Photos with access to their pixels, as needed for ``OrthoInput``."""

    sources: Sequence[PhotoSource]
    levels: PhotoGains
    pixels: LruCache[UInt8[np.ndarray, "_ _ 3"]]


def _colours(
    task: OrthoTask, heights: Grid, pictures: _Pictures, grid_sheet: GridSheet, tiles: Sequence[Tile]
) -> Iterator[tuple[Tile, Arrays]]:
    """The colours of a sheet's tiles."""
    plane = grid_sheet.plane
    photos = [plane.transform_photo(photo) for photo in pictures.sources]
    surface = _surface(grid_sheet, task.dsm, heights)
    album = OrthoInput(
        photos, surface, plane.lattice, plane.relief, pictures.levels, pictures.pixels, LruCache(CACHE_BYTES)
    )
    for part in orthophotos(album, tiles, task.threads):
        alpha = np.where(part.known, 255, 0).astype(np.uint8)
        yield part.tile, {"colour": np.concatenate([part.colour, alpha[..., None]], axis=-1)}


def _has_heights(known: KnownCells, heights: Grid, grid_sheet: GridSheet, tile: Tile) -> bool:
    """Whether any pixels of a sheet's tile may have a height."""
    part = Tile(grid_sheet.part.row + tile.row, grid_sheet.part.column + tile.column, tile.height, tile.width)
    return known.any_in(_cells_under(grid_sheet.grid, part, heights, HEIGHT_MARGIN_CELLS * heights.cell))


def _cells_under(grid: Grid, part: Tile, heights: Grid, margin: float) -> Tile:
    """The surface model's cells under or next to pixels; some may be outside of the model.

    Args:
        grid: Grid of the pixels.
        part: The pixels.
        heights: Grid of the surface model, in the same CRS.
        margin: Margin around the pixels, in the CRS's unit.
    """
    west, north = (grid.left + part.column) * grid.cell - margin, (grid.top - part.row) * grid.cell + margin
    east, south = west + part.width * grid.cell + 2.0 * margin, north - part.height * grid.cell - 2.0 * margin
    left, right = (int(np.floor(at / heights.cell)) - heights.left for at in (west, east))
    top, bottom = (heights.top - int(np.ceil(at / heights.cell)) for at in (north, south))
    return Tile(top, left, bottom + 1 - top, right + 1 - left)


def _surface(grid_sheet: GridSheet, dsm: Path, heights: Grid) -> HeightField:
    """The heights under a sheet's pixels, relative to the sheet."""
    margin = (MARGIN + EXTENDED_CELLS) * grid_sheet.grid.cell + HEIGHT_MARGIN_CELLS * heights.cell
    part = _cells_under(grid_sheet.grid, grid_sheet.part, heights, margin)
    rows = np.clip([part.row, part.row + part.height], 0, heights.height)
    columns = np.clip([part.column, part.column + part.width], 0, heights.width)
    part = Tile(int(rows[0]), int(columns[0]), int(max(rows[1] - rows[0], 1)), int(max(columns[1] - columns[0], 1)))
    found = _read(dsm, part)
    return HeightField(
        grid_sheet.lattice_of(heights, part), grid_sheet.heights_over(heights, part, found).astype(np.float32)
    )


def _read(dsm: Path, part: Tile) -> Float64[np.ndarray, "h w"]:
    """Heights of the DSM's cells, NaN where there are none."""
    with gdal(dsm.parent), open_raster(dsm) as raster:
        window = Window(part.column, part.row, part.width, part.height)
        found = raster.read(1, window=window, masked=True, boundless=False)
    return np.asarray(found.astype(np.float64).filled(np.nan))


def _places(dsm: Path, heights: Grid) -> Float64[np.ndarray, "m 3"]:
    """Evenly spaced cells of the surface, local metres."""
    rows, columns = (
        max(1, round((COMPARED_POINTS * a / b) ** 0.5))
        for a, b in ((heights.height, heights.width), (heights.width, heights.height))
    )
    row = (np.arange(min(rows, heights.height)) + 0.5) * heights.height / min(rows, heights.height)
    column = (np.arange(min(columns, heights.width)) + 0.5) * heights.width / min(columns, heights.width)
    found = []
    with gdal(dsm.parent), open_raster(dsm) as raster:
        for at in row.astype(np.int64):
            line = raster.read(1, window=Window(0, int(at), heights.width, 1), masked=True)[0]
            height = line.astype(np.float64).filled(np.nan)[column.astype(np.int64)]
            cells = np.stack([column.astype(np.int64) + 0.5, np.full(len(column), at + 0.5), height], axis=1)
            found.append(cells[np.isfinite(height)])
    return heights.local_from_cells(np.concatenate(found))
