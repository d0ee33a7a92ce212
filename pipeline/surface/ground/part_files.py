"""Finished parts of a site on its blocks, a file each, from which windows are put together; a killed run keeps them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.mvs.array_file import save_arrays
from splatpipe.pipeline.splat.containers.archives import open_archive
from splatpipe.pipeline.surface.rasters.tiles import Tile

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class PartFiles:
    """Arrays of all parts of one step.

    Attributes:
        folder: Where they are.
        name: Of the step, with which the files' names begin.
        parts: The parts, in order.
    """

    folder: Path
    name: str
    parts: list[Tile]

    def compute(self, make: Callable[[Tile], Arrays], threads: int) -> Iterator[int]:
        """Compute the missing parts, several at a time; yields how many are done.

        Args:
            make: Returns a part's arrays.
            threads: Parts in parallel.
        """
        self.folder.mkdir(exist_ok=True)
        yield from ordered_map(partial(self._make, make), range(len(self.parts)), threads)

    def load(self, number: int, *names: str) -> Arrays:
        """Some arrays of a part."""
        with open_archive(self._path(number)) as kept:
            return {name: kept[name] for name in names}

    def window(self, window: Tile, name: str) -> Float64[np.ndarray, "r c"]:
        """An array over a window, put together; NaN where no part is."""
        found = np.full((window.height, window.width), np.nan)
        for number, part in enumerate(self.parts):
            top, left = max(part.row, window.row), max(part.column, window.column)
            bottom = min(part.row + part.height, window.row + window.height)
            right = min(part.column + part.width, window.column + window.width)
            if top < bottom and left < right:
                with open_archive(self._path(number)) as kept:
                    values = kept[name]
                rows, columns = slice(top - part.row, bottom - part.row), slice(left - part.column, right - part.column)
                found[top - window.row : bottom - window.row, left - window.column : right - window.column] = values[
                    rows, columns
                ]
        return found

    def _make(self, make: Callable[[Tile], Arrays], number: int) -> int:
        path = self._path(number)
        if not path.is_file():
            save_arrays(path, **make(self.parts[number]))
        return number + 1

    def _path(self, number: int) -> Path:
        return self.folder / f"{self.name}-{number:06d}.npz"
