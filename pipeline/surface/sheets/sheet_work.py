"""Compute a raster sheet by sheet: a killed run resumes after its last sheet, and memory holds only one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.mvs.array_file import save_arrays
from splatpipe.pipeline.splat.containers.archives import open_archive
from splatpipe.pipeline.surface.rasters.tiles import Tile
from splatpipe.pipeline.surface.sheets.raster_plane import GridSheet

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class SheetWork:
    """Sheets to compute.

    Attributes:
        grid_sheets: All sheets of a grid.
        wanted: Tells whether a tile of a sheet may have any content.
        area: Cells outside of it stay empty; None for no limit.
        tile: Cells per side of a tile.
        folder: Folder of the finished sheets.
        report: Receives progress.
        what: Name of the product, for progress.
    """

    grid_sheets: Sequence[GridSheet]
    wanted: Callable[[GridSheet, Tile], bool]
    area: PlanArea | None
    tile: int
    folder: Path
    report: Reporter
    what: str

    def run(self, make: Callable[[GridSheet, Sequence[Tile]], Iterator[tuple[Tile, Arrays]]]) -> None:
        """Compute the missing sheets; progress is reported up to the end even if none is missing.

        Args:
            make: Yields the arrays of a sheet's tiles, each of a tile's size; cells outside of the area are set to 0 or
                NaN.
        """
        self.folder.mkdir(exist_ok=True)
        wanted = [
            [tile for tile in grid_sheet.plane.lattice.tiles(self.tile) if self.wanted(grid_sheet, tile)]
            for grid_sheet in self.grid_sheets
        ]
        done, total = 0, sum(len(tiles) for tiles in wanted)
        for number, (grid_sheet, tiles) in enumerate(zip(self.grid_sheets, wanted, strict=True)):
            path = self._path(number)
            if tiles and not path.is_file():
                whole: Arrays = {}
                for tile, arrays in make(grid_sheet, tiles):
                    self._take(whole, grid_sheet, tile, arrays)
                    done += 1
                    self.report.progress(done, total, self.what, "tiles")
                save_arrays(path, **whole)
            else:
                done += len(tiles)
        self.report.progress(max(1, done), max(1, total), self.what, "tiles")

    def finished(self) -> Iterator[tuple[Tile, Arrays]]:
        """The non-empty sheets, with the part of the grid that each covers."""
        for number, grid_sheet in enumerate(self.grid_sheets):
            path = self._path(number)
            if path.is_file():
                with open_archive(path) as kept:
                    yield grid_sheet.part, dict(kept)

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:06d}.npz"

    def _take(self, whole: Arrays, grid_sheet: GridSheet, tile: Tile, arrays: Arrays) -> None:
        outside = None if self.area is None else ~self._inside(self.area, grid_sheet, tile)
        for name, values in arrays.items():
            empty = np.nan if np.issubdtype(values.dtype, np.floating) else 0
            if name not in whole:
                whole[name] = np.full(
                    (grid_sheet.part.height, grid_sheet.part.width, *values.shape[2:]), empty, values.dtype
                )
            if outside is not None:
                values[outside] = empty
            whole[name][tile.row : tile.row + tile.height, tile.column : tile.column + tile.width] = values

    @staticmethod
    def _inside(area: PlanArea, grid_sheet: GridSheet, tile: Tile) -> np.ndarray:
        centres = grid_sheet.plane.lattice.centres(tile)
        places = np.concatenate([centres, np.zeros((*centres.shape[:2], 1))], axis=-1)
        return area.contains(grid_sheet.plane.local_from_plane(places.reshape(-1, 3))).reshape(tile.height, tile.width)
