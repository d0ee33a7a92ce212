"""Files of elevations: the image, the depths, and `facades.json` with their positions and accuracy.

Files are in the wall's own metres: x from its left end, y the height in the run's vertical datum, both true lengths,
without the map grid's scale. The corners in `facades.json` are in the CRS.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from affine import Affine
from jaxtyping import Float64
from PIL import Image

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.files.durable import whole_file, write_durably
from splatpipe.pipeline.engine.files.json_file import json_text
from splatpipe.pipeline.surface.facades.elevation import Elevation
from splatpipe.pipeline.surface.rasters.geotiff import GDAL_ERRORS, NODATA_HEIGHT, gdal
from splatpipe.pipeline.surface.rasters.map_crs import MapCrs

FORMAT = 1
METRE_DIGITS = 4  # decimals of lengths and coordinates in the JSON: a tenth of a millimetre
REPORTED_QUANTILE = 0.95  # the higher of the two quantiles of standard deviations that are reported


def height_zero_m(elevation: Elevation, crs: MapCrs) -> float:
    """Height in the CRS's datum minus local height at a wall, metres."""
    low = np.array([[*elevation.wall.left, elevation.wall.low_m]])
    return float(crs.crs_from_local(low)[0, 2]) * crs.height_unit_m - elevation.wall.low_m


def write_depth(path: Path, elevation: Elevation, zero_m: float) -> None:
    """Write depths as a float32 TIFF: metres in front of the plane, towards the viewer.

    Args:
        path: Output file.
        elevation: The elevation.
        zero_m: Result of ``height_zero_m``.

    Raises:
        MachineError: if the disk is full or not writable.
    """
    lattice = elevation.plane.lattice
    cell = lattice.cell_m
    profile = {
        "driver": "GTiff",
        "width": lattice.width,
        "height": lattice.height,
        "count": 1,
        "dtype": "float32",
        "nodata": NODATA_HEIGHT,
        "transform": Affine(cell, 0.0, lattice.east_m, 0.0, -cell, lattice.north_m + zero_m),
        "compress": "deflate",
        "predictor": 3,
    }
    values = np.where(np.isfinite(elevation.depth), elevation.depth, NODATA_HEIGHT).astype(np.float32)
    try:
        with whole_file(path) as aside, gdal(aside.parent), rasterio.open(aside, "w", **profile) as raster:
            raster.descriptions = ("depth before the plane",)
            raster.units = ("metre",)
            raster.write(values, 1)
    except GDAL_ERRORS as error:
        raise MachineError(f"{path} cannot be written: {error}", "Is there space on the disk?") from error


def write_picture(path: Path, elevation: Elevation) -> None:
    """Write colours as a PNG, transparent where there are none."""
    with whole_file(path) as aside:
        Image.fromarray(elevation.colour).save(aside)


def elevation_facts(elevation: Elevation, crs: MapCrs, files: dict[str, str]) -> dict[str, Any]:
    """The entry of an elevation in `facades.json`.

    Args:
        elevation: The elevation.
        crs: CRS of its corners.
        files: Names of its files beside the JSON, by ``depth``, ``picture``, ``dxf``, ``svg``.
    """
    wall, lattice = elevation.wall, elevation.plane.lattice
    known = np.isfinite(elevation.depth)
    sigma = elevation.sigma[known]
    spread = (
        [None, None] if not sigma.size else [_rounded(float(np.quantile(sigma, q))) for q in (0.5, REPORTED_QUANTILE)]
    )
    return {
        "name": wall.name,
        "corners": _listed(crs.crs_from_local(elevation.corners())),
        **files,
        "gsd_m": lattice.cell_m,
        "width_px": lattice.width,
        "height_px": lattice.height,
        "length_m": _rounded(wall.length_m),
        "height_m": _rounded(wall.high_m - wall.low_m),
        "area_m2": _rounded(wall.area_m2),
        "plane": _plane(elevation, crs),
        "behind_plane_m": -elevation.plane.relief.low_m,
        "before_plane_m": elevation.plane.relief.high_m,
        "share_with_depth": _rounded(float(known.mean())),
        "share_with_colour": _rounded(float((elevation.colour[..., 3] > 0).mean())),
        "depth_sigma_median_m": spread[0],
        "depth_sigma_95_percent_m": spread[1],
    }


def write_facades(path: Path, facts: Sequence[dict[str, Any]], crs: MapCrs) -> None:
    """Write `facades.json`.

    Args:
        path: Output file.
        facts: Entries of all elevations.
        crs: CRS of the corners.
    """
    authority = crs.horizontal.to_authority(min_confidence=100)
    value = {
        "format": FORMAT,
        "crs": crs.horizontal.name if authority is None else ":".join(authority),
        "unit_m": crs.unit_m,
        "heights": crs.described_heights(),
        "depths": "metres before the plane, towards the viewer",
        "facades": list(facts),
    }
    write_durably(path, json_text(value))


def _plane(elevation: Elevation, crs: MapCrs) -> dict[str, Any]:
    """A point on the plane, and the azimuth (clockwise from grid north) that the wall faces."""
    wall = elevation.wall
    foot = np.array([*((wall.left + wall.right) / 2.0), wall.low_m])
    before = foot + np.array([*wall.facing, 0.0])
    there = crs.crs_from_local(np.stack([foot, before]))
    east, north = (there[1] - there[0])[:2]
    return {"point": _listed(there[:1])[0], "azimuth_deg": _rounded(math.degrees(math.atan2(east, north)) % 360.0)}


def _rounded(value: float) -> float:
    return round(value, METRE_DIGITS)


def _listed(places: Float64[np.ndarray, "n 3"]) -> list[list[float]]:
    return [[_rounded(float(number)) for number in place] for place in places]
