"""The 3D smoothing filter: no Gaussian is finer than the training photos could show.

Yu, Chen, Huang, Sattler, Geiger: "Mip-Splatting: Alias-free 3D Gaussian Splatting", CVPR 2024, the section on the 3D
smoothing filter. A camera of focal length f pixels samples what lies at depth z with f / z pixels a world unit. A
Gaussian is convolved with an isotropic one of variance 0.2 squared pixels at the highest rate ν of the training cameras
that see it: Σ becomes Σ + 0.2 / ν² I, its opacity is multiplied by √(|Σ| / |Σ + 0.2 / ν² I|). Both have Σ's axes, so
only scales and opacity change. What is optimised stays raw; what is rendered, in training and after, is filtered.

The screen filter (``RenderOptions.antialias``) has the variance that viewers have, 0.3 squared pixels; the paper's has
0.1, so that both together are the 0.3 of 3D Gaussian splatting at the training resolution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.dataset import View
from splatpipe.pipeline.photos.images import reduced_camera
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.train.plan import Plan

FILTER_VARIANCE = 0.2  # squared pixels at the highest sampling rate: the paper's
SEEN_MARGIN = 0.1  # of the picture on each side: a Gaussian centred there still reaches into it
REFRESH_EVERY = 100  # iterations: positions move little meanwhile
LARGEST_LOG_RATIO = 80.0  # of the filter's variance over a Gaussian's: its exponential is finite in float32
LARGEST_LOG_ODDS = 30.0  # of an opacity, in its gradient: float32 has none there any more


@dataclass(frozen=True)
class Sampling:
    """The training cameras as they sample the scene.

    Attributes:
        cameras: At the full size of training, also where it begins with smaller photos.
        near: Near plane, world units.
    """

    cameras: tuple[Camera, ...]
    near: float

    def filter_sigmas(self, means: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Standard deviation of each Gaussian's filter, world units; 0 where no camera sees its centre.

        Nothing is known of how finely those are sampled, and hardly a photo pulls at them: they stay as they are. The
        same bits for the same means: no product of matrices, which may round differently from run to run.

        Args:
            means: World positions; one that is not finite is seen by none.
        """
        points = means.detach().t().contiguous()  # (3, n)
        finest = torch.full_like(points[0], math.inf)  # world units a pixel
        across, depth = torch.empty_like(finest), torch.empty_like(finest)
        for camera in self.cameras:
            rotation, shift = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
            _affine(points, rotation[2], shift[2], depth)
            seen = depth > self.near
            sides = ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
            for row, (focal, centre, size) in enumerate(sides):
                # |x| <= z for what is within the widened picture.
                weights = [focal / size / (0.5 + SEEN_MARGIN), (centre / size - 0.5) / (0.5 + SEEN_MARGIN)]
                axis = weights[0] * rotation[row] + weights[1] * rotation[2]
                _affine(points, axis, weights[0] * shift[row] + weights[1] * shift[2], across)
                seen &= across.abs_() <= depth
            depth.mul_(1.0 / max(camera.fx, camera.fy)).masked_fill_(~seen, math.inf)
            torch.minimum(finest, depth, out=finest)
        return finest.mul_(math.sqrt(FILTER_VARIANCE)).masked_fill_(finest.isinf(), 0.0)


def sampling_of(plan: Plan, views: Sequence[View]) -> Sampling | None:
    """How a training samples the scene; None where its plan has no 3D filter.

    Args:
        plan: The training's.
        views: Those it trains on.
    """
    if not plan.options.filter_3d:
        return None
    return Sampling(tuple(reduced_camera(view.camera, plan.megapixels) for view in views), plan.near)


def _affine(
    points: Float[Tensor, "3 n"], axis: Float64[np.ndarray, " 3"], shift: float, out: Float[Tensor, " n"]
) -> None:
    """``out`` = axis · point + shift, for all points."""
    torch.mul(points[0], float(axis[0]), out=out)
    out.add_(points[1], alpha=float(axis[1])).add_(points[2], alpha=float(axis[2])).add_(float(shift))


def smoothed(gaussians: Gaussians, filter_sigmas: Float[Tensor, " n"]) -> Gaussians:
    """The Gaussians as they are rendered; differentiable by their raw scales and opacities, the rest is shared.

    Args:
        gaussians: Raw parameters.
        filter_sigmas: Standard deviation of each one's filter, world units; 0 leaves a Gaussian as it is.
    """
    changed = _Smooth.apply(gaussians.log_scales, gaussians.opacity_logits, filter_sigmas)  # type: ignore[no-untyped-call]
    return replace(gaussians, log_scales=changed[0], opacity_logits=changed[1])


def raw_opacity_limits(gaussians: Gaussians, filter_sigmas: Float[Tensor, " n"], limit: float) -> Float[Tensor, " n"]:
    """The largest logit of each raw opacity for which the rendered one is at most ``limit``; infinite where any is.

    Args:
        gaussians: Raw parameters.
        filter_sigmas: As for ``smoothed``.
        limit: Opacity in (0, 1).
    """
    ratio = torch.exp(_log_ratio(gaussians.log_scales.detach(), filter_sigmas))
    return torch.logit((limit * torch.exp(0.5 * torch.log1p(ratio).sum(dim=1))).clamp(max=1.0))


def _log_ratio(log_scales: Float[Tensor, "n 3"], filter_sigmas: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """ln(s² / σ²) of the filter's variance over the Gaussian's along each axis; -inf without a filter."""
    log_variance = torch.log(filter_sigmas).mul_(2.0)
    return torch.sub(log_variance[:, None], log_scales, alpha=2.0).clamp_(max=LARGEST_LOG_RATIO)


class _Smooth(torch.autograd.Function):
    """Value and gradient in closed form and in place: a third of what the graph of operations takes.

    With r = s² / σ² along an axis: ln σ' = ln σ + ½ ln(1 + r), and o' = o e⁻ᵏ with k = ½ Σ ln(1 + r). The odds of o',
    o' / (1 - o') = e⁻ᵏ eᵃ / (1 + eᵃ (1 - e⁻ᵏ)) with a = logit o, have no difference of nearly equal numbers.
    """

    @staticmethod
    def forward(ctx: Any, log_scales: Tensor, logits: Tensor, sigmas: Tensor) -> tuple[Tensor, Tensor]:
        ratio = _log_ratio(log_scales, sigmas).exp_()
        growth = torch.log1p(ratio)
        loss = (growth[:, 0] + growth[:, 1]).add_(growth[:, 2]).mul_(0.5)  # k
        excess = loss.neg().expm1_().neg_().log_().add_(logits)  # ln(eᵃ (1 - e⁻ᵏ)); -inf without a filter
        opacity = torch.nn.functional.softplus(excess).add_(loss).neg_().add_(logits)
        if any(ctx.needs_input_grad[:2]):
            ctx.save_for_backward(ratio, excess, opacity)
        return growth.mul_(0.5).add_(log_scales), opacity

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_scales: Tensor, by_logits: Tensor) -> tuple[Tensor, Tensor, None]:
        ratio, excess, opacity = ctx.saved_tensors
        share = ratio + 1.0
        torch.div(ratio, share, out=share)  # of the filter in the variance: dk/d(ln σ) = -share
        # d(logit o')/dk = -1 / (1 - o') = -(1 + odds)
        by_loss = opacity.clamp(max=LARGEST_LOG_ODDS).exp_().add_(1.0).mul_(by_logits)
        return (
            torch.sub(by_loss[:, None], by_scales).mul_(share).add_(by_scales),
            excess.neg().sigmoid_().mul_(by_logits),
            None,
        )
