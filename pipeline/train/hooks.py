"""What an optional technique may do in an iteration of training, and what it is told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.rasterizer import Render, RenderOptions
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.train.densify import DensitySchedule
from splatpipe.pipeline.train.schedule import ScheduleStep
from splatpipe.pipeline.train.stream import TrainingPhoto


@dataclass(frozen=True)
class Shot:
    """A photo and its view, rendered.

    Attributes:
        photo: What to compare with.
        rendered: The Gaussians alone.
        settings: How they were rendered.
        now: What the schedule says.
    """

    photo: TrainingPhoto
    rendered: Render
    settings: RenderOptions
    now: ScheduleStep


class Technique:
    """What takes part in training besides the Gaussians, off where nobody asks for it.

    The hooks are in the order in which an iteration calls them; each does nothing here.

    Attributes:
        name: Of its tensors in a checkpoint.
    """

    name: ClassVar[str]

    def move_to(self, device: torch.device) -> None:
        """Take what is kept as tensors to where the model is trained; before the first iteration."""

    def settings(self, settings: RenderOptions, model: Gaussians, camera: Camera, now: ScheduleStep) -> RenderOptions:
        """How to render, e.g. with depths."""
        return settings

    def before_render(self, model: Gaussians, now: ScheduleStep) -> Gaussians:
        """The model as it is rendered in this iteration."""
        return model

    def shown(self, picture: Float[Tensor, "h w 3"], shot: Shot) -> Float[Tensor, "h w 3"]:
        """The render as the photo would show it."""
        return picture

    def counted(self, photo: TrainingPhoto, picture: Float[Tensor, "h w 3"], shot: Shot) -> TrainingPhoto:
        """The photo with what of it counts.

        Args:
            photo: As the techniques before left it.
            picture: What it is compared with.
            shot: The iteration's.
        """
        return photo

    def penalty(self, shot: Shot) -> Float[Tensor, ""] | None:
        """What is added to the photo's loss; one on the Gaussians themselves keeps the model of `before_render`."""
        return None

    def begin_again(self) -> None:
        """The iteration is begun again, for memory was short before its step: undo what its hooks have changed."""

    def after_step(self, shot: Shot) -> None:
        """Step what is trained beside the Gaussians."""

    def after_epoch(self, iteration: int) -> None:
        """Every photo was trained on once more, with all of its windows."""

    def ranked(
        self, score: Float[Tensor, " n"], gaussians: Gaussians, schedule: DensitySchedule
    ) -> Float[Tensor, " n"]:
        """The score by which density control ranks Gaussians; 0 for one that is not to be cloned or split."""
        return score

    def unwanted(self, gaussians: Gaussians, iteration: int) -> Bool[Tensor, " n"] | None:
        """Which Gaussians have to go after an iteration; None where it is not one to look."""
        return None

    def summary(self) -> dict[str, int | float]:
        """What the stage's summary says of it."""
        return {}

    def to_arrays(self) -> dict[str, Tensor]:
        """All that changes, by name, for a checkpoint; not copied."""
        return {}

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """The inverse of ``to_arrays``.

        Raises:
            KeyError, ValueError: if something is missing or has another shape.
        """
