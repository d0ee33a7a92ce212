"""A cloud thinned to a budget, evenly in space: at most one point in each cube, as small as the budget allows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from splatpipe.pipeline.surface.levels.cloud_file import cloud_pieces, open_cloud
from splatpipe.pipeline.surface.shapes.point_cloud import SIXTEEN_BITS

MIN_EXTENT = 1e-3  # of a cloud, in its CRS's unit
COARSER = 2.0**0.25  # by which cubes grow while there are too many points


@dataclass(frozen=True, eq=False)
class ThinnedCloud:
    """Some points of a cloud.

    Attributes:
        coordinates: Easting, northing, height in the file's CRS.
        colours: Red, green, blue.
        spacing: Side of the cubes that hold at most one of them, in the CRS's unit.
    """

    coordinates: Float64[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]
    spacing: float


def thinned_cloud(path: Path, most: int) -> ThinnedCloud:
    """Read a cloud in little memory and thin it.

    Args:
        path: A LAZ file with colours.
        most: Maximum number of points.

    Raises:
        SplatpipeError: if it cannot be read.
    """
    with open_cloud(path) as reader:
        low = reader.header.mins
        extent = np.maximum(reader.header.maxs - low, MIN_EXTENT)
    cube = math.sqrt(float(extent[0] * extent[1]) / most)
    kept, colours = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    for points in cloud_pieces(path):
        bands = np.stack([points.red, points.green, points.blue], axis=1) // SIXTEEN_BITS
        kept = np.concatenate([kept, np.stack([points.x, points.y, points.z], axis=1)])
        colours = np.concatenate([colours, bands.astype(np.uint8)])
        rows = _one_a_cube(kept - low, cube)
        while len(rows) > most:
            cube *= COARSER
            rows = rows[_one_a_cube(kept[rows] - low, cube)]
        kept, colours = kept[rows], colours[rows]
    return ThinnedCloud(kept, colours, cube)


def _one_a_cube(places: Float64[np.ndarray, "n 3"], cube: float) -> np.ndarray:
    """Rows of the first point in each cube, in order."""
    cells = np.floor(places / cube).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    x, y, _ = (int(size) + 1 for size in cells.max(axis=0, initial=0))
    _, first = np.unique((cells[:, 2] * y + cells[:, 1]) * x + cells[:, 0], return_index=True)
    return np.sort(first)
