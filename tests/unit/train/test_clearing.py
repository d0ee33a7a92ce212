"""Gaussians in free space: removed during training if enabled, at the scheduled steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.quality.free_space import FreeSpace, near_or_free
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.plan import make_plan
from splatpipe.pipeline.train.plan.schedule import resolve_schedule
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.pipeline.train.techniques.floater_pruning import STEPS_BETWEEN, FloaterPruning, free_space_of
from splatpipe.pipeline.train.techniques.techniques import Techniques, make_techniques

OPTIONS = TrainConfig(prune_free_space=2)
SCHEDULE = resolve_schedule(OPTIONS)
LOOKS = STEPS_BETWEEN * SCHEDULE.density.every


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Only a wall of points at z = 1.5, seen by all cameras."""
    folder = tmp_path_factory.mktemp("wall")
    tiny_scene.write_dataset(folder)
    generator = np.random.default_rng(1)
    xyz = np.column_stack([generator.uniform((-1.5, -1.2), (1.5, 1.2), (600, 2)), np.full(600, 1.5)])
    for path in (folder / "sparse/0").iterdir():
        path.unlink()
    (folder / "sparse/0").rmdir()
    tiny_scene.write_model(folder / "sparse/0", tiny_scene.cameras(), xyz, np.full((600, 3), 90, np.uint8))
    return folder


def haze_and_wall() -> Gaussians:
    """Four Gaussians half-way to the wall, and four on it."""
    gaussians = Gaussians.empty(8, 3)
    gaussians.means = torch.tensor([[0.1 * i, 0.1 * i, -0.5 if i < 4 else 1.5] for i in range(8)])
    gaussians.log_scales = torch.full((8, 3), -4.0)
    gaussians.quats[:, 0] = 1.0
    gaussians.opacity_logits = torch.full((8,), 1.0)
    return gaussians


@pytest.fixture(scope="module")
def space(dataset: Path) -> FreeSpace:
    return free_space_of(load_views(dataset), dataset)


def test_gaussians_in_front_of_the_wall_are_marked_at_the_scheduled_steps(space: FreeSpace) -> None:
    gaussians, clearing = haze_and_wall(), FloaterPruning(space, SCHEDULE)
    found = clearing.prune_mask(gaussians, LOOKS)
    assert found is not None and found.tolist() == [True] * 4 + [False] * 4
    assert torch.equal(found, near_or_free(gaussians, space, 2))
    assert clearing.prune_mask(gaussians, LOOKS + SCHEDULE.density.every) is None


@pytest.mark.parametrize("density", ["published", "absolute"])
def test_density_control_removes_them(dataset: Path, space: FreeSpace, density: str) -> None:
    config = TrainConfig.model_validate({"prune_free_space": 2, "density": density})
    plan = make_plan(config, load_views(dataset), tiny_scene.split_of(load_views(dataset)), 8)
    state = TrainState.begin(haze_and_wall(), plan, Techniques((FloaterPruning(space, plan.schedule),)))
    state.control_density(plan, LOOKS)
    assert len(state.gaussians) >= 4
    assert not near_or_free(state.gaussians.detach(), space, 2).any()


def test_checks_continue_after_density_control_and_end_before_the_run(dataset: Path, space: FreeSpace) -> None:
    plan = make_plan(TrainConfig(prune_free_space=2), load_views(dataset), tiny_scene.split_of(load_views(dataset)), 8)
    step = STEPS_BETWEEN * plan.schedule.density.every
    after = (plan.schedule.density.last // step + 1) * step
    clearing = FloaterPruning(space, plan.schedule)
    assert clearing.is_due(after) and not clearing.is_due(after + 1)
    assert not clearing.is_due(plan.schedule.iterations)
    state = TrainState.begin(haze_and_wall(), plan, Techniques((FloaterPruning(space, plan.schedule),)))
    before = state.gaussians.detach().select(torch.arange(4, 8))
    state.control_density(plan, after)
    for name, tensor in before.tensors().items():
        assert torch.equal(state.gaussians.detach().tensors()[name], tensor)
    assert state.history.density == [
        {"iteration": after, "gaussians": 4, "pruned": 4} | dict.fromkeys(("cloned", "split", "held_back"), 0)
    ]


def test_if_disabled_nothing_is_checked(dataset: Path) -> None:
    views = load_views(dataset)
    for times, found in ((0, False), (1, True)):
        plan = make_plan(TrainConfig(prune_free_space=times), views, tiny_scene.split_of(views), 8)
        assert (make_techniques(plan, None, views, dataset).find(FloaterPruning) is not None) == found
