"""Cells that divide a whole photo, and what a window shows of them; on the device of the pictures, nothing waits."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn import functional

from splatpipe.pipeline.geometry.camera import Camera

LEAST_SHOWN = 0.25  # of a cell that is judged in a window: where four windows meet, one of them shows as much


@dataclass(frozen=True)
class PhotoCells:
    """A grid over the whole photo.

    Attributes:
        camera: Of the photo, or of a window of it.
        rows: Of cells.
        columns: Of cells.
    """

    camera: Camera
    rows: int
    columns: int

    def means(self, planes: Float[Tensor, "c h w"]) -> Float[Tensor, "c rows columns"]:
        """Each cell's means over what is shown of it; zero where nothing is."""
        if self.camera.window is None:
            return functional.adaptive_avg_pool2d(planes[None], (self.rows, self.columns))[0]
        down, across = self._members(planes)
        number = down.sum(dim=1)[:, None] * across.sum(dim=1)
        return (down @ planes @ across.T) / number.clamp(min=1.0)

    def judged(self, like: Tensor) -> Bool[Tensor, "rows columns"] | None:
        """The cells of which enough is shown; None where that is all of them."""
        if self.camera.window is None:
            return None
        down, across = self._members(like)
        whole = self.camera.whole()
        tall = _belongs(0, whole.height, whole.height, self.rows, like).sum(dim=1)
        wide = _belongs(0, whole.width, whole.width, self.columns, like).sum(dim=1)
        shown = (down.sum(dim=1) / tall)[:, None] * (across.sum(dim=1) / wide)
        return shown >= LEAST_SHOWN

    def spread(self, cells: Bool[Tensor, "rows columns"]) -> Bool[Tensor, "h w"]:
        """For each pixel what its cell has."""
        camera, part = self.camera, self.camera.window
        if part is None:
            size = (camera.height, camera.width)
            return functional.interpolate(cells[None, None].float(), size=size, mode="nearest")[0, 0] > 0.0
        rows = _nearest(part.top, camera.height, part.whole_height, self.rows, cells.device)
        columns = _nearest(part.left, camera.width, part.whole_width, self.columns, cells.device)
        return cells[rows][:, columns]

    def _members(self, like: Tensor) -> tuple[Float[Tensor, "rows h"], Float[Tensor, "columns w"]]:
        """1 where a row or a column of the window belongs to a row or a column of cells."""
        part = self.camera.window
        assert part is not None
        return (
            _belongs(part.top, self.camera.height, part.whole_height, self.rows, like),
            _belongs(part.left, self.camera.width, part.whole_width, self.columns, like),
        )


def _belongs(first: int, count: int, size: int, cells: int, like: Tensor) -> Float[Tensor, "cells count"]:
    """1 where a pixel along a side belongs to a cell: as torch's adaptive pooling divides it, overlaps and all."""
    number = torch.arange(cells, device=like.device)[:, None]
    begin = number * size // cells
    end = -(-(number + 1) * size // cells)
    pixel = torch.arange(first, first + count, device=like.device)
    return ((pixel >= begin) & (pixel < end)).to(like.dtype)


def _nearest(first: int, count: int, size: int, cells: int, device: torch.device) -> Int64[Tensor, " count"]:
    """The cells of some pixels along a side: as torch's nearest interpolation finds them, in float32."""
    pixel = torch.arange(first, first + count, dtype=torch.float32, device=device)
    return (pixel * (cells / size)).floor().long().clamp(max=cells - 1)
