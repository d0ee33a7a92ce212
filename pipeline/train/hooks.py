"""The hooks of optional techniques in a training iteration, and the data that they receive."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.rasterizer import Render, RenderOptions
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.densify import DensitySchedule
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.schedule import ScheduleStep


@dataclass(frozen=True)
class RenderedView:
    """A photo and its rendered view.

    Attributes:
        photo: The photo to compare with.
        rendered: The render of the Gaussians alone.
        settings: How it was rendered.
        now: The schedule's values for this iteration.
    """

    photo: TrainingPhoto
    rendered: Render
    settings: RenderOptions
    now: ScheduleStep


class Technique:
    """An optional part of training besides the Gaussians, off by default.

    The hooks are listed in the order in which an iteration calls them; here each does nothing.

    Attributes:
        name: Prefix of its tensors in a checkpoint.
    """

    name: ClassVar[str]

    def move_to(self, device: torch.device) -> None:
        """Move the technique's tensors to the training device; called before the first iteration."""

    def settings(self, settings: RenderOptions, model: Gaussians, camera: Camera, now: ScheduleStep) -> RenderOptions:
        """Return the render options for this iteration, e.g. with depths."""
        return settings

    def before_render(self, model: Gaussians, now: ScheduleStep) -> Gaussians:
        """Return the model as rendered in this iteration."""
        return model

    def apply_appearance(self, picture: Float[Tensor, "h w 3"], rendered_view: RenderedView) -> Float[Tensor, "h w 3"]:
        """Return the render as the photo would show it."""
        return picture

    def mask_pixels(
        self, photo: TrainingPhoto, picture: Float[Tensor, "h w 3"], rendered_view: RenderedView
    ) -> TrainingPhoto:
        """Return the photo, masked to the pixels that count.

        Args:
            photo: The photo as returned by the previous techniques.
            picture: The render that it is compared with.
            rendered_view: The iteration's photo and render.
        """
        return photo

    def penalty(self, rendered_view: RenderedView) -> Float[Tensor, ""] | None:
        """Return a loss term or None; a penalty on the Gaussians themselves must keep the model of `before_render`."""
        return None

    def roll_back(self) -> None:
        """Undo what the hooks changed: the iteration restarts because memory ran out before its step."""

    def after_step(self, rendered_view: RenderedView) -> None:
        """Take an optimizer step for the technique's own parameters."""

    def after_epoch(self, iteration: int) -> None:
        """Called when every photo, with all of its windows, has been trained on once more."""

    def adjust_scores(
        self, score: Float[Tensor, " n"], gaussians: Gaussians, schedule: DensitySchedule
    ) -> Float[Tensor, " n"]:
        """Return the score by which density control ranks Gaussians; 0 for one that must not be cloned or split."""
        return score

    def prune_mask(self, gaussians: Gaussians, iteration: int) -> Bool[Tensor, " n"] | None:
        """Return the Gaussians to remove after an iteration; None if this iteration does not check."""
        return None

    def summary(self) -> dict[str, int | float]:
        """Return the technique's entries in the stage's summary."""
        return {}

    def to_arrays(self) -> dict[str, Tensor]:
        """Mutable state by name, for a checkpoint; not copied."""
        return {}

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """The inverse of ``to_arrays``.

        Raises:
            KeyError, ValueError: if a tensor is missing or has a different shape.
        """
