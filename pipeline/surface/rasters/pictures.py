"""Thumbnails of large rasters for HTML pages, from their overviews, so that the raster's size does not matter."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import rasterio
from jaxtyping import Float64, UInt8
from rasterio.enums import Resampling

from splatpipe.pipeline.surface.rasters.geotiff import gdal, open_raster

EMPTY = 255  # grey of what has no data
LIGHT_FROM = np.array([-0.5, 0.5, np.sqrt(0.5)])  # east, north, up: from the north-west at 45°, as on maps
MIN_BRIGHTNESS, MAX_BRIGHTNESS = 0.25, 1.4  # brightness of slopes away from and towards the light; level ground has 1
SPREAD = 0.01  # share of the heights at either end that get the end's colour


@dataclass(frozen=True, eq=False)
class ReliefPicture:
    """Hillshaded, coloured heights, lit from the north-west.

    Attributes:
        pixels: RGB.
        low: Height of the first colour, in the file's unit.
        high: Height of the last colour, in the file's unit.
    """

    pixels: UInt8[np.ndarray, "h w 3"]
    low: float
    high: float


def ortho_picture(path: Path, side: int) -> UInt8[np.ndarray, "h w 3"]:
    """A thumbnail of `ortho.tif`, RGB, white where there is no data.

    Args:
        path: The file.
        side: Maximum length of the longer side, pixels.
    """
    with gdal(path.parent), open_raster(path) as raster:
        bands = raster.read(out_shape=(raster.count, *_shape(raster, side)), resampling=Resampling.average)
    return np.asarray(np.where(bands[3:] > 0, bands[:3], EMPTY).transpose(1, 2, 0), np.uint8)


def relief_picture(path: Path, side: int) -> ReliefPicture | None:
    """A thumbnail of `dsm.tif`; None if it has no heights.

    Args:
        path: The file.
        side: Maximum length of the longer side, pixels.
    """
    with gdal(path.parent), open_raster(path) as raster:
        shape = _shape(raster, side)
        found = raster.read(1, out_shape=shape, masked=True, resampling=Resampling.average)
        step = raster.transform.a * raster.width / shape[1]
    height = found.astype(np.float64).filled(np.nan)
    known = np.isfinite(height)
    if not known.any() or min(shape) < 2:
        return None
    low, high = (float(each) for each in np.quantile(height[known], [SPREAD, 1.0 - SPREAD]))
    pixels = np.where(known[..., None], shaded_relief(height, step, low, high), EMPTY)
    return ReliefPicture(pixels.astype(np.uint8), low, high)


def shaded_relief(
    height: Float64[np.ndarray, "h w"], step: float, low: float, high: float
) -> UInt8[np.ndarray, "h w 3"]:
    """Colours of heights, lit from the north-west; where there is no height they mean nothing.

    Args:
        height: Heights; NaN where unknown.
        step: Distance between them, in their unit.
        low: Height of the first colour.
        high: Height of the last colour.
    """
    shade = np.clip((height - low) / max(high - low, 1e-9), 0.0, 1.0)
    colours = matplotlib.colormaps["viridis"](np.nan_to_num(shade))[..., :3] * _light(height, step)[..., None]
    return np.asarray(np.clip(colours * 255.0, 0.0, 255.0).astype(np.uint8))


def _light(height: Float64[np.ndarray, "h w"], step: float) -> Float64[np.ndarray, "h w"]:
    """Hillshade of a surface; as for level ground where the slope is unknown."""
    down, right = np.gradient(height, step)
    normal = np.stack([-right, down, np.ones_like(height)], axis=-1)
    lit = (normal @ LIGHT_FROM) / np.linalg.norm(normal, axis=-1) / LIGHT_FROM[2]
    return np.asarray(np.clip(np.nan_to_num(lit, nan=1.0), MIN_BRIGHTNESS, MAX_BRIGHTNESS))


def _shape(raster: rasterio.DatasetReader, side: int) -> tuple[int, int]:
    scale = min(1.0, side / max(raster.height, raster.width))
    return max(1, round(raster.height * scale)), max(1, round(raster.width * scale))
