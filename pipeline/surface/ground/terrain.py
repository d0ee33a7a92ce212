"""The digital terrain model (DTM) on the surface model's grid: the surface where it is ground, filled where it is not.

Heights come block by block from the surface model's file (`blocks`): low ones, in which the ground is searched for
(`ground_filter`), and the means of what is ground, between which a membrane is spanned (`membrane`). Steps follow each
other over the whole site, each in parts that are files (`part_files`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import distance_transform_edt

from splatpipe.pipeline.surface.ground.blocks import LOW_SHARE, BlockGrid, inner, mean_heights, quantiles, unblocked
from splatpipe.pipeline.surface.ground.ground_filter import WIDEST_M, GroundScale, find_ground
from splatpipe.pipeline.surface.ground.membrane import REACH, SHRUNK, fill_membrane, fill_window, shrink
from splatpipe.pipeline.surface.ground.part_files import Arrays, PartFiles
from splatpipe.pipeline.surface.ground.roofs import RoofScale, find_roofs
from splatpipe.pipeline.surface.heights.surface_file import SurfaceFile
from splatpipe.pipeline.surface.rasters.tiles import Tile

MARGIN_M = 1.5 * WIDEST_M  # around a part, in which objects have to be seen whole
SURFACE_GSD = 3.0  # from low ground up to which the surface is taken over: 97 % of heights are within
MAX_HOLE_M2 = 400.0  # holes in the surface model up to this area are filled: a pond, a hall's roof that nothing matches
# Expected deviation of filled ground, over the distance to the next ground that was seen: 90 % of the ground under
# houses and crowns of the made slope is within twice that.
DEVIATION_SHARE = 0.05
MILLIMETRES, CENTIMETRES = 1000.0, 100.0
UNKNOWN = np.iinfo(np.uint16).max  # in the confidence; one less is the largest value
NOTHING, OTHER, GROUND, BUILDING = 0, 1, 2, 6  # cover, numbered as the classes of LAS

Cells = Float64[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]
Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class TerrainSource:
    """The surface model whose ground is searched for.

    Attributes:
        surface: Its files.
        cell_m: Cell size on the ground, metres.
        height_unit_m: Unit of the heights, metres.
        gsd_m: GSD of the photos, or of depths that are coarser than half the cells, metres.
    """

    surface: SurfaceFile
    cell_m: float
    height_unit_m: float
    gsd_m: float

    def blocks(self) -> BlockGrid:
        """Its blocks."""
        return BlockGrid.of(self.surface.lattice.height, self.surface.lattice.width, self.cell_m)

    def heights_m(self, cells: Tile) -> Cells:
        """Heights of cells, metres; NaN where there are none, and outside."""
        return self.surface.heights(cells) * self.height_unit_m

    def scale(self) -> GroundScale:
        """What the filter's lengths follow from."""
        return GroundScale(self.blocks().side * self.cell_m, self.gsd_m)


