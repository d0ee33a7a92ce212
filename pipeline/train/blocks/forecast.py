"""Which windows of which photos each block trains on at each size, and what that takes, told without training any."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.engine.stage import Machine
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.dataset import View
from splatpipe.pipeline.photos.images import Mask, load_mask, reduced_camera, reduced_mask
from splatpipe.pipeline.raster.device import Device, choose_device
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render.rendering import load_rendering, render_depth
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.ply import read_splat
from splatpipe.pipeline.train.blocks.lengths import finer_lengths
from splatpipe.pipeline.train.blocks.partition import Partition
from splatpipe.pipeline.train.blocks.photo_coverage import PhotoCoverage, sights
from splatpipe.pipeline.train.blocks.schedules import block_lengths, block_schedule
from splatpipe.pipeline.train.blocks.visibility import Windows, block_views
from splatpipe.pipeline.train.lengths import PhotoSizes
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photo_cache import stored_bytes
from splatpipe.pipeline.train.plan import footage_of, sizes_of
from splatpipe.pipeline.train.windows import PixelRectangle, windows_of


@dataclass(frozen=True)
class WindowScheme:
    """How photos are cut into windows at the sizes that blocks train.

    Attributes:
        levels: How often photos are halved, the first size first.
        window_pixels: Of a window at most; 0 for whole photos.
        max_megapixels: Photos are first reduced to this size; None: they are as the dataset has them.
    """

    levels: tuple[int, ...]
    window_pixels: int
    max_megapixels: float | None

    @staticmethod
    def of(config: TrainConfig, footage: PhotoSizes, max_megapixels: float | None) -> WindowScheme:
        """That of a training's blocks.

        Args:
            config: The training options.
            footage: All photos.
            max_megapixels: That they are reduced to.
        """
        levels = tuple(level for level, _count in finer_lengths(config, footage))
        return WindowScheme(levels, footage.window_pixels, max_megapixels)

    def camera(self, camera: Camera, level: int) -> Camera:
        """A photo's at a level."""
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
"""By the level, each a photo's row and the number of one of its windows."""


@dataclass(frozen=True, eq=False)
class BlockForecast:
    """What a block will do.

    Attributes:
        windows: That it trains on; their rows are those of the photos.
        photos: That it sees.
        parts: Windows that it trains on at each of its sizes, the first size first.
        pixels: Of all of them, at that size.
        iterations: Of its plan.
        steps: Of density control in them.
        disk_bytes: Of decoded photos while it trains, at most.
    """

    windows: Parts
    photos: int
    parts: tuple[int, ...]
    pixels: tuple[int, ...]
    iterations: int
    steps: int
    disk_bytes: int


def visible_windows(
    partition: Partition, sight: PhotoCoverage, xyz: Float64[np.ndarray, "p 3"], cut: WindowScheme
) -> dict[int, Bool[np.ndarray, "cells w"]]:
    """By the level, which windows of a photo show each cell.

    Args:
        partition: The cells.
        sight: What the photo sees.
        xyz: All sparse points.
        cut: How it is cut.
    """
    found = {}
    for level in cut.levels:
        windows = cut.windows(sight.camera, level)
        shown = np.zeros((len(partition.cells), len(windows)), np.bool_)
        for block, views in enumerate(block_views(partition, [sight], xyz, lambda _, cut=windows: cut)):  # type: ignore[misc]
            for photo in views.photos:
                shown[block] = photo.windows
        found[level] = shown
    return found


def parts_of(shown: Iterable[Mapping[int, Bool[np.ndarray, "cells w"]]], block: int) -> Parts:
    """The windows that a block trains on.

    Args:
        shown: Of each photo, as of ``visible_windows``.
        block: Its number.
    """
    found: dict[int, list[tuple[int, int]]] = {}
    for row, by_level in enumerate(shown):
        for level, cells in by_level.items():
            found.setdefault(level, []).extend((row, int(window)) for window in np.flatnonzero(cells[block]))
    return {level: np.array(pairs, np.int64).reshape(-1, 2) for level, pairs in found.items()}


