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
from splatpipe.pipeline.train.blocks.partition import NOBODY, Partition
from splatpipe.pipeline.train.blocks.photo_coverage import PhotoCoverage, Samples
from splatpipe.pipeline.train.windows import windows_of

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


def windows(camera: Camera, window_pixels: int) -> Windows:
    """How training cuts a photo at full size.

    Args:
        camera: The photo's, at the finest size that is trained.
        window_pixels: Of a window at most; 0 for the whole photo in one.
    """
    frames = windows_of(camera.width, camera.height, window_pixels)
    return np.array([[frame.left, frame.top, frame.right, frame.bottom] for frame in frames])


def block_views(
    partition: Partition,
    seen: Sequence[PhotoCoverage],
    xyz: Float64[np.ndarray, "p 3"],
    cut: Callable[[Camera], Windows],
) -> list[BlockViews]:
    """The photos and windows of each block.

    Args:
        partition: The cells.
        seen: What the photos see.
        xyz: All sparse points.
        cut: How training cuts a photo at the finest size (``windows``); the parts cover it and do not overlap.
    """
    found: list[list[BlockPhoto]] = [[] for _ in partition.cells]
    for number, sight in enumerate(seen):
        parts = cut(sight.camera)
        weights = _counted(partition, sight.samples(xyz), parts)
        points = sight.of_points(xyz)
        points = Samples(points.pixels, points.places, np.ones(len(points.places)), points.distances)
        observed = _counted(partition, points, parts)
        sizes = (parts[:, 2] - parts[:, 0]) * (parts[:, 3] - parts[:, 1])
        chosen = (weights >= LEAST_SHARE * sizes) | (observed >= LEAST_POINTS)
        for block in np.flatnonzero(chosen.any(axis=1)).tolist():
            rows = chosen[block]
            covered = float(weights[block, rows].sum())
            photo = BlockPhoto(number, rows, int(sizes[rows].sum()), float(weights[block].sum()), covered)
            found[block].append(photo)
    return [BlockViews(tuple(photos)) for photos in found]


def _counted(partition: Partition, samples: Samples, parts: Windows) -> Float64[np.ndarray, "cells w"]:
    """Weights of the samples of each cell in each window."""
    owners = partition.owners(samples.places)
    inside = _window_of(samples.pixels, parts)
    rows = (owners != NOBODY) & (inside >= 0)
    flat = owners[rows] * len(parts) + inside[rows]
    size = len(partition.cells) * len(parts)
    return np.bincount(flat, samples.weights[rows], minlength=size).reshape(-1, len(parts))


def _window_of(pixels: Float64[np.ndarray, "n 2"], parts: Windows) -> Int64[np.ndarray, " n"]:
    """The window that each pixel lies in; -1 for none."""
    found = np.full(len(pixels), -1, np.int64)
    for number, (left, top, right, bottom) in enumerate(parts.tolist()):
        x, y = pixels.T
        found[(x >= left) & (x < right) & (y >= top) & (y < bottom)] = number
    return found
