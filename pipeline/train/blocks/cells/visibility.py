"""Which photos, and which parts of them, a block trains on: those that see its cell.

Selection is by what photos see, not where they are: of a nadir photo above a cell only the part that shows it counts,
and a distant oblique photo counts where it shows the cell's walls. Photos that only look through the air above a cell
are not needed: the rest of the scene is rendered, so anything a block puts there would be wrong in its own photos too,
and floaters are pruned by the free space of all photos (`splat.quality.free_space`), which every block knows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.train.blocks.cells.partition import NO_OWNER, Partition
from splatpipe.pipeline.train.blocks.cells.photo_coverage import PhotoCoverage, Samples
from splatpipe.pipeline.train.plan.windows import windows_of

MIN_SHARE = 0.02  # share of a window's pixels that see the cell: less is a corner that neighbouring windows show whole
MIN_POINTS = 4  # observed points in the cell and the window: thin objects that a coarse depth misses

Windows = Int64[np.ndarray, "w 4"]  # left, top, right and bottom of each in the dataset's photo, the last two exclusive


@dataclass(frozen=True, eq=False)
class BlockPhoto:
    """A photo that sees a block's cell.

    Attributes:
        photo: Its index among the coverages.
        windows: Which of its windows see the cell.
        pixels: Number of pixels in those windows.
        seen: Number of pixels that show the cell, anywhere in the photo.
        covered: Number of those in the chosen windows.
    """

    photo: int
    windows: Bool[np.ndarray, " w"]
    pixels: int
    seen: float
    covered: float


@dataclass(frozen=True)
class BlockViews:
    """The photos that a block trains on.

    Attributes:
        photos: In order of the coverages.
    """

    photos: tuple[BlockPhoto, ...]

    @property
    def pixels(self) -> int:
        """Pixels in one visit of each window: the block's work and cost."""
        return sum(photo.pixels for photo in self.photos)

    @property
    def covered(self) -> float:
        """Share of the pixels showing the cell that lie in its windows; 1 if nothing shows it."""
        seen = sum(photo.seen for photo in self.photos)
        return sum(photo.covered for photo in self.photos) / seen if seen > 0.0 else 1.0


def windows(camera: Camera, window_pixels: int) -> Windows:
    """The windows into which training cuts a photo at full size.

    Args:
        camera: The photo's camera, at the finest training size.
        window_pixels: Most pixels of a window; 0 for the whole photo in one.
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
        seen: The photos' coverages.
        xyz: All sparse points.
        cut: Cuts a photo into windows at the finest size (``windows``); they cover it without overlap.
    """
    found: list[list[BlockPhoto]] = [[] for _ in partition.cells]
    for number, coverage in enumerate(seen):
        parts = cut(coverage.camera)
        weights = _sum_weights(partition, coverage.samples(xyz), parts)
        points = coverage.of_points(xyz)
        points = Samples(points.pixels, points.places, np.ones(len(points.places)), points.distances)
        observed = _sum_weights(partition, points, parts)
        sizes = (parts[:, 2] - parts[:, 0]) * (parts[:, 3] - parts[:, 1])
        chosen = (weights >= MIN_SHARE * sizes) | (observed >= MIN_POINTS)
        for block in np.flatnonzero(chosen.any(axis=1)).tolist():
            rows = chosen[block]
            covered = float(weights[block, rows].sum())
            photo = BlockPhoto(number, rows, int(sizes[rows].sum()), float(weights[block].sum()), covered)
            found[block].append(photo)
    return [BlockViews(tuple(photos)) for photos in found]


def _sum_weights(partition: Partition, samples: Samples, parts: Windows) -> Float64[np.ndarray, "cells w"]:
    """Total weight of the samples in each cell and window."""
    owners = partition.owners(samples.places)
    inside = _window_of(samples.pixels, parts)
    rows = (owners != NO_OWNER) & (inside >= 0)
    flat = owners[rows] * len(parts) + inside[rows]
    size = len(partition.cells) * len(parts)
    return np.bincount(flat, samples.weights[rows], minlength=size).reshape(-1, len(parts))


def _window_of(pixels: Float64[np.ndarray, "n 2"], parts: Windows) -> Int64[np.ndarray, " n"]:
    """Index of the window that contains each pixel; -1 for none."""
    found = np.full(len(pixels), -1, np.int64)
    for number, (left, top, right, bottom) in enumerate(parts.tolist()):
        x, y = pixels.T
        found[(x >= left) & (x < right) & (y >= top) & (y < bottom)] = number
    return found
