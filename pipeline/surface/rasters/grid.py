"""The raster grid of a run's surface products: north up in the run's CRS, aligned to whole multiples of its cell size.

So rasters with the same cell size align without resampling, whatever their extents. Cells are counted from the upper
left corner; the centre of the first is (0.5, 0.5). A value represents its cell's area (GeoTIFF's PixelIsArea, the
default of all readers, without a half-cell shift).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from affine import Affine
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.surface.rasters.map_crs import MapCrs, open_map
from splatpipe.pipeline.surface.rasters.smooth_map import SPACING_M, SmoothMap, sample_map
from splatpipe.pipeline.surface.rasters.tiles import Tile, tiled
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.crs.world import World

TILE = 512  # cells: a block of the files
DIGITS = 3  # significant digits of the cell size: 0.028 rather than 0.027963; at most 0.5 % off
GROUND_SCALE_TOLERANCE = 0.005  # a grid metre this close to a ground metre counts as one, so that 2 cm stay 2 cm in UTM
MIN_CELL_M, MAX_CELL_M = 1e-4, 1e3
MAX_CELLS_PER_SIDE = 1_000_000
MAX_CELLS = 20_000_000_000  # 8 km² at 2 cm, a file of 80 GB of heights before compression
ROUNDING = 1e-6  # cells: an extent that ends on a grid line gets no cell beyond it
EDGE_STEPS = 9  # samples along each side of the scene's box
HEIGHT_MARGIN_M = 10.0  # by which the lattice exceeds the scene: heights are interpolated linearly in it


Exact = Callable[[Float64[np.ndarray, "n 3"]], Float64[np.ndarray, "n 3"]]


@dataclass(frozen=True, eq=False)
class Grid:
    """A north-up raster grid.

    Attributes:
        crs: Its CRS.
        cell: Cell size, in the CRS's unit.
        left: The left border in cells from the CRS's origin: a whole number.
        top: The upper border in cells from the CRS's origin.
        width: In cells.
        height: In cells.
        cell_m: Cell size on the ground, metres.
        crs_from_local: East, north, up (metres) to easting, northing, height in the CRS's units; within 0.2 mm of PROJ
            over a scene of less than 20 km.
        local_from_crs: The inverse, equally accurate.
    """

    crs: MapCrs
    cell: float
    left: int
    top: int
    width: int
    height: int
    cell_m: float
    crs_from_local: SmoothMap = field(repr=False)
    local_from_crs: SmoothMap = field(repr=False)

    @property
    def transform(self) -> Affine:
        """From cells (column, row) to the CRS."""
        return Affine(self.cell, 0.0, self.left * self.cell, 0.0, -self.cell, self.top * self.cell)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north in the CRS."""
        right, bottom = self.left + self.width, self.top - self.height
        return self.left * self.cell, bottom * self.cell, right * self.cell, self.top * self.cell

    def tiles(self, size: int = TILE) -> Iterator[Tile]:
        """Tiles of the whole grid, row by row."""
        return tiled(self.height, self.width, size)

    def cells_from_local(self, local: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """East, north, up (metres) to column, row and height in the CRS's unit."""
        cells = self.crs_from_local(local)
        cells[:, 0] = cells[:, 0] / self.cell - self.left
        cells[:, 1] = self.top - cells[:, 1] / self.cell
        return cells

    def local_from_cells(self, cells: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Column, row and height in the CRS's unit to east, north, up (metres)."""
        coordinates = np.array(cells, np.float64)
        coordinates[:, 0] = (self.left + cells[:, 0]) * self.cell
        coordinates[:, 1] = (self.top - cells[:, 1]) * self.cell
        return self.local_from_crs(coordinates)

    def centres_in_local(self, tile: Tile, heights: Float64[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w 3"]:
        """East, north, up (metres) of the centres of a tile's cells, with heights in the CRS's unit."""
        columns = tile.column + 0.5 + np.arange(tile.width)
        rows = tile.row + 0.5 + np.arange(tile.height)
        cells = np.stack([*np.meshgrid(columns, rows), heights], axis=-1)
        return self.local_from_cells(cells.reshape(-1, 3)).reshape(cells.shape)


def make_grid(frame: Frame, box: Float64[np.ndarray, "2 3"], gsd_m: float) -> Grid:
    """The grid that covers a scene.

    Args:
        frame: A metric frame.
        box: Least and largest east, north, up of the scene in the frame's metres.
        gsd_m: Cell size on the ground, metres. It is rounded to three significant digits in the CRS's unit.

    Raises:
        SplatpipeError: if the frame is not metric or its CRS cannot be used, or the grid would be absurdly large.
    """
    if not MIN_CELL_M <= gsd_m <= MAX_CELL_M:
        raise SplatpipeError(f"Cells of {gsd_m:g} m are not valid for a surface.", "Give a size such as --gsd 2cm.")
    box = np.asarray(box, np.float64)
    if not np.isfinite(box).all() or not (box[0] <= box[1]).all():
        raise SplatpipeError("The scene has no extent.", "Check the sparse model: were photos placed?")
    crs = open_map(frame)
    cell = cell_size(crs, gsd_m)
    mapped = crs.crs_from_local(_border(box))
    if not np.isfinite(mapped).all():
        raise SplatpipeError(f"The scene reaches beyond where {crs.horizontal.name} is defined.", "Set a --boundary.")
    west, south, _ = mapped.min(axis=0) / cell
    east, north, _ = mapped.max(axis=0) / cell
    left, top = math.floor(west + ROUNDING), math.ceil(north - ROUNDING)
    width = max(math.ceil(east - ROUNDING) - left, 1)
    height = max(top - math.floor(south + ROUNDING), 1)
    _require_reasonable(width, height, gsd_m)
    there = np.stack([mapped.min(axis=0), mapped.max(axis=0)])
    to_crs = _smooth(crs.crs_from_local, box, 1.0, 1.0)
    to_local = _smooth(crs.local_from_crs, there, crs.unit_m, crs.height_unit_m)
    return Grid(crs, cell, left, top, width, height, gsd_m, to_crs, to_local)


def cell_size(crs: MapCrs, gsd_m: float) -> float:
    """Cell size in a CRS's unit, rounded to a few digits.

    Args:
        crs: The CRS: its unit may be a foot, and its metre longer than the ground's, as in Web Mercator.
        gsd_m: Cell size on the ground, metres.
    """
    scale = 1.0 if crs.world is None else _ground_scale(crs.world)
    stretched = gsd_m if abs(scale - 1.0) < GROUND_SCALE_TOLERANCE else gsd_m * scale
    return float(f"{stretched / crs.unit_m:.{DIGITS}g}")


def _ground_scale(world: World) -> float:
    scale = world.grid_scale()
    return 1.0 if scale is None else scale.ground


def _require_reasonable(width: int, height: int, gsd_m: float) -> None:
    if max(width, height) > MAX_CELLS_PER_SIDE or width * height > MAX_CELLS:
        raise SplatpipeError(
            f"A raster of {width:,} × {height:,} cells of {gsd_m:g} m is too large.",
            "Choose larger cells with --gsd, or a part of the scene with --boundary.",
        )


def _border(box: Float64[np.ndarray, "2 3"]) -> Float64[np.ndarray, "n 3"]:
    """Samples along a box's sides, at its bottom and its top."""
    steps = np.linspace(0.0, 1.0, EDGE_STEPS)
    plane = np.stack(np.meshgrid(steps, steps, [0.0, 1.0], indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(box[0] + plane * (box[1] - box[0]))


def _smooth(exact: Exact, box: Float64[np.ndarray, "2 3"], unit_m: float, height_unit_m: float) -> SmoothMap:
    """A smooth map over a box and a margin, in any units."""
    spacing = SPACING_M / unit_m
    margin = np.array([spacing, spacing, HEIGHT_MARGIN_M / height_unit_m])
    return sample_map(exact, box[0] - margin, box[1] + margin, spacing)
