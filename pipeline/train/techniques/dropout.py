"""Random dropping of Gaussians, so that a model from few photos does not rely on single Gaussians near a camera.

The idea of Park, Ryu, Kim: "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting", CVPR 2025.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from splatpipe.pipeline.raster.cuda.cuda import kernels_of
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.hooks import Technique
from splatpipe.pipeline.train.plan.schedule import Schedule, ScheduleStep
from splatpipe.pipeline.train.random_numbers import DROPOUT, uniform

DROPPED_LOGIT = -30.0  # an opacity of 1e-13: the projection culls it, so it costs nothing and learns nothing
LARGEST_OPACITY = 0.999  # cap on scaled opacities, so that the logit stays finite; blending caps alpha at 0.99


def share_at(schedule: Schedule, iteration: int) -> float:
    """The share dropped at an iteration (from 1): rises linearly to `dropout` at the schedule's end."""
    return schedule.dropout * min(1.0, iteration / schedule.iterations)


def dropped(gaussians: Gaussians, schedule: Schedule, iteration: int) -> Gaussians:
    """The Gaussians as an iteration renders them; the same object if `dropout` is 0.

    A random share gets no opacity, and the opacity of the others is divided by 1 - share: the expected opacity stays
    the same as long as no scaled opacity exceeds 1.

    Args:
        gaussians: The model.
        schedule: The training schedule.
        iteration: From 1; with the seed and a Gaussian's row it selects the random number.
    """
    share = share_at(schedule, iteration)
    if share == 0.0:
        return gaussians
    drawn = _drawn(schedule.seed, iteration, gaussians)
    logits = _DropoutLogits.apply(gaussians.opacity_logits, drawn >= share, share)  # type: ignore[no-untyped-call]
    return replace(gaussians, opacity_logits=logits)


class Dropout(Technique):
    """Leaves a random share of the Gaussians out of each iteration.

    Args:
        schedule: The training schedule.
    """

    name = "dropout"

    def __init__(self, schedule: Schedule) -> None:
        self._schedule = schedule

    def before_render(self, model: Gaussians, now: ScheduleStep) -> Gaussians:
        """The Gaussians without the dropped ones."""
        return dropped(model, self._schedule, now.place)


def _drawn(seed: int, iteration: int, gaussians: Gaussians) -> Float64[Tensor, " n"]:
    """A number in (0, 1) for each Gaussian, the same on every device."""
    device = gaussians.opacity_logits.device
    kernels = kernels_of(device)
    if kernels is not None:
        return kernels.uniform(seed, iteration, DROPOUT, len(gaussians))
    return torch.from_numpy(uniform(seed, iteration, DROPOUT, np.arange(len(gaussians)))).to(device)


class _DropoutLogits(torch.autograd.Function):
    """Logits of σ / (1 - share) for the Gaussians kept.

    Where the cap applies, the gradient is that of the uncapped opacity: the cap only binds in the Gaussian's middle,
    and its flanks still show how opaque it should be.
    """

    @staticmethod
    def forward(ctx: Any, logits: Float[Tensor, " n"], kept: Bool[Tensor, " n"], share: float) -> Float[Tensor, " n"]:
        opacity = torch.sigmoid(logits)
        scaled = (opacity / (1.0 - share)).clamp_(max=LARGEST_OPACITY)
        ctx.save_for_backward(opacity, scaled, kept)
        ctx.share = share
        return torch.where(kept, torch.log(scaled).sub_(torch.log1p(-scaled)), DROPPED_LOGIT)

    @staticmethod
    def backward(ctx: Any, gradient: Float[Tensor, " n"]) -> tuple[Tensor, None, None]:
        opacity, scaled, kept = ctx.saved_tensors
        # d logit(σ') / d logit(σ) with σ' = σ / (1 - share): both logits' slopes are σ (1 - σ).
        slope = (1.0 - opacity).mul_(opacity)
        slope.div_(((1.0 - ctx.share) * scaled).mul_(1.0 - scaled)).mul_(gradient)
        return torch.where(kept, slope, 0.0), None, None
