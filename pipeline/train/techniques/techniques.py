"""The optional training techniques, created in one place; each has a file of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.appearance.exposure import Exposure
from splatpipe.pipeline.train.appearance.robust import RobustMask
from splatpipe.pipeline.train.appearance.sky import SkyModel
from splatpipe.pipeline.train.densify import DensitySchedule
from splatpipe.pipeline.train.hooks import RenderedView, Technique
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.plan.schedule import ScheduleStep
from splatpipe.pipeline.train.techniques.backdrop import Backdrop
from splatpipe.pipeline.train.techniques.distortion_loss import FIRST_SHARE, DistortionLoss
from splatpipe.pipeline.train.techniques.dropout import Dropout
from splatpipe.pipeline.train.techniques.floater_pruning import FloaterPruning, free_space_of

Kind = TypeVar("Kind", bound=Technique)


def make_techniques(
    plan: TrainingPlan,
    sky: SkyModel | None = None,
    views: Sequence[View] = (),
    dataset: Path | None = None,
    device: torch.device | None = None,
    area: PlanArea | None = None,
) -> Techniques:
    """Create the techniques that a plan requires, untrained.

    They are in the order in which an iteration calls them: the sky lies behind what exposure changes, and moving
    objects are detected in the image that both have produced.

    Args:
        plan: The training plan.
        sky: The initial sky; copied.
        views: The training views.
        dataset: Their dataset, with the sparse points; None for a throw-away training.
        device: The training device; None for the CPU.
        area: That counts; None where all does.

    Raises:
        StageError: if the dataset is broken.
    """
    options, schedule = plan.options, plan.schedule
    made: list[Technique] = []
    if schedule.dropout:
        made.append(Dropout(schedule))
    if sky is not None:
        made.append(sky.copied())
    if options.exposure == "affine":
        made.append(Exposure(plan.train_views))
    if options.robust:
        robust = RobustMask(plan.train_views, options.robust, schedule.density.first)
        robust.watch(view.camera for view in views)
        made.append(robust)
    if options.distortion_weight:
        made.append(DistortionLoss(options.distortion_weight, int(FIRST_SHARE * schedule.iterations)))
    if options.prune_free_space and dataset is not None:
        made.append(FloaterPruning(free_space_of(views, dataset), schedule))
    if area is not None:
        made.append(Backdrop(area, schedule.density))
    for technique in made:
        technique.move_to(device or torch.device("cpu"))
    return Techniques(tuple(made))


def begin_sky(
    config: TrainConfig, views: Sequence[View], dataset: Path, threads: int, report: Reporter
) -> SkyModel | None:
    """The initial sky model; None if it is off or no photo shows sky."""
    if config.sky == "off":
        return None
    sky = SkyModel.begin(views, dataset, threads)
    if sky is not None:
        report.note(f"sky in {sky.photos} photos")
    return sky


@dataclass(frozen=True)
class Techniques:
    """All techniques of a training, called one after the other.

    Attributes:
        each: The techniques, in call order.
    """

    each: tuple[Technique, ...] = ()

    def __iter__(self) -> Iterator[Technique]:
        return iter(self.each)

    def find(self, kind: type[Kind]) -> Kind | None:
        """The technique of a class; None if it is off."""
        return next((technique for technique in self.each if isinstance(technique, kind)), None)

    def with_given(self, given: Technique) -> Techniques:
        """The same with ``given`` in place of the technique of its class."""
        return Techniques(tuple(given if type(given) is type(each) else each for each in self.each))

    def settings(self, settings: RenderOptions, model: Gaussians, camera: Camera, now: ScheduleStep) -> RenderOptions:
        """The render options."""
        for technique in self.each:
            settings = technique.settings(settings, model, camera, now)
        return settings

    def before_render(self, model: Gaussians, now: ScheduleStep) -> Gaussians:
        """The model as rendered in this iteration."""
        for technique in self.each:
            model = technique.before_render(model, now)
        return model

    def apply_appearance(self, rendered_view: RenderedView) -> Float[Tensor, "h w 3"]:
        """The render as the photo would show it."""
        picture = rendered_view.rendered.colour
        for technique in self.each:
            picture = technique.apply_appearance(picture, rendered_view)
        return picture

    def mask_pixels(self, picture: Float[Tensor, "h w 3"], rendered_view: RenderedView) -> TrainingPhoto:
        """The photo, masked to the pixels that count."""
        photo = rendered_view.photo
        for technique in self.each:
            photo = technique.mask_pixels(photo, picture, rendered_view)
        return photo

    def with_penalties(self, loss: Float[Tensor, ""], rendered_view: RenderedView) -> Float[Tensor, ""]:
        """The photo's loss plus the penalties."""
        for technique in self.each:
            penalty = technique.penalty(rendered_view)
            loss = loss if penalty is None else loss + penalty
        return loss

    def roll_back(self) -> None:
        """Undo what the hooks changed: the iteration restarts."""
        for technique in self.each:
            technique.roll_back()

    def after_step(self, rendered_view: RenderedView) -> None:
        """Step the techniques' own parameters."""
        for technique in self.each:
            technique.after_step(rendered_view)

    def after_epoch(self, iteration: int) -> None:
        """Called when every photo has been trained on once more."""
        for technique in self.each:
            technique.after_epoch(iteration)

    def adjust_scores(
        self, score: Float[Tensor, " n"], gaussians: Gaussians, schedule: DensitySchedule
    ) -> Float[Tensor, " n"]:
        """The score by which density control ranks Gaussians."""
        for technique in self.each:
            score = technique.adjust_scores(score, gaussians, schedule)
        return score

    def prune_mask(self, gaussians: Gaussians, iteration: int) -> Bool[Tensor, " n"] | None:
        """The Gaussians to remove after an iteration; None if no technique checks in this iteration."""
        found = [technique.prune_mask(gaussians, iteration) for technique in self.each]
        masks = [mask.to(gaussians.means.device) for mask in found if mask is not None]
        return torch.stack(masks).any(dim=0) if masks else None

    def summary(self) -> dict[str, int | float]:
        """The techniques' entries in the stage's summary."""
        return {name: value for technique in self.each for name, value in technique.summary().items()}

    def to_arrays(self) -> dict[str, Tensor]:
        """Mutable state for a checkpoint, named ``technique.tensor``."""
        return {
            f"{technique.name}.{name}": tensor
            for technique in self.each
            for name, tensor in technique.to_arrays().items()
        }

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """The inverse of ``to_arrays``; on failure, some techniques may have changed already.

        Raises:
            KeyError, ValueError: if a tensor is missing or has a different shape.
        """
        for technique in self.each:
            under = f"{technique.name}."
            technique.load({key.removeprefix(under): array for key, array in arrays.items() if key.startswith(under)})
