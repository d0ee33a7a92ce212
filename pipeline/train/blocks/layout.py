"""The layout of a site: its cells and the limits of each block, from a coarse model of the whole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.stage import JSON, Inputs, Reporter
from splatpipe.pipeline.geometry.ground_plan import GroundPlan
from splatpipe.pipeline.geometry.plan_area import read_model_area
from splatpipe.pipeline.photos.pixels.dataset import View, load_points_and_tracks, load_split, load_views
from splatpipe.pipeline.photos.pixels.small_views import small_view
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.quality.free_space import free_space
from splatpipe.pipeline.splat.sky.sky_mask import WORK_MEGAPIXELS, SkyPhoto, up_of
from splatpipe.pipeline.train.blocks.block_windows import (
    BlockWindows,
    WindowScheme,
    block_windows,
    coarse_coverages,
    footage_on,
)
from splatpipe.pipeline.train.blocks.cells.cutting import cut, shares, site, work_map
from splatpipe.pipeline.train.blocks.cells.division import Division
from splatpipe.pipeline.train.blocks.cells.partition import Partition
from splatpipe.pipeline.train.blocks.cells.photo_coverage import PhotoCoverage
from splatpipe.pipeline.train.blocks.cells.site_plan import SitePlan, block_limits
from splatpipe.pipeline.train.blocks.scope import BlockScope, write_free_space
from splatpipe.pipeline.train.options import TrainConfig

COARSE, PROSPECTS = "coarse", "prospects"  # folders in the stage's output


def lay_out(
    train: TrainConfig, inputs: Inputs, division: Division, out: Path, report: Reporter
) -> tuple[SitePlan, dict[str, JSON]]:
    """Cut a site into cells, share the cap among them, and write each block's scope.

    Args:
        train: The training options.
        inputs: The stage's inputs.
        division: The number of blocks and the resources of each.
        out: The stage's output folder: contains the coarse pass's and receives the scopes.
        report: Receives progress.

    Returns:
        The plan, and the facts about its blocks for the summary.
    """
    dataset, threads, coarse = inputs["undistort.dataset"], inputs.machine.threads, out / COARSE
    kept = set(load_split(inputs["split.views"]).train)
    views = [view for view in load_views(dataset) if view.camera.name in kept]
    points, tracks = load_points_and_tracks(dataset)
    xyz, observed = points.xyz, [tracks[view.camera.name] for view in views]
    area = read_model_area(inputs.parts.get("georef.boundary"))
    report.progress(0, 1, "cutting the site into blocks")
    seen = coarse_coverages(coarse, views, observed, inputs.machine)
    with same_bits(threads):
        plan = GroundPlan.across(upward(views, xyz, threads))
        work = work_map(plan, site(plan, seen, xyz, area), seen, xyz)
        partition = cut(work, division.blocks)
        gaussians = read_splat(coarse / "model.ply")
        means = gaussians.means.double().numpy()
        weights = shares(work, partition).mean(axis=0).tolist()
        block_counts = [(weight, *_count_gaussians(partition, k, means)) for k, weight in enumerate(weights)]
        blocks = block_windows(train, views, seen, xyz, partition, division.window_pixels)
        limits = block_limits(division, train.sh_degree, block_counts)
        cameras = [view.camera for view in views]
        parts = WindowScheme.of(train, *footage_on(train, cameras, division.window_pixels))
        scene = (gaussians, seen, xyz)
        around = _look_around(partition, parts, blocks, scene, out / PROSPECTS, report)
        if train.prune_free_space:
            write_free_space(out / PROSPECTS, free_space(cameras, xyz, observed))
    summary: Mapping[str, JSON] = {
        "limit_bytes": division.limit_bytes,
        "margin": partition.margin,
        "photos": [block.photos for block in blocks],
        "iterations": [block.iterations for block in blocks],
        "gaussians": [limit.share for limit in limits],
        "trained": [limit.trained for limit in limits],
        "start": [min(limit.trained, inside) for limit, (_, _, inside) in zip(limits, block_counts, strict=True)],
        "steps": [block.steps for block in blocks],
        "frozen": [min(limit.frozen, count) for limit, count in zip(limits, around, strict=True)],
        "disk_bytes": [block.disk_bytes for block in blocks],
    }
    return SitePlan(partition, tuple(limits), division.window_pixels, division.limit_bytes), {"of_blocks": summary}


def _look_around(
    partition: Partition,
    parts: WindowScheme,
    blocks: Sequence[BlockWindows],
    scene: tuple[Gaussians, Sequence[PhotoCoverage], Float64[np.ndarray, "p 3"]],
    folder: Path,
    report: Reporter,
) -> list[int]:
    """Write each block's scope and return the number of coarse Gaussians that each sees around itself.

    Args:
        partition: The cells.
        parts: How photos are cut into windows.
        blocks: What each block trains on.
        scene: The coarse model, all photos' coverages and all sparse points.
        folder: Output folder.
        report: Receives progress.
    """
    found = []
    for number, block in enumerate(blocks):
        report.progress(number, len(blocks), "choosing the photos of blocks", "blocks")
        scope = BlockScope.of(partition, number, block.windows, parts, scene)
        scope.write(folder, number)
        found.append(len(scope.around.rows))
    return found


def upward(views: Sequence[View], xyz: Float64[np.ndarray, "p 3"], threads: int) -> Float64[np.ndarray, " 3"]:
    """The unit vector against gravity, from the cameras alone: new control moves the frame but affects no training.

    Args:
        views: The photos.
        xyz: The sparse points.
        threads: Number of threads that read photos, needed if these seem to be rotated.
    """

    def photo(index: int) -> SkyPhoto:
        camera, pixels, mask = small_view(views[index], WORK_MEGAPIXELS)
        return SkyPhoto(camera, pixels, None if mask is None else ~mask)

    return up_of([view.camera for view in views], photo, xyz[np.isfinite(xyz).all(axis=1)], threads)


def _count_gaussians(partition: Partition, block: int, means: Float64[np.ndarray, "n 3"]) -> tuple[int, int]:
    """Number of Gaussians in a block's cell, and in its cell and margin."""
    return int((partition.owners(means) == block).sum()), int(partition.trained_by(block, means).sum())
