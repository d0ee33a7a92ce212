"""Cloud Optimised GeoTIFFs, written tile by tile in bounded memory, with GDAL (rasterio).

Contents of the files, and why:
- `dsm.tif` only has heights. A GeoTIFF has one type and one nodata value for all bands, terrain and CAD programs expect
  a single band, and QGIS draws two bands as a red and green image. Confidence is a separate file on the same grid.
- nodata is -9999, which every program knows; some do not treat NaN as nodata.
- Heights are quantized to 2⁻¹⁰ m: off by half a millimetre at most, and half the size of files with noise in all bits
  (1.1 instead of 2.2 bytes per cell for a synthetic surface with 2 mm of noise).
- DEFLATE with TIFF predictors: ZSTD is 5 % smaller, but some readers do not know it. Colours are lossless with an
  alpha band, as files used for measuring should be: 2.2 bytes per cell for a photo of the demo. JPEG of quality 92
  takes half of that, at a PSNR of 51 dB, with a mask: with nodata, its noise would affect black areas.
- The vertical CRS is included if EPSG has one. GeoTIFF cannot express ellipsoidal heights of a projected CRS (GDAL
  would write a sidecar file), so the tag VERTICAL_DATUM states the heights in every file.
- Files have neither date nor version: the same values give the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio._err import CPLE_BaseError
from rasterio.crs import CRS
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioError, RasterioIOError
from rasterio.shutil import copy as copy_raster
from rasterio.windows import Window

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.files.durable import whole_file
from splatpipe.pipeline.surface.rasters.grid import TILE, Grid
from splatpipe.pipeline.surface.rasters.map_crs import unit_name
from splatpipe.pipeline.surface.rasters.tiles import Tile

NODATA_HEIGHT = -9999.0
HEIGHT_STEPS_PER_UNIT = 1024.0  # a power of two, so that steps have few bits and compress well
CACHE_BYTES = 128 << 20  # for GDAL's blocks; the default is a share of the machine's memory
JPEG_QUALITY = 92
GDAL_ERRORS = (RasterioError, CPLE_BaseError, SystemError)  # the last if a GDAL copy fails without a message


@dataclass(frozen=True)
class RasterForm:
    """Layout and compression of a raster.

    Attributes:
        dtype: Type of all bands.
        bands: Names of the bands.
        nodata: Nodata value of all bands; None if there is an alpha band instead.
        packing: Options of GDAL's COG driver.
        has_heights: Whether values are heights in the CRS's unit.
        over_ground: Whether these heights count from the ground instead of from the CRS's zero.
    """

    dtype: str
    bands: tuple[str, ...]
    nodata: float | None
    packing: tuple[tuple[str, str], ...]
    has_heights: bool = False
    over_ground: bool = False


_DEFLATE = (("COMPRESS", "DEFLATE"), ("PREDICTOR", "YES"), ("LEVEL", "6"))
_JPEG = (("COMPRESS", "JPEG"), ("QUALITY", str(JPEG_QUALITY)))
_RGBA = ("red", "green", "blue", "alpha")
HEIGHTS = RasterForm("float32", ("height",), NODATA_HEIGHT, _DEFLATE, has_heights=True)
HEIGHTS_OVER_GROUND = RasterForm(
    "float32", ("height over the ground",), NODATA_HEIGHT, _DEFLATE, has_heights=True, over_ground=True
)
CONFIDENCE = RasterForm("uint16", ("photos that confirm the height", "expected deviation, mm"), 0.0, _DEFLATE)
# 0 is a distance, too: of ground that photos see.
GROUND_CONFIDENCE = RasterForm(
    "uint16", ("distance to the nearest ground that photos see, cm", "expected deviation, mm"), 65535.0, _DEFLATE
)
COVER = RasterForm("uint8", ("class as in LAS",), 0.0, _DEFLATE)
COLOURS = RasterForm("uint8", _RGBA, None, _DEFLATE)
COLOURS_AS_JPEG = RasterForm("uint8", _RGBA, None, _JPEG)


class RasterFile:
    """A raster that is being written.

    Args:
        raster: The rasterio dataset.
        form: Its layout.
    """

    def __init__(self, raster: Any, form: RasterForm) -> None:
        self._raster = raster
        self._form = form

    def write(self, tile: Tile, values: np.ndarray) -> None:
        """Write a tile; tiles that are never written are nodata.

        Args:
            tile: Tile of the grid.
            values: (bands, height, width), or (height, width) for a raster of one band; of the layout's type.
                Non-finite heights are nodata, and so are colours with alpha 0.

        Raises:
            ValueError: if the values do not have the layout's type and the tile's size.
            MachineError: if the disk is full.
        """
        values = values[None] if values.ndim == 2 else values
        if values.shape != (len(self._form.bands), tile.height, tile.width) or values.dtype != self._form.dtype:
            raise ValueError(f"{values.dtype} {values.shape} is not {self._form.dtype} of {self._form.bands} in {tile}")
        if self._form.has_heights:
            values = _packed_heights(values)
        elif self._form.bands == _RGBA:
            values = np.where(values[3] > 0, values, 0).astype(values.dtype)
        self._raster.write(values, window=Window(tile.column, tile.row, tile.width, tile.height))


@contextmanager
def raster_file(path: Path, grid: Grid, form: RasterForm) -> Iterator[RasterFile]:
    """Write a Cloud Optimised GeoTIFF; it is complete when the block ends, and absent if that fails.

    Args:
        path: Output file.
        grid: Grid of the raster.
        form: One of this module's constants.

    Raises:
        MachineError: if the disk is full or not writable.
    """
    with whole_file(path) as aside, gdal(aside.parent):
        tiled = aside.with_name("tiled.tif")
        try:
            with rasterio.open(tiled, "w", **_profile(grid, form)) as raster:
                _describe(raster, grid, form)
                yield RasterFile(raster, form)
            options = {**_COG, **dict(form.packing), **({"STATISTICS": "YES"} if form.has_heights else {})}
            copy_raster(tiled, aside, driver="COG", strict=False, **options)
            _require_whole(aside, grid)
        except GDAL_ERRORS as error:
            raise MachineError(f"{path} cannot be written: {error}", "Is there space on the disk?") from error


def open_raster(path: Path) -> rasterio.DatasetReader:
    """Open a GeoTIFF for reading, within ``gdal``, and nothing else that bears its name.

    GDAL looks at a file's content, and other formats name further files and addresses: a `dsm.tif` of an OUT from
    somebody else, a virtual raster in truth, put bytes of a private file into results and asked a server for more.

    Raises:
        RasterioIOError: if it is not a GeoTIFF.
    """
    return rasterio.open(path, driver="GTiff")


def gdal(scratch: Path) -> rasterio.Env:
    """GDAL environment for writing files: no network, no sidecar files, little memory, one thread.

    GDAL has its own PROJ with its own settings; pyproj's stay unchanged.

    Args:
        scratch: Folder for GDAL's temporary files.
    """
    return rasterio.Env(
        CPL_TMPDIR=str(scratch),
        GDAL_CACHEMAX=CACHE_BYTES,
        GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR",
        GDAL_NUM_THREADS="1",
        GDAL_PAM_ENABLED="NO",
        GDAL_TIFF_INTERNAL_MASK="YES",
        PROJ_NETWORK="OFF",
    )


_COG = {"BLOCKSIZE": str(TILE), "OVERVIEW_RESAMPLING": "AVERAGE", "BIGTIFF": "IF_SAFER", "NUM_THREADS": "1"}


def _profile(grid: Grid, form: RasterForm) -> dict[str, Any]:
    """Creation options of the tiled raster from which the final one is copied."""
    return {
        "driver": "GTiff",
        "width": grid.width,
        "height": grid.height,
        "count": len(form.bands),
        "dtype": form.dtype,
        "nodata": form.nodata,
        "crs": _written_crs(grid, form),
        "transform": grid.transform,
        "tiled": True,
        "blockxsize": TILE,
        "blockysize": TILE,
        "interleave": "pixel",
        "sparse_ok": True,
        "bigtiff": "yes",
        "compress": "deflate",
        "zlevel": 1,
        **({"photometric": "RGB", "alpha": "unspecified"} if form.bands == _RGBA else {}),
    }


def _written_crs(grid: Grid, form: RasterForm) -> CRS:
    """The CRS to write: compound for heights, except for a datum by +towgs84, which GDAL loses in a compound CRS."""
    plane = grid.crs.horizontal
    crs = grid.crs.compound if form.has_heights and not form.over_ground and not plane.is_bound else plane
    return CRS.from_wkt(crs.to_wkt("WKT1_GDAL" if plane.is_engineering else "WKT2_2019"))


def _describe(raster: Any, grid: Grid, form: RasterForm) -> None:
    raster.descriptions = form.bands
    if form.has_heights:
        raster.units = (unit_name(grid.crs.height_unit_m),)
    if form.has_heights and not form.over_ground:
        raster.update_tags(VERTICAL_DATUM=grid.crs.described_heights())
    if form.bands == _RGBA:
        raster.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)


def _packed_heights(values: np.ndarray) -> np.ndarray:
    """Heights rounded to whole steps; nodata where they are not finite."""
    steps = np.round(values.astype(np.float64) * HEIGHT_STEPS_PER_UNIT) / HEIGHT_STEPS_PER_UNIT
    return np.where(np.isfinite(steps), steps, NODATA_HEIGHT).astype(np.float32)


def _require_whole(path: Path, grid: Grid) -> None:
    """Check that the last block was written: on closing a file, GDAL reports a full disk only in its log.

    Raises:
        RasterioError: if the file is incomplete.
    """
    with open_raster(path) as raster:
        if raster.shape != (grid.height, grid.width):
            raise RasterioIOError("its size is another one")
        for row, column in ((0, 0), (grid.height - 1, grid.width - 1)):
            raster.read(window=Window(column, row, 1, 1))
