"""Optional techniques: the order in which an iteration calls their hooks, and what checkpoints store of them."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import tiny_scene
import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.hooks import RenderedView, Technique
from splatpipe.pipeline.train.iteration import iterate
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan
from splatpipe.pipeline.train.plan.schedule import ScheduleStep
from splatpipe.pipeline.train.state.checkpoint import BrokenCheckpointError, Checkpoint
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.pipeline.train.techniques.techniques import Techniques


class Tint(Technique):
    """Adds its own red to every image, trains it by hand, and records calls."""

    name = "tint"

    def __init__(self) -> None:
        self.red = torch.zeros(1)
        self.calls: list[str] = []

    def settings(self, settings: RenderOptions, model: Gaussians, camera: Camera, now: ScheduleStep) -> RenderOptions:
        self.calls.append(f"settings {now.iteration}")
        return settings

    def before_render(self, model: Gaussians, now: ScheduleStep) -> Gaussians:
        self.calls.append("before_render")
        return model

    def apply_appearance(self, picture: Tensor, rendered_view: RenderedView) -> Tensor:
        self.calls.append("shown")
        return picture + self.red * torch.tensor([1.0, 0.0, 0.0])

    def mask_pixels(self, photo: TrainingPhoto, picture: Tensor, rendered_view: RenderedView) -> TrainingPhoto:
        self.calls.append("counted")
        return photo

    def penalty(self, rendered_view: RenderedView) -> Tensor:
        self.calls.append("penalty")
        return 0.1 * rendered_view.rendered.alpha.mean()

    def after_step(self, rendered_view: RenderedView) -> None:
        self.calls.append("after_step")
        self.red += 0.25

    def after_epoch(self, iteration: int) -> None:
        self.calls.append(f"after_epoch {iteration}")

    def prune_mask(self, gaussians: Gaussians, iteration: int) -> Tensor | None:
        self.calls.append("prune_mask")
        return torch.arange(len(gaussians)) == 0 if iteration == 2 else None

    def to_arrays(self) -> dict[str, Tensor]:
        return {"red": self.red}

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        self.red.copy_(arrays["red"])


@pytest.fixture
def plan() -> TrainingPlan:
    views = [View(camera, Path(), None) for camera in tiny_scene.cameras(2)]
    return make_plan(tiny_scene.plain(iterations=1000), views, tiny_scene.split_of(views), tiny_scene.GAUSSIANS)


def photos() -> list[TrainingPhoto]:
    grey = torch.full((tiny_scene.HEIGHT, tiny_scene.WIDTH, 3), 0.5)
    return [TrainingPhoto(camera, grey, None) for camera in tiny_scene.cameras(2)]


def test_an_iteration_calls_every_hook_in_order(plan: TrainingPlan) -> None:
    tint = Tint()
    state = TrainState.begin(tiny_scene.true_model(), plan, Techniques((tint,)))
    for photo, ended in zip(photos(), (0, 2), strict=True):
        iterate(state, plan, replace(photo, round=ended))
    once = ["before_render", "shown", "counted", "penalty", "after_step"]
    assert tint.calls == ["settings 1", *once, "prune_mask", "settings 2", *once, "after_epoch 2", "prune_mask"]
    assert len(state.gaussians) == tiny_scene.GAUSSIANS - 1  # the second time one was pruned
    assert state.history.density[-1]["pruned"] == 1


def test_an_image_and_a_penalty_change_what_is_learnt(plan: TrainingPlan) -> None:
    learnt = []
    for techniques in (Techniques(), Techniques((Tint(),))):
        state = TrainState.begin(tiny_scene.true_model(), plan, techniques)
        iterate(state, plan, photos()[0])  # the tint is still 0: the penalty alone
        learnt.append(torch.sigmoid(state.gaussians.opacity_logits.detach()).mean())
    assert learnt[1] < learnt[0]


def test_a_photo_without_counting_pixels_does_not_affect_techniques(plan: TrainingPlan) -> None:
    tint, photo = Tint(), photos()[0]
    state = TrainState.begin(tiny_scene.true_model(), plan, Techniques((tint,)))
    nothing = torch.zeros(photo.colour.shape[:2], dtype=torch.bool)
    iterate(state, plan, TrainingPhoto(photo.camera, photo.colour, nothing, is_empty=True))
    assert tint.calls == ["prune_mask"] and state.iteration == 1 and float(tint.red) == 0.0


def test_a_checkpoint_keeps_what_a_technique_learnt_and_one_without_it_is_refused(plan: TrainingPlan) -> None:
    state = TrainState.begin(tiny_scene.true_model(), plan, Techniques((Tint(),)))
    iterate(state, plan, photos()[0])
    checkpoint, again = state.checkpoint("any"), Tint()
    assert TrainState.restore(checkpoint, plan, Techniques((again,))).iteration == 1
    assert float(again.red) == 0.25
    arrays = {name: array for name, array in checkpoint.arrays.items() if name != "tint.red"}
    with pytest.raises(BrokenCheckpointError, match="red"):
        TrainState.restore(Checkpoint(arrays, checkpoint.facts), plan, Techniques((Tint(),)))
