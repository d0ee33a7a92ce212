"""Reads heights from a surface model's file window by window: along lines, and within rectangles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from rasterio.windows import Window

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.surface.heights.height_field import HeightField
from splatpipe.pipeline.surface.rasters.geotiff import GDAL_ERRORS, gdal, open_raster
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile

WINDOW = 1024  # cells a side that are read at a time
SIGMA_BAND = 2  # band of `dsm_confidence.tif` with deviations in millimetres; 0 where there is none


@dataclass(frozen=True, eq=False)
class SurfaceFile:
    """A north-up raster of heights, with their expected deviations.

    Attributes:
        path: `dsm.tif`.
        confidence: `dsm_confidence.tif`, on the same grid; None where there is none.
        lattice: The raster's cells, in the CRS's unit, unlike other lattices, which are in metres.
    """

    path: Path
    confidence: Path | None
    lattice: Lattice

    @property
    def cell(self) -> float:
        """Cell size, in the CRS's unit."""
        return self.lattice.cell_m

    def heights(self, part: Tile) -> Float64[np.ndarray, "h w"]:
        """Heights of cells, in the CRS's unit; NaN where there are none, and outside."""
        return _read(self.path, 1, part)

    def sigmas_m(self, part: Tile) -> Float64[np.ndarray, "h w"]:
        """Expected deviations of heights, metres; NaN where unknown."""
        if self.confidence is None:
            return np.full((part.height, part.width), np.nan)
        millimetres = _read(self.confidence, SIGMA_BAND, part)
        return np.where(millimetres > 0.0, millimetres / 1000.0, np.nan)

    def along(self, places: Float64[np.ndarray, "n 2"]) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Heights (in the CRS's unit) and expected deviations (metres) of consecutive places.

        Heights are interpolated between smooth cells; at a step they are the nearest cell's.

        Args:
            places: Eastings and northings.
        """
        heights, sigmas = np.full(len(places), np.nan), np.full(len(places), np.nan)
        column, row = self.lattice.places(places[:, 0], places[:, 1])
        for rows in _runs(np.stack([row, column], axis=1)):
            low = np.floor([row[rows].min(), column[rows].min()]).astype(int) - 1
            high = np.floor([row[rows].max(), column[rows].max()]).astype(int) + 2
            part = Tile(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
            cell = self.cell
            east, north = self.lattice.east_m + part.column * cell, self.lattice.north_m - part.row * cell
            lattice = Lattice(east, north, cell, part.width, part.height)
            read = self.heights(part).astype(np.float32)
            heights[rows] = HeightField(lattice, read).at(places[rows, 0], places[rows, 1])
            own = np.floor(row[rows]).astype(int) - part.row, np.floor(column[rows]).astype(int) - part.column
            sigmas[rows] = self.sigmas_m(part)[own]
        return heights, sigmas


def open_surface(path: Path, confidence: Path | None = None) -> SurfaceFile:
    """Open a surface model.

    Args:
        path: A north-up GeoTIFF of heights.
        confidence: `dsm_confidence.tif` of the same run; None if there is none.

    Raises:
        SplatpipeError: if it is not such a raster, or the two do not share a grid.
    """
    try:
        with gdal(path.parent), open_raster(path) as raster:
            at, shape = raster.transform, raster.shape
        if confidence is not None:
            with gdal(path.parent), open_raster(confidence) as raster:
                same = raster.shape == shape and raster.transform == at and raster.count >= SIGMA_BAND
            if not same:
                raise SplatpipeError(f"{confidence.name} is not on the grid of {path.name}.", "Make both again.")
    except GDAL_ERRORS as error:
        raise SplatpipeError(f"{path} cannot be read: {error}", "Make it again with --rerun dsm.") from error
    if at.b or at.d or at.a <= 0.0 or at.a != -at.e:
        raise SplatpipeError(f"{path.name} is not north up with square cells.", "Use the run's own dsm.tif.")
    return SurfaceFile(path, confidence, Lattice(at.c, at.f, at.a, shape[1], shape[0]))


def _runs(cells: Float64[np.ndarray, "n 2"]) -> Iterator[slice]:
    """Split a sequence of places into runs that each fit into a window."""
    start = 0
    while start < len(cells):
        ahead = cells[start : start + WINDOW]
        low, high = np.minimum.accumulate(ahead), np.maximum.accumulate(ahead)
        fits = (high - low).max(axis=1) < WINDOW
        count = len(ahead) if fits.all() else max(1, int(np.argmin(fits)))
        yield slice(start, start + count)
        start += count


def _read(path: Path, band: int, part: Tile) -> Float64[np.ndarray, "h w"]:
    """Values of cells, NaN where there are none, and outside of the raster."""
    found = np.full((part.height, part.width), np.nan)
    with gdal(path.parent), open_raster(path) as raster:
        top, bottom = np.clip([part.row, part.row + part.height], 0, raster.height)
        left, right = np.clip([part.column, part.column + part.width], 0, raster.width)
        if top < bottom and left < right:
            window = Window(int(left), int(top), int(right - left), int(bottom - top))
            read = raster.read(band, window=window, masked=True).astype(np.float64).filled(np.nan)
            found[top - part.row : bottom - part.row, left - part.column : right - part.column] = read
    return found
