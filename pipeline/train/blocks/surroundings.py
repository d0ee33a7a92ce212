"""What of a coarse model a block trains, and what it draws around it and leaves as it is.

A block trains the Gaussians in its cell and margin. Before and behind them its photos see others: these are drawn
frozen, so that nothing in the block has to stand for them. Those that no window of the block sees are left out, and the
others are thinned the farther they are from the cell, until they are as many as memory is to hold.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64

from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.train.blocks.partition import Partition
from splatpipe.pipeline.train.blocks.photo_coverage import PhotoCoverage
from splatpipe.pipeline.train.blocks.thinning import thinned
from splatpipe.pipeline.train.blocks.visibility import BlockViews, Windows

SIGMAS = 3.0  # of a Gaussian count as its reach, as in the rasterizer's radii
BEHIND = 1.1  # times the depth of the coarse surface: farther back is hidden, allowing for what that has wrong
COARSER = math.sqrt(2.0)  # voxels from one try to the next; each Gaussian's is a power of two, so not all change
COARSEST = 64.0  # pixels of a voxel at the cell's edge: beyond it the least opaque are dropped instead


@dataclass(frozen=True, eq=False)
class BlockSurroundings:
    """What a block's windows see of a coarse model besides the Gaussians that the block trains.

    Attributes:
        rows: Of the model, ascending.
        units: Of each a voxel's least side, world units: the size of a pixel there, more away from the cell.
    """

    rows: Int64[np.ndarray, " k"]
    units: Float64[np.ndarray, " k"]

    def within(self, coarse: Gaussians, most: int) -> Gaussians:
        """At most so many: those of a voxel of some times their unit become one; if need be, the least opaque go."""
        return _within(coarse.select(torch.from_numpy(self.rows)), self.units, most)


def visible_around(
    partition: Partition,
    block: int,
    coarse: Gaussians,
    view: tuple[BlockViews, Sequence[PhotoCoverage], Sequence[Windows]],
) -> BlockSurroundings:
    """What a block's windows see around it.

    Args:
        partition: The cells.
        block: Which.
        coarse: The model of the whole, on the CPU.
        view: What the block trains on; what all photos see, with depths; how each of those photos is cut.
    """
    views, seen, windows = view
    means = coarse.means.detach().double().numpy()
    pixel = np.full(len(coarse), math.inf)
    for photo in views.photos:
        rows, sizes = _seen_in(coarse, means, seen[photo.photo], windows[photo.photo][photo.windows])
        pixel[rows] = np.minimum(pixel[rows], sizes)
    rows = np.flatnonzero(~partition.trained_by(block, means) & np.isfinite(pixel))
    cell = partition.cells[block].grown(partition.margin)
    away = cell.distance(partition.plan.places(means[rows])) / math.sqrt(cell.area)
    return BlockSurroundings(rows, pixel[rows] * (1.0 + away))


def _within(gaussians: Gaussians, unit: Float64[np.ndarray, " n"], most: int) -> Gaussians:
    """At most so many: those of a voxel of some times their unit become one; if need be, the least opaque go."""
    found, side = gaussians, 1.0
    while len(found) > most and side <= COARSEST:
        found = thinned(gaussians, side * unit)
        side *= COARSER
    if len(found) > most:
        order = torch.argsort(found.opacity_logits, descending=True, stable=True)[:most]
        found = found.select(torch.sort(order).values)
    return found


def _seen_in(
    gaussians: Gaussians, means: Float64[np.ndarray, "n 3"], sight: PhotoCoverage, windows: Windows
) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """The Gaussians that reach into windows of a photo and are not behind its surface; a pixel's size at each."""
    camera = sight.camera
    depths = camera.depths(means)
    rows = np.flatnonzero((depths > 0.0) & np.isfinite(depths))
    pixels, depths = camera.project(means[rows]), depths[rows]
    focal = math.sqrt(camera.fx * camera.fy)
    reach = SIGMAS * np.exp(gaussians.log_scales.detach().double().numpy()[rows].max(axis=1))
    radius = reach * focal / depths
    into = np.zeros(len(rows), np.bool_)
    for left, top, right, bottom in windows.tolist():
        x, y = pixels.T
        into |= (x > left - radius) & (x < right + radius) & (y > top - radius) & (y < bottom + radius)
    if sight.depth is not None:
        into &= ~_hidden(sight, sight.depth, pixels, (depths, reach, radius))
    return rows[into], depths[into] / focal


def _hidden(
    sight: PhotoCoverage,
    depth: Float32[np.ndarray, "h w"],
    pixels: Float64[np.ndarray, "n 2"],
    size: tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]],
) -> Bool[np.ndarray, " n"]:
    """Which lie behind all of the surface around their centre; those larger than that neighbourhood never do.

    Args:
        sight: What the photo sees.
        depth: Its depth.
        pixels: Where the Gaussians are in the dataset's photo.
        size: Their depths, their reach in world units, and in pixels.
    """
    depths, reach, radius = size
    surface = np.where((depth > 0.0) & np.isfinite(depth), depth, np.inf).astype(np.float32)
    farthest = cv2.dilate(surface, np.ones((3, 3), np.uint8))
    step = sight.camera.width / sight.grid.width
    places = np.clip(pixels / step, 0.0, [sight.grid.width - 1, sight.grid.height - 1])
    columns, rows = np.nan_to_num(places).astype(np.int64).T
    return np.asarray((depths - reach > BEHIND * farthest[rows, columns]) & (radius < step))
