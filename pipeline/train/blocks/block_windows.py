"""The windows of photos that each block trains on, and what follows from them: iterations, steps and disk space."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.engine.stage import Machine
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.photos.pixels.images import Mask, load_mask, reduced_camera, reduced_mask
from splatpipe.pipeline.raster.device import Device, choose_device
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render.rendering import load_rendering, render_depth
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.blocks.cells.partition import Partition
from splatpipe.pipeline.train.blocks.cells.photo_coverage import PhotoCoverage, photo_coverages
from splatpipe.pipeline.train.blocks.cells.visibility import Windows, block_views
from splatpipe.pipeline.train.blocks.lengths import finer_lengths
from splatpipe.pipeline.train.blocks.schedules import block_schedule
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.photo_cache import stored_bytes
from splatpipe.pipeline.train.plan.lengths import PhotoSizes
from splatpipe.pipeline.train.plan.plan import footage_of, sizes_of
from splatpipe.pipeline.train.plan.windows import PixelRectangle, windows_of


@dataclass(frozen=True)
class WindowScheme:
    """How photos are cut into windows at the sizes that blocks train.

    Attributes:
        levels: Number of times photos are halved, first size first.
        window_pixels: Most pixels of a window; 0 for whole photos.
        max_megapixels: Photos are first reduced to this size; None: they are as the dataset has them.
    """

    levels: tuple[int, ...]
    window_pixels: int
    max_megapixels: float | None

    @staticmethod
    def of(config: TrainConfig, footage: PhotoSizes, max_megapixels: float | None) -> WindowScheme:
        """The window scheme of a training's blocks.

        Args:
            config: The training options.
            footage: All photos.
            max_megapixels: Size that they are reduced to.
        """
        levels = tuple(level for level, _count in finer_lengths(config, footage))
        return WindowScheme(levels, footage.window_pixels, max_megapixels)

    def camera(self, camera: Camera, level: int) -> Camera:
        """A photo's camera at a level."""
        return reduced_camera(camera, self.max_megapixels, level)

    def frames(self, camera: Camera, level: int) -> list[PixelRectangle]:
        """The windows of a photo at a level, in its pixels there."""
        reduced = self.camera(camera, level)
        return windows_of(reduced.width, reduced.height, self.window_pixels)

    def windows(self, camera: Camera, level: int) -> Windows:
        """The same in the dataset's pixels."""
        reduced = self.camera(camera, level)
        scale = np.array([camera.width / reduced.width, camera.height / reduced.height] * 2)
        sides = [[frame.left, frame.top, frame.right, frame.bottom] for frame in self.frames(camera, level)]
        return np.asarray(np.rint(np.array(sides) * scale), np.int64)


Parts = dict[int, Int64[np.ndarray, "k 2"]]
"""By level: pairs of a photo's row and the index of one of its windows."""


@dataclass(frozen=True, eq=False)
class BlockWindows:
    """What a block trains on.

    Attributes:
        windows: The windows that it trains on; rows are those of the photos.
        photos: Number of its photos.
        iterations: Number of iterations in its plan.
        steps: Number of density-control steps among them.
        disk_bytes: Maximum disk space of decoded photos during training.
    """

    windows: Parts
    photos: int
    iterations: int
    steps: int
    disk_bytes: int


def visible_windows(
    partition: Partition, coverage: PhotoCoverage, xyz: Float64[np.ndarray, "p 3"], cut: WindowScheme
) -> dict[int, Bool[np.ndarray, "cells w"]]:
    """Which windows of a photo show each cell, by level.

    Args:
        partition: The cells.
        coverage: The photo's coverage.
        xyz: All sparse points.
        cut: How it is cut into windows.
    """
    found = {}
    for level in cut.levels:
        windows = cut.windows(coverage.camera, level)
        visible = np.zeros((len(partition.cells), len(windows)), np.bool_)
        for block, views in enumerate(block_views(partition, [coverage], xyz, lambda _, cut=windows: cut)):  # type: ignore[misc]
            for photo in views.photos:
                visible[block] = photo.windows
        found[level] = visible
    return found


