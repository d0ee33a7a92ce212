"""Orthophoto and surface model as tiles of the web's map, for phones: in every zoom, in little memory.

Tiles of the most detailed zoom are taken from the raster; each coarser one is the mean of its four quarters, which are
made just before, so that no more than four tiles a zoom are in memory. Places are converted by the run's own
transformation, not by GDAL's choice of one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from jaxtyping import Float32, Float64, UInt8
from rasterio.windows import Window

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.surface.levels.mbtiles import TileFile, map_facts, tile_file
from splatpipe.pipeline.surface.levels.web_mercator import (
    MAX_ZOOM,
    SIDE,
    MapPlace,
    MapTile,
    geodetic_from_crs,
    pixel_m,
)
from splatpipe.pipeline.surface.rasters.geotiff import GDAL_ERRORS, gdal, open_raster
from splatpipe.pipeline.surface.rasters.map_crs import open_map
from splatpipe.pipeline.surface.rasters.pictures import relief_picture, shaded_relief
from splatpipe.pipeline.survey.crs.frames import Frame

FINER = 0.25  # of a zoom: a map's pixels are at most this much larger than the raster's, a factor of 1.19
SMALLEST_PX = 64.0  # the least detailed zoom shows the site this large
MARGIN = 2  # pixels around a tile, by which its edges are shaded like its middle
RELIEF_SIDE = 1024  # pixels of the overview from which the colours' range is taken
EDGE_STEPS = 9  # samples along each side of a raster
Paint = Callable[[MapTile], UInt8[np.ndarray, "h w 4"]]


@dataclass(frozen=True, eq=False)
class _Task:
    """A map to write.

    Attributes:
        place: Where its raster lies.
        paint: Paints a tile of the most detailed zoom.
        zooms: The least and the most detailed zoom.
        progress: Called with the tiles of the most detailed zoom painted so far, and all.
    """

    place: MapPlace
    paint: Paint
    zooms: tuple[int, int]
    progress: Callable[[int, int], None]


def write_ortho_tiles(source: Path, path: Path, frame: Frame, progress: Callable[[int, int], None]) -> dict[str, int]:
    """Write an orthophoto as MBTiles.

    Args:
        source: `ortho.tif`.
        path: Output file.
        frame: The run's georeferenced frame.
        progress: Called with the tiles painted so far, and all.

    Returns:
        Number of tiles, and zooms.

    Raises:
        SplatpipeError: if the run is not georeferenced, or the raster cannot be read.
        MachineError: if the disk is full.
    """
    with _opened(source) as raster:
        place = _place_of(raster, frame)

        def paint(tile: MapTile) -> UInt8[np.ndarray, "h w 4"]:
            return _unmultiplied(_sampled(raster, place.cells(tile, 0), _colours_of))

        return _write(_task(raster, place, paint, progress), path, "Orthophoto", "True orthophoto")


def write_relief_tiles(source: Path, path: Path, frame: Frame, progress: Callable[[int, int], None]) -> dict[str, int]:
    """Write a surface model as MBTiles: its heights as colours, lit from the north-west.

    Args, Returns, Raises: as ``write_ortho_tiles``.
    """
    relief = relief_picture(source, RELIEF_SIDE)
    low, high = (0.0, 1.0) if relief is None else (relief.low, relief.high)
    with _opened(source) as raster:
        place = _place_of(raster, frame)
        cell = abs(raster.transform.a)

        def paint(tile: MapTile) -> UInt8[np.ndarray, "h w 4"]:
            cells = place.cells(tile, MARGIN)
            found = _sampled(raster, cells, _heights_of)
            height = np.where(found[..., 1] > 0.5, found[..., 0] / np.maximum(found[..., 1], 1e-6), np.nan)
            step = cell * float(np.hypot(*(cells[0, -1] - cells[0, 0]))) / (cells.shape[1] - 1)
            colours = shaded_relief(height.astype(np.float64), step, low, high)
            alpha = np.where(np.isfinite(height), 255, 0).astype(np.uint8)
            inner = slice(MARGIN, -MARGIN)
            return np.ascontiguousarray(np.dstack([colours, alpha])[inner, inner])

        about = f"Heights from {low:.1f} (dark) to {high:.1f} (light), {place.crs.described_heights()}"
        return _write(_task(raster, place, paint, progress), path, "Surface model", about)


@contextmanager
def _opened(source: Path) -> Iterator[rasterio.DatasetReader]:
    try:
        with gdal(source.parent), open_raster(source) as raster:
            yield raster
    except GDAL_ERRORS as error:
        raise SplatpipeError(f"{source} cannot be read: {error}", "Make it again with --rerun.") from error


def _place_of(raster: rasterio.DatasetReader, frame: Frame) -> MapPlace:
    """Where a raster of the run lies.

    Raises:
        SplatpipeError: if the run is not georeferenced.
    """
    if frame.origin is None:
        raise SplatpipeError("Maps need a georeferenced run.", "Give it control points or photos with positions.")
    crs, at = open_map(frame), raster.transform  # north up, as all rasters of a run
    edge = np.linspace(0.0, 1.0, EDGE_STEPS)
    border = np.stack(np.meshgrid(edge * raster.width, edge * raster.height), axis=-1).reshape(-1, 2)
    corner, cell = np.array([at.c, at.f]), np.array([at.a, at.e])
    height = np.full((len(border), 1), frame.origin.height_m / crs.height_unit_m)
    geodetic = geodetic_from_crs(crs, np.concatenate([corner + border * cell, height], axis=1))
    (south, west, _), (north, east, _) = geodetic.min(axis=0), geodetic.max(axis=0)

    def cells_from_crs(coordinates: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        return np.asarray((coordinates - corner) / cell)

    box = (float(west), float(south), float(east), float(north))
    return MapPlace(crs, cells_from_crs, box, (box[1] + box[3]) / 2.0)


def _task(raster: rasterio.DatasetReader, place: MapPlace, paint: Paint, progress: Callable[[int, int], None]) -> _Task:
    pixel = abs(raster.transform.a) * place.crs.unit_m
    scale = place.crs.world.grid_scale() if place.crs.world is not None else None
    on_ground = pixel / (1.0 if scale is None else scale.ground)
    finest = math.ceil(math.log2(pixel_m(0, place.latitude) / on_ground) - FINER)
    finest = min(MAX_ZOOM, max(0, finest))
    extent = max(raster.width, raster.height) * on_ground / pixel_m(finest, place.latitude)
    coarsest = max(0, finest - max(0, math.floor(math.log2(extent / SMALLEST_PX))))
    return _Task(place, paint, (coarsest, finest), progress)


def _write(task: _Task, path: Path, name: str, description: str) -> dict[str, int]:
    low, high = task.zooms
    total, done = sum(1 for _ in task.place.tiles(high)), 0

    def draw(tile: MapTile, file: TileFile) -> UInt8[np.ndarray, "h w 4"]:
        """Write a tile and all below it; returns its picture."""
        nonlocal done
        if tile.zoom == high:
            picture = task.paint(tile)
            done += 1
            task.progress(done, total)
        else:
            quarters = [
                draw(child, file) if task.place.touches(child) else np.zeros((SIDE, SIDE, 4), np.uint8)
                for child in tile.children()
            ]
            picture = halved(np.vstack([np.hstack(quarters[:2]), np.hstack(quarters[2:])]))
        file.write(tile, picture)
        return picture

    with tile_file(path, map_facts(name, description, task.place.whole_pixels(high), task.zooms)) as file:
        for tile in task.place.tiles(low):
            draw(tile, file)
        return {"tiles": file.count, "min_zoom": low, "max_zoom": high}


def halved(picture: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h2 w2 4"]:
    """A picture at half the size; pixels count by their alpha.

    Args:
        picture: Red, green, blue, alpha; even sides.
    """
    high, wide = picture.shape[:2]
    whole = picture.astype(np.float32)
    whole[..., :3] *= whole[..., 3:] / 255.0
    return _unmultiplied(whole.reshape(high // 2, 2, wide // 2, 2, 4).mean(axis=(1, 3)))


def _unmultiplied(whole: Float32[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 4"]:
    """Bytes of colours that were multiplied by their alpha, 0 to 255."""
    alpha = whole[..., 3:]
    colours = np.where(alpha > 0.0, whole[..., :3] * (255.0 / np.maximum(alpha, 1e-3)), 0.0)
    return np.asarray(np.rint(np.clip(np.concatenate([colours, alpha], axis=2), 0.0, 255.0)).astype(np.uint8))


Values = Callable[[np.ma.MaskedArray], Float32[np.ndarray, "h w c"]]


def _colours_of(bands: np.ma.MaskedArray) -> Float32[np.ndarray, "h w 4"]:
    """Colours multiplied by alpha, and alpha."""
    whole = bands.data.transpose(1, 2, 0).astype(np.float32)
    whole[..., :3] *= whole[..., 3:] / 255.0
    return whole


def _heights_of(bands: np.ma.MaskedArray) -> Float32[np.ndarray, "h w 2"]:
    """Heights multiplied by whether they are known, and that."""
    known = ~np.ma.getmaskarray(bands)[0]
    return np.dstack([np.where(known, bands.data[0], 0.0).astype(np.float32), known.astype(np.float32)])


def _sampled(
    raster: rasterio.DatasetReader, cells: Float64[np.ndarray, "h w 2"], values: Values
) -> Float32[np.ndarray, "h w c"]:
    """Values of a raster at places, interpolated linearly; 0 outside of it.

    Args:
        raster: An open raster.
        cells: Columns and rows; the first cell's centre is (0.5, 0.5).
        values: From a window's bands to what is interpolated.
    """
    low = np.floor(cells.min(axis=(0, 1))).astype(int) - 1
    high = np.ceil(cells.max(axis=(0, 1))).astype(int) + 1
    low, high = np.maximum(low, 0), np.minimum(high, [raster.width, raster.height])
    if (low >= high).any():
        return np.zeros((*cells.shape[:2], raster.count if raster.count > 1 else 2), np.float32)
    window = Window(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
    found = values(raster.read(window=window, masked=True))
    at = (cells - low - 0.5).astype(np.float32)
    edge = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": 0}
    return np.asarray(cv2.remap(found, at[..., 0], at[..., 1], cv2.INTER_LINEAR, **edge))
