"""Which photos, and which parts of them, a block trains on: those that see its cell.

By what they see, not by where they are: of a photo straight above a cell only the part that shows it counts, and an
oblique one from far away counts where it shows the cell's walls. Photos that only look through the air over a cell are
not asked: the rest of the scene is drawn, so what a block puts there would be wrong in its own photos, too; and
floaters go by the free space of all photos (`splat.free_space`), whose rays every block knows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.train.blocks.partition import BACKDROP, Partition
from splatpipe.pipeline.train.blocks.sight import Samples, Sight

LEAST_SHARE = 0.02  # of a window's pixels that see the cell: less is a corner of it that its neighbours show whole
LEAST_POINTS = 4  # observed by the photo, in the cell and in the window: thin things that a coarse depth misses

Windows = Int64[np.ndarray, "w 4"]  # left, top, right and bottom of each in the dataset's photo, the last two exclusive


@dataclass(frozen=True, eq=False)
class BlockPhoto:
    """A photo that sees a block's cell.

    Attributes:
        photo: Its row among the sights.
        windows: Which parts of it see the cell.
        pixels: Of those parts.
        seen: Pixels that show the cell, wherever in the photo.
        covered: Those in the chosen parts.
    """

    photo: int
    windows: Bool[np.ndarray, " w"]
    pixels: int
    seen: float
    covered: float


@dataclass(frozen=True)
class BlockViews:
    """What a block trains on.

    Attributes:
        photos: In the sights' order.
    """

    photos: tuple[BlockPhoto, ...]

    @property
    def pixels(self) -> int:
        """Of a visit of each of its windows: a block's work, and what it costs."""
        return sum(photo.pixels for photo in self.photos)

    @property
    def covered(self) -> float:
        """The part of the pixels that show the cell, which lies in its windows; 1 where nothing shows it."""
        seen = sum(photo.seen for photo in self.photos)
        return sum(photo.covered for photo in self.photos) / seen if seen > 0.0 else 1.0


def block_views(
    partition: Partition,
    seen: Sequence[Sight],
    xyz: Float64[np.ndarray, "p 3"],
    windows_of: Callable[[Camera], Windows],
) -> list[BlockViews]:
    """The photos and windows of each block.

    Args:
        partition: The cells.
        seen: What the photos see.
        xyz: All sparse points.
        windows_of: How training cuts a photo at the finest size that it has; they cover it and do not overlap.
    """
    found: list[list[BlockPhoto]] = [[] for _ in partition.cells]
    for number, sight in enumerate(seen):
        windows = windows_of(sight.camera)
        weights = _counted(partition, sight.samples(xyz), windows)
        points = sight.of_points(xyz)
        points = Samples(points.pixels, points.places, np.ones(len(points.places)), points.distances)
        observed = _counted(partition, points, windows)
        sizes = (windows[:, 2] - windows[:, 0]) * (windows[:, 3] - windows[:, 1])
        chosen = (weights >= LEAST_SHARE * sizes) | (observed >= LEAST_POINTS)
        for block in np.flatnonzero(chosen.any(axis=1)).tolist():
            rows = chosen[block]
            covered = float(weights[block, rows].sum())
            photo = BlockPhoto(number, rows, int(sizes[rows].sum()), float(weights[block].sum()), covered)
            found[block].append(photo)
    return [BlockViews(tuple(photos)) for photos in found]


def _counted(partition: Partition, samples: Samples, windows: Windows) -> Float64[np.ndarray, "cells w"]:
    """Weights of the samples of each cell in each window."""
    owners = partition.owners(samples.places)
    inside = _window_of(samples.pixels, windows)
    rows = (owners != BACKDROP) & (inside >= 0)
    flat = owners[rows] * len(windows) + inside[rows]
    size = len(partition.cells) * len(windows)
    return np.bincount(flat, samples.weights[rows], minlength=size).reshape(-1, len(windows))


def _window_of(pixels: Float64[np.ndarray, "n 2"], windows: Windows) -> Int64[np.ndarray, " n"]:
    """The window that each pixel lies in; -1 for none."""
    found = np.full(len(pixels), -1, np.int64)
    for number, (left, top, right, bottom) in enumerate(windows.tolist()):
        x, y = pixels.T
        found[(x >= left) & (x < right) & (y >= top) & (y < bottom)] = number
    return found