def parts_of(visible: Iterable[Mapping[int, Bool[np.ndarray, "cells w"]]], block: int) -> Parts:
    """The windows that a block trains on.

    Args:
        visible: For each photo, the result of ``visible_windows``.
        block: The block's number.
    """
    found: dict[int, list[tuple[int, int]]] = {}
    for row, by_level in enumerate(visible):
        for level, cells in by_level.items():
            found.setdefault(level, []).extend((row, int(window)) for window in np.flatnonzero(cells[block]))
    return {level: np.array(pairs, np.int64).reshape(-1, 2) for level, pairs in found.items()}


def block_windows(
    config: TrainConfig,
    views: Sequence[View],
    seen: Sequence[PhotoCoverage],
    xyz: Float64[np.ndarray, "p 3"],
    partition: Partition,
    window_pixels: int,
) -> list[BlockWindows]:
    """What each block trains on.

    Args:
        config: The training options.
        views: The training photos.
        seen: Their coverages, in the same order.
        xyz: All sparse points.
        partition: The cells.
        window_pixels: Most pixels of a photo that an iteration uses.
    """
    footage, most = footage_on(config, [view.camera for view in views], window_pixels)
    cut = WindowScheme.of(config, footage, most)
    visible = [visible_windows(partition, coverage, xyz, cut) for coverage in seen]
    return [_of_block(config, footage, cut, views, parts_of(visible, block)) for block in range(len(partition.cells))]


def footage_on(config: TrainConfig, cameras: Sequence[Camera], window_pixels: int) -> tuple[PhotoSizes, float | None]:
    """Photos at their training sizes, and the megapixels that they are reduced to; None if they are not reduced."""
    sizes = sizes_of(cameras)
    most = config.max_megapixels or None
    if most is not None and max(width * height for width, height, _count in sizes) <= 1e6 * most:
        most = None
    return footage_of(sizes, most, window_pixels), most


def _of_block(
    config: TrainConfig, footage: PhotoSizes, cut: WindowScheme, views: Sequence[View], windows: Parts
) -> BlockWindows:
    used = {level: [views[row] for row in np.unique(pairs[:, 0]).tolist()] for level, pairs in windows.items()}
    rows = {row for pairs in windows.values() for row in pairs[:, 0].tolist()}
    if not rows:
        return BlockWindows(windows, 0, 0, 0, 0)
    seen = footage_of(sizes_of([views[row].camera for row in rows]), cut.max_megapixels, cut.window_pixels)
    counts = {level: len(pairs) for level, pairs in windows.items()}
    schedule = block_schedule(config, footage, seen, counts, 1.0)
    density = schedule.density
    steps = sum(density.is_step(iteration) for iteration in range(density.first, density.last + 1))
    stored = sum(
        stored_bytes(cut.camera(view.camera, level), view.mask_path is not None)
        for level, views_there in used.items()
        for view in views_there
    )
    return BlockWindows(windows, len(rows), schedule.iterations, steps, stored)


def coarse_coverages(
    coarse: Path, views: Sequence[View], observed: Sequence[Int64[np.ndarray, " _"]], machine: Machine
) -> list[PhotoCoverage]:
    """The photos' coverages by the depth of a coarse model; 40 kB per photo.

    Args:
        coarse: Output folder of the coarse pass.
        views: The photos.
        observed: Rows of the sparse points that each observes.
        machine: The machine that renders the depths.

    Raises:
        SplatpipeError: if a file is missing or broken.
        MachineError: if the requested device is not available.
    """
    device = choose_device(machine.device)
    with same_bits(machine.threads), device.deterministic():
        return list(iterate_coverages(coarse, read_splat(coarse / "model.ply"), views, observed, device))


def iterate_coverages(
    coarse: Path,
    gaussians: Gaussians,
    views: Sequence[View],
    observed: Sequence[Int64[np.ndarray, " _"]],
    device: Device,
) -> Iterator[PhotoCoverage]:
    """The same, one by one, for callers that already ensure determinism; ``gaussians`` are the coarse model."""
    options = load_rendering(coarse / "rendering.json").options(gaussians)
    drawn = gaussians.to(device.tensors)
    for view, rows in zip(views, observed, strict=True):
        mask_at = partial(_grid_mask, view)
        yield from photo_coverages([view.camera], [rows], lambda camera: render_depth(drawn, camera, options), mask_at)


def _grid_mask(view: View, grid: Camera) -> Mask | None:
    """Which pixels of a photo's grid count by its mask; None if all do."""
    mask = load_mask(view)
    return None if mask is None else reduced_mask(mask, (grid.width, grid.height))
