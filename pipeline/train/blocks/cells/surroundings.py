"""The parts of a coarse model that a block trains, and those that it renders frozen around them.

A block trains the Gaussians in its cell and margin. Its photos see others in front of and behind them: these are
rendered frozen, so that nothing in the block has to stand in for them. Those that no window of the block sees are left
out; the others are thinned, more with distance from the cell, until they fit in memory.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64

from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.blocks.cells.partition import Partition
from splatpipe.pipeline.train.blocks.cells.photo_coverage import PhotoCoverage
from splatpipe.pipeline.train.blocks.cells.thinning import thinned
from splatpipe.pipeline.train.blocks.cells.visibility import BlockViews, Windows

SIGMAS = 3.0  # reach of a Gaussian in standard deviations, as in the rasterizer's radii
# times the depth of the coarse surface: farther back is hidden, allowing for errors of that depth
MAX_DEPTH_RATIO = 1.1
VOXEL_GROWTH = math.sqrt(2.0)  # growth of voxels per attempt; each one's size is a power of two, so not all change
MAX_VOXEL_PX = 64.0  # pixels of a voxel at the cell's edge: beyond it the least opaque are dropped instead


@dataclass(frozen=True, eq=False)
class BlockSurroundings:
    """The Gaussians of a coarse model that a block's windows see besides those that the block trains.

    Attributes:
        rows: Rows of the model, ascending.
        units: Smallest voxel side for each, world units: the GSD there, increasing away from the cell.
    """

    rows: Int64[np.ndarray, " k"]
    units: Float64[np.ndarray, " k"]

    def within(self, coarse: Gaussians, most: int) -> Gaussians:
        """At most ``most`` Gaussians: merged by voxels of growing size, then by dropping the least opaque."""
        return _within(coarse.select(torch.from_numpy(self.rows)), self.units, most)


def visible_around(
    partition: Partition,
    block: int,
    coarse: Gaussians,
    view: tuple[BlockViews, Sequence[PhotoCoverage], Sequence[Windows]],
) -> BlockSurroundings:
    """The Gaussians that a block's windows see around it.

    Args:
        partition: The cells.
        block: The block's number.
        coarse: The model of the whole scene, on the CPU.
        view: The block's views; all photos' coverages, with depths; the windows of each of those photos.
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
    """At most ``most`` Gaussians: merged by voxels of growing size, then by dropping the least opaque."""
    found, side = gaussians, 1.0
    while len(found) > most and side <= MAX_VOXEL_PX:
        found = thinned(gaussians, side * unit)
        side *= VOXEL_GROWTH
    if len(found) > most:
        order = torch.argsort(found.opacity_logits, descending=True, stable=True)[:most]
        found = found.select(torch.sort(order).values)
    return found


def _seen_in(
    gaussians: Gaussians, means: Float64[np.ndarray, "n 3"], coverage: PhotoCoverage, windows: Windows
) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """The Gaussians that reach into windows of a photo and are not behind its surface, and the GSD at each."""
    camera = coverage.camera
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
    if coverage.depth is not None:
        into &= ~_hidden(coverage, coverage.depth, pixels, (depths, reach, radius))
    return rows[into], depths[into] / focal


def _hidden(
    coverage: PhotoCoverage,
    depth: Float32[np.ndarray, "h w"],
    pixels: Float64[np.ndarray, "n 2"],
    size: tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]],
) -> Bool[np.ndarray, " n"]:
    """Which Gaussians lie behind all of the surface around their centre; those larger than that neighbourhood never do.

    Args:
        coverage: The photo's coverage.
        depth: Its depth.
        pixels: Positions of the Gaussians in the dataset's photo.
        size: Their depths, and their reach in world units and in pixels.
    """
    depths, reach, radius = size
    surface = np.where((depth > 0.0) & np.isfinite(depth), depth, np.inf).astype(np.float32)
    farthest = cv2.dilate(surface, np.ones((3, 3), np.uint8))
    step = coverage.camera.width / coverage.grid.width
    places = np.clip(pixels / step, 0.0, [coverage.grid.width - 1, coverage.grid.height - 1])
    columns, rows = np.nan_to_num(places).astype(np.int64).T
    return np.asarray((depths - reach > MAX_DEPTH_RATIO * farthest[rows, columns]) & (radius < step))
