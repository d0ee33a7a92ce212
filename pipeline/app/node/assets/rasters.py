"""The maps of a run on their way to WebODM, which asks again and again for one that it cannot open."""

from __future__ import annotations

import io
import math
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from affine import Affine
from PIL import Image
from rasterio.enums import ColorInterp, Resampling
from rasterio.shutil import copy as copy_raster
from rasterio.warp import transform_bounds
from rasterio.windows import Window

from splatpipe.pipeline.surface.rasters.geotiff import GDAL_ERRORS, gdal, open_raster

MAX_PICTURE_PIXELS = 24_000_000  # of a PNG: 100 MB at most; WebODM draws its map from the GeoTIFF
PROBE_SIDE = 64  # pixels of the small view that is read from the overviews
STRIP_ROWS = 256
PNG_LEVEL = 3  # a third of the time of the usual 6, for a tenth more bytes
RGBA = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)


class UnusableRaster(Exception):
    """A raster that clients could not open; its text is the reason."""


class UnplacedRaster(UnusableRaster):
    """A raster that is whole, but has no place on the earth."""


def check_raster(path: Path, *, colours: bool) -> None:
    """Open a map and read of it what viewers read first: its place on the earth, corners, and overviews.

    Args:
        path: The file.
        colours: Whether it must be an orthophoto: 8 bits, RGBA.

    Raises:
        UnplacedRaster: if it has no place on the earth.
        UnusableRaster: if it cannot be read, has no alpha band, or not the layout of a COG.
    """
    try:
        with gdal(path.parent), open_raster(path) as raster:
            if colours and (raster.colorinterp != RGBA or set(raster.dtypes) != {"uint8"}):
                raise UnusableRaster("it is not RGBA of 8 bits")
            if raster.tags(ns="IMAGE_STRUCTURE").get("LAYOUT") != "COG":
                raise UnusableRaster("it is not a Cloud Optimised GeoTIFF")
            for row, column in ((0, 0), (raster.height // 2, raster.width // 2), (raster.height - 1, raster.width - 1)):
                raster.read(window=Window(column, row, 1, 1))
            raster.read(out_shape=(raster.count, *reduced_shape(raster, PROBE_SIDE**2)))
            if raster.crs is None or not _is_on_earth(raster):
                raise UnplacedRaster("it has no place on the earth")
    except GDAL_ERRORS as error:
        raise UnusableRaster(f"it cannot be read: {error}") from error


def check_map_tiles(path: Path) -> None:
    """Open MBTiles, and read a tile.

    Args:
        path: The file.

    Raises:
        UnusableRaster: if it cannot be read, or has no picture.
    """
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as tiles:
            found = tiles.execute("SELECT tile_data FROM tiles LIMIT 1").fetchone()
        if found is None:
            raise UnusableRaster("it has no tiles")
        with Image.open(io.BytesIO(found[0])) as picture:
            picture.load()
    except (sqlite3.Error, OSError, TypeError, Image.DecompressionBombError) as error:
        raise UnusableRaster(f"it cannot be read: {error}") from error


def _is_on_earth(raster: rasterio.DatasetReader) -> bool:
    if not (raster.crs.is_projected or raster.crs.is_geographic):
        return False
    return bool(np.isfinite(transform_bounds(raster.crs, "EPSG:4326", *raster.bounds)).all())


def reduced_shape(raster: rasterio.DatasetReader, most_pixels: int) -> tuple[int, int]:
    """Height and width of a view of a raster with at most so many pixels."""
    scale = min(1.0, math.sqrt(most_pixels / (raster.width * raster.height)))
    return max(1, int(raster.height * scale)), max(1, int(raster.width * scale))


def write_picture(source: Path, target: Path) -> tuple[int, int]:
    """Write an orthophoto as PNG with transparency, reduced if it is large.

    Args:
        source: The orthophoto, RGBA.
        target: Output file; its folder takes an intermediate file.

    Returns:
        Its width and height, pixels.

    Raises:
        UnusableRaster: if the orthophoto cannot be read.
        OSError: if the disk is full.
    """
    whole = target.with_suffix(".tif")
    try:
        with gdal(target.parent), open_raster(source) as raster:
            height, width = reduced_shape(raster, MAX_PICTURE_PIXELS)
            if (height, width) == raster.shape:
                copy_raster(raster, target, driver="PNG", ZLEVEL=PNG_LEVEL, strict=False)
                return width, height
            profile: dict[str, Any] = {
                "driver": "GTiff",
                "width": width,
                "height": height,
                "count": 4,
                "dtype": "uint8",
            }
            left, bottom, right, top = raster.bounds
            profile["transform"] = Affine((right - left) / width, 0.0, left, 0.0, (bottom - top) / height, top)
            layout = {"photometric": "RGB", "alpha": "unspecified", "interleave": "pixel", "compress": "deflate"}
            with rasterio.open(whole, "w", **profile, **layout, zlevel=1) as picture:
                for row in range(0, height, STRIP_ROWS):
                    rows = min(STRIP_ROWS, height - row)
                    picture.write(_strip(raster, height, width, row, rows), window=Window(0, row, width, rows))
            copy_raster(whole, target, driver="PNG", ZLEVEL=PNG_LEVEL, strict=False)
            return width, height
    except GDAL_ERRORS as error:
        raise UnusableRaster(f"it cannot be read: {error}") from error
    finally:
        whole.unlink(missing_ok=True)


def _strip(raster: rasterio.DatasetReader, height: int, width: int, row: int, rows: int) -> np.ndarray:
    """Rows of a reduced view of a raster."""
    scale = raster.height / height
    window = Window(0, row * scale, raster.width, rows * scale)
    return np.asarray(raster.read(window=window, out_shape=(4, rows, width), resampling=Resampling.average))
