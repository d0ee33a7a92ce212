"""A grid of cells over a whole photo, and the part of it in a window; computed without synchronizing the device."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn import functional

from splatpipe.pipeline.geometry.camera import Camera

# visible share by which a window judges a cell: where four windows meet, at least one has as much
MIN_VISIBLE_SHARE = 0.25


@dataclass(frozen=True)
class PhotoCells:
    """A grid over the whole photo.

    Attributes:
        camera: Camera of the photo, or of a window of it.
        rows: Rows of cells.
        columns: Columns of cells.
    """

    camera: Camera
    rows: int
    columns: int

    def means(self, planes: Float[Tensor, "c h w"]) -> Float[Tensor, "c rows columns"]:
        """Each cell's means over its visible part; zero for cells not shown."""
        if self.camera.window is None:
            return functional.adaptive_avg_pool2d(planes[None], (self.rows, self.columns))[0]
        (rows, down), (columns, across) = self._sides(planes)
        found = planes.new_zeros(len(planes), self.rows, self.columns)
        number = down.sum(dim=1)[:, None] * across.sum(dim=1)
        found[:, rows, columns] = (down @ planes @ across.T) / number.clamp(min=1.0)
        return found

    def judged(self, like: Tensor) -> Bool[Tensor, "rows columns"] | None:
        """The cells of which enough is shown; None if that is all of them."""
        if self.camera.window is None:
            return None
        whole, found = self.camera.uncropped(), like.new_zeros(self.rows, self.columns)
        (rows, down), (columns, across) = self._sides(like)
        tall = _belongs(range(whole.height), whole.height, self.rows, like).sum(dim=1)[rows]
        wide = _belongs(range(whole.width), whole.width, self.columns, like).sum(dim=1)[columns]
        found[rows, columns] = (down.sum(dim=1) / tall)[:, None] * (across.sum(dim=1) / wide)
        return found >= MIN_VISIBLE_SHARE

    def spread(self, cells: Bool[Tensor, "rows columns"]) -> Bool[Tensor, "h w"]:
        """Each pixel's cell value."""
        camera, part = self.camera, self.camera.window
        if part is None:
            size = (camera.height, camera.width)
            return functional.interpolate(cells[None, None].float(), size=size, mode="nearest")[0, 0] > 0.0
        rows = _nearest(part.top, camera.height, part.whole_height, self.rows, cells.device)
        columns = _nearest(part.left, camera.width, part.whole_width, self.columns, cells.device)
        return cells[rows][:, columns]

    def _sides(self, like: Tensor) -> tuple[tuple[slice, Tensor], tuple[slice, Tensor]]:
        """The rows of cells that the window touches, and which of its rows belong to each; the same for columns."""
        camera, part = self.camera, self.camera.window
        assert part is not None
        return (
            _touched(range(part.top, part.top + camera.height), part.whole_height, self.rows, like),
            _touched(range(part.left, part.left + camera.width), part.whole_width, self.columns, like),
        )


def _touched(pixels: range, size: int, cells: int, like: Tensor) -> tuple[slice, Float[Tensor, "touched count"]]:
    """The cells that pixels along a side belong to, and which pixels belong to each; extra empty cells do no harm."""
    first, last = pixels.start * cells // size, (pixels.stop - 1) * cells // size
    numbers = slice(max(0, first - 1), min(cells, last + 2))
    return numbers, _belongs(pixels, size, cells, like)[numbers]


def _belongs(pixels: range, size: int, cells: int, like: Tensor) -> Float[Tensor, "cells count"]:
    """1 where a pixel along a side belongs to a cell: as in torch's adaptive pooling, including overlaps."""
    number = torch.arange(cells, device=like.device)[:, None]
    begin = number * size // cells
    end = -(-(number + 1) * size // cells)
    pixel = torch.arange(pixels.start, pixels.stop, device=like.device)
    return ((pixel >= begin) & (pixel < end)).to(like.dtype)


def _nearest(first: int, count: int, size: int, cells: int, device: torch.device) -> Int64[Tensor, " count"]:
    """The cells of pixels along a side, as torch's nearest interpolation computes them in float32."""
    pixel = torch.arange(first, first + count, dtype=torch.float32, device=device)
    return (pixel * (cells / size)).floor().long().clamp(max=cells - 1)