def block_outlooks(
    config: TrainConfig,
    views: Sequence[View],
    seen: Sequence[PhotoCoverage],
    xyz: Float64[np.ndarray, "p 3"],
    partition: Partition,
    window_pixels: int,
) -> list[BlockForecast]:
    """What each block will do.

    Args:
        config: The options of the training.
        views: Photos trained on.
        seen: What they see, in their order.
        xyz: All sparse points.
        partition: The cells.
        window_pixels: Most pixels of a photo that an iteration uses.
    """
    footage, most = footage_on(config, [view.camera for view in views], window_pixels)
    cut = WindowScheme.of(config, footage, most)
    shown = [visible_windows(partition, sight, xyz, cut) for sight in seen]
    return [_outlook(config, footage, cut, views, parts_of(shown, block)) for block in range(len(partition.cells))]


def footage_on(config: TrainConfig, cameras: Sequence[Camera], window_pixels: int) -> tuple[PhotoSizes, float | None]:
    """Photos as they are trained on, and the megapixels that they are reduced to; None where they are as they are."""
    sizes = sizes_of(cameras)
    most = config.max_megapixels or None
    if most is not None and max(width * height for width, height, _count in sizes) <= 1e6 * most:
        most = None
    return footage_of(sizes, most, window_pixels), most


def _outlook(
    config: TrainConfig, footage: PhotoSizes, cut: WindowScheme, views: Sequence[View], parts: Parts
) -> BlockForecast:
    each = block_lengths(config, footage, {level: len(pairs) for level, pairs in parts.items()})
    pixels, stored = [], 0
    for level, _count in each:
        pairs = parts[level]
        pixels.append(sum(cut.frames(views[row].camera, level)[window].pixels for row, window in pairs.tolist()))
    rows = sorted({row for pairs in parts.values() for row in pairs[:, 0].tolist()})
    for level, pairs in parts.items():
        for row in np.unique(pairs[:, 0]).tolist():
            stored += stored_bytes(cut.camera(views[row].camera, level), views[row].mask_path is not None)
    counts = tuple(len(parts[level]) for level, _count in each)
    iterations = sum(count for _level, count in each)
    return BlockForecast(
        parts, len(rows), counts, tuple(pixels), iterations, _steps(config, footage, cut, views, parts), stored
    )


def _steps(config: TrainConfig, footage: PhotoSizes, cut: WindowScheme, views: Sequence[View], parts: Parts) -> int:
    """Steps of density control of a block."""
    pieces = {level: len(pairs) for level, pairs in parts.items()}
    rows = {row for pairs in parts.values() for row in pairs[:, 0].tolist()}
    if not rows:
        return 0
    seen = footage_of(sizes_of([views[row].camera for row in rows]), cut.max_megapixels, cut.window_pixels)
    density = block_schedule(config, footage, seen, pieces, 1.0).density
    return sum(density.is_step(iteration) for iteration in range(density.first, density.last + 1))


def coarse_sights(
    coarse: Path, views: Sequence[View], observed: Sequence[Int64[np.ndarray, " _"]], machine: Machine
) -> list[PhotoCoverage]:
    """What photos see by the depth of a coarse model; 40 kB a photo.

    Args:
        coarse: The folder that the coarse pass left.
        views: The photos.
        observed: Rows of the sparse points that each observes.
        machine: Renders it.

    Raises:
        SplatpipeError: if a file is missing or broken.
        MachineError: if the requested device is not available.
    """
    device = choose_device(machine.device)
    with same_bits(machine.threads), device.one_order():
        return list(each_sight(coarse, read_splat(coarse / "model.ply"), views, observed, device))


def each_sight(
    coarse: Path,
    gaussians: Gaussians,
    views: Sequence[View],
    observed: Sequence[Int64[np.ndarray, " _"]],
    device: Device,
) -> Iterator[PhotoCoverage]:
    """The same one after the other, where the bits are seen to; ``gaussians`` are the coarse model's."""
    options = load_rendering(coarse / "rendering.json").options(gaussians)
    drawn = gaussians.to(device.tensors)
    for view, rows in zip(views, observed, strict=True):
        counted = partial(_counted, view)
        yield from sights([view.camera], [rows], lambda camera: render_depth(drawn, camera, options), counted)


def _counted(view: View, grid: Camera) -> Mask | None:
    """Which pixels of a photo's grid its mask counts."""
    mask = load_mask(view)
    return None if mask is None else reduced_mask(mask, (grid.width, grid.height))