class TerrainSteps:
    """The steps from the surface model to the terrain, each in parts.

    Args:
        source: The surface model.
        work: Folder of finished parts.
        threads: Parts in parallel.
    """

    def __init__(self, source: TerrainSource, work: Path, threads: int) -> None:
        self._source, self._threads = source, threads
        self._grid, self._scale = source.blocks(), source.scale()
        parts = self._grid.parts()
        self._low, self._ground, self.made = (PartFiles(work, name, parts) for name in ("low", "ground", "terrain"))

    def compute(self, progress: Progress) -> None:
        """Compute all missing parts.

        Args:
            progress: Receives how many parts of how many are done.
        """
        total, before = 3 * len(self.made.parts), 0
        for files, make in ((self._low, self._low_part), (self._ground, self._ground_part)):
            for done in files.compute(make, self._threads):
                progress(before + done, total)
            before += len(files.parts)
        coarse = fill_membrane(self._coarse_ground())
        for done in self.made.compute(lambda part: self._terrain_part(part, coarse), self._threads):
            progress(before + done, total)

    def finished(self, *names: str) -> Iterator[tuple[Tile, Arrays]]:
        """The cells of each part of the terrain, which may reach beyond the raster, with some of its arrays."""
        for number, part in enumerate(self.made.parts):
            yield self._grid.cells(part), self.made.load(number, *names)

    def _low_part(self, part: Tile) -> Arrays:
        heights, side = self._source.heights_m(self._grid.cells(part)), self._grid.side
        low, middle = quantiles(heights, side, (LOW_SHARE, 0.5))
        return {"low": low, "middle": middle}

    def _ground_part(self, part: Tile) -> Arrays:
        window, side = self._grid.window(part, self._scale.cells(MARGIN_M)), self._grid.side
        low = self._low.window(window, "low")
        near = _near_ground(low, find_ground(low, self._scale), SURFACE_GSD * self._scale.gsd_m)
        lowest, highest = (unblocked(each[inner(part, window)], side) for each in near)
        heights = self._source.heights_m(self._grid.cells(part))
        ground = (heights >= lowest) & (heights <= highest)  # False for NaN
        return {
            "ground": np.packbits(ground),
            "mean": mean_heights(np.where(ground, heights, np.nan), side),
        }

    def _coarse_ground(self) -> Cells:
        """Ground of the whole site on the coarse level of the membrane."""
        shape = -(-self._grid.height // SHRUNK), -(-self._grid.width // SHRUNK)
        coarse = np.full(shape, np.nan)
        for number, part in enumerate(self._ground.parts):
            some = shrink(self._ground.load(number, "mean")["mean"])
            row, column = part.row // SHRUNK, part.column // SHRUNK
            coarse[row : row + some.shape[0], column : column + some.shape[1]] = some
        return coarse

    def _terrain_part(self, part: Tile, coarse: Cells) -> Arrays:
        grid, source = self._grid, self._source
        window = grid.window(part, REACH)
        mean, top = self._ground.window(window, "mean"), self._low.window(window, "middle")
        filled = fill_window(mean, _coarse_window(coarse, window))
        roofs = find_roofs(top, top - filled, RoofScale(self._scale.cell_m, source.gsd_m))
        away = _distance(np.isfinite(mean)) * self._scale.cell_m
        inside, side = inner(part, window), grid.side
        cells = grid.cells(part)
        heights, sigmas = source.heights_m(cells), source.surface.sigmas_m(cells)
        packed = self._ground.load(self._ground.parts.index(part), "ground")["ground"]
        ground = np.unpackbits(packed)[: heights.size].reshape(heights.shape) > 0
        there = np.isfinite(heights) | unblocked(_surrounded(top, self._scale.cell_m)[inside], side)
        there &= np.isfinite(unblocked(filled[inside], side))
        terrain = np.where(ground, heights, _enlarged(filled, inside, side))
        distance = np.where(ground, 0.0, np.maximum(_enlarged(away, inside, side), source.cell_m / 2.0))
        deviation = np.where(ground & np.isfinite(sigmas), sigmas, np.hypot(source.gsd_m, DEVIATION_SHARE * distance))
        cover = np.where(ground, GROUND, np.where(unblocked(roofs[inside], side), BUILDING, OTHER))
        unit_m = source.height_unit_m
        over = np.maximum(heights - terrain, 0.0)
        return {
            "terrain": (np.where(there, terrain, np.nan) / unit_m).astype(np.float32),
            "over": (np.where(there, over, np.nan) / unit_m).astype(np.float32),
            "confidence": _confidence(distance, deviation, there),
            "cover": np.where(np.isfinite(heights) & there, cover, NOTHING).astype(np.uint8),
        }


def _near_ground(low: Cells, ground: Mask, noise_m: float) -> tuple[Cells, Cells]:
    """Lowest and highest height of ground in and beside each block, with noise; NaN where there is none."""
    around = np.ones((3, 3), np.uint8)
    lowest = cv2.erode(np.where(ground, low, np.inf), around, borderValue=np.inf) - noise_m
    highest = cv2.dilate(np.where(ground, low, -np.inf), around, borderValue=-np.inf) + noise_m
    return np.where(np.isfinite(lowest), lowest, np.nan), np.where(np.isfinite(highest), highest, np.nan)


def _coarse_window(coarse: Cells, window: Tile) -> Float64[np.ndarray, "r c"]:
    row, column = window.row // SHRUNK, window.column // SHRUNK
    return coarse[row : row + -(-window.height // SHRUNK), column : column + -(-window.width // SHRUNK)]


def _enlarged(blocks: Cells, inside: tuple[slice, slice], side: int) -> Float64[np.ndarray, "r c"]:
    """Values of some blocks for their cells, linear between the blocks' middles; bit-identical for any window."""
    rows, columns = inside
    wide = np.pad(blocks, 1, mode="edge")[rows.start : rows.stop + 2, columns.start : columns.stop + 2]
    return _between_rows(_between_rows(wide, side).T, side).T


def _between_rows(values: Cells, side: int) -> Float64[np.ndarray, "r w"]:
    """Rows for the cells of all blocks but the first and the last."""
    off = (np.arange(side) + 0.5) / side - 0.5  # of a cell from its block's middle, blocks
    share = np.abs(off)[:, None]
    beside = np.where(off[:, None] < 0.0, values[:-2, None], values[2:, None])
    between: Cells = values[1:-1, None] * (1.0 - share) + beside * share
    return between.reshape(-1, values.shape[1])


def _distance(known: Mask) -> Cells:
    """Distance of each block to the next that is known, blocks."""
    if not known.any():
        return np.full(known.shape, float(max(known.shape)))
    return np.asarray(distance_transform_edt(~known), np.float64)  # exact: OpenCV's last bits differ from call to call


def _surrounded(top: Cells, block_m: float) -> Mask:
    """Blocks among others with heights, and those of holes that are small and have heights all around."""
    empty = np.pad(np.isnan(top), 1, constant_values=True)
    _, parts, facts, _ = cv2.connectedComponentsWithStats(empty.astype(np.uint8), connectivity=4)
    small = facts[:, cv2.CC_STAT_AREA] * block_m**2 <= MAX_HOLE_M2
    small[[0, parts[0, 0]]] = False  # what has heights, and the outside
    inside = (small[parts] | ~empty).astype(np.uint8)
    return np.asarray(cv2.erode(inside, np.ones((3, 3), np.uint8))[1:-1, 1:-1] > 0)


def _confidence(distance_m: Cells, deviation_m: Cells, there: Mask) -> np.ndarray:
    """Both bands of `dtm_confidence.tif`: (h, w, 2) uint16."""
    bands = [np.ceil(distance_m * CENTIMETRES), np.ceil(deviation_m * MILLIMETRES)]
    stacked = np.stack([np.minimum(np.nan_to_num(band), UNKNOWN - 1) for band in bands], axis=-1)
    return np.where(there[..., None], stacked, UNKNOWN).astype(np.uint16)
