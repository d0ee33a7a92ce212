"""A tiny site of two blocks, and their training."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_scene

from splatpipe.pipeline.engine.stage import Machine
from splatpipe.pipeline.geometry.ground_plan import GroundPlan
from splatpipe.pipeline.photos.pixels.dataset import load_points_and_tracks, load_split, load_views
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.quality.free_space import free_space
from splatpipe.pipeline.train.blocks.block_windows import WindowScheme, block_windows, coarse_coverages, footage_on
from splatpipe.pipeline.train.blocks.cells.partition import Cell, Partition
from splatpipe.pipeline.train.blocks.cells.photo_coverage import PhotoCoverage
from splatpipe.pipeline.train.blocks.scope import BlockScope, write_free_space
from splatpipe.pipeline.train.blocks.training import BlockTask, SiteParts, train_block
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.sizing import shortage
from splatpipe.pipeline.train.state.state import TrainState

WINDOW = 1000  # pixels of a window: four windows in a photo of 72 × 54, and one at half the size

CELLS = (Cell((-3.0, -1.5), (0.0, 3.0)), Cell((0.0, -1.5), (3.0, 3.0)))

PARTITION = Partition(GroundPlan(np.array([[1.0, 0, 0], [0, 0, 1.0]]), np.array([0, -1.0, 0])), CELLS, 0.25)

CONFIG = TrainConfig(
    iterations=450, least_iterations=1, sh_degree=1, prune_free_space=2, exposure="affine", max_gaussians=400
)

TASK = BlockTask(0, share=160, trained=230, frozen=120, window_pixels=WINDOW)


def surveyed(site: SiteParts, config: TrainConfig = CONFIG, window: int = WINDOW) -> SiteParts:
    """Return the site with its blocks' views, stored as by the stage `blocks`."""
    kept = set(load_split(site.split).train)
    views = [view for view in load_views(site.dataset) if view.camera.name in kept]
    points, tracks = load_points_and_tracks(site.dataset)
    cameras, seen = [view.camera for view in views], coverages_of(site)
    blocks = block_windows(config, views, seen, points.xyz, site.partition, window)
    cut = WindowScheme.of(config, *footage_on(config, cameras, window))
    site.prospects.mkdir(exist_ok=True)
    for number, block in enumerate(blocks):
        scene = (read_splat(site.coarse / "model.ply"), seen, points.xyz)
        BlockScope.of(site.partition, number, block.windows, cut, scene).write(site.prospects, number)
    write_free_space(site.prospects, free_space(cameras, points.xyz, [tracks[each.name] for each in cameras]))
    return site


def trained(site: SiteParts, out: Path, threads: int = 1) -> Path:
    out.mkdir(exist_ok=True)
    train_block(CONFIG, site, TASK, Machine("cpu", threads), out, tiny_scene.Recorder())
    return out


class Kill(BaseException):
    """Stands in for a kill."""


def step_with(patch: pytest.MonkeyPatch, observe: Callable[[TrainState, TrainingPhoto], None]) -> None:
    """Call ``observe`` before each iteration."""
    step = shortage.iterate

    def observed_iterate(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto) -> None:
        observe(state, photo)
        step(state, plan, photo)

    patch.setattr(shortage, "iterate", observed_iterate)


def coverages_of(site: SiteParts) -> list[PhotoCoverage]:
    """Return what the training photos see."""
    kept = set(load_split(site.split).train)
    views = [view for view in load_views(site.dataset) if view.camera.name in kept]
    _, tracks = load_points_and_tracks(site.dataset)
    return coarse_coverages(site.coarse, views, [tracks[view.camera.name] for view in views], Machine("cpu", 1))
