"""Decay of opacities and scales, and a limit on needles.

The decay pulls at Gaussians that no photo holds: Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte
Carlo", NeurIPS 2024 (regularisers of opacity and scale). Against needles, which few views cannot tell from a surface:
the idea of Xie et al., "PhysGaussian", CVPR 2024, as a limit instead of a penalty, so that it needs no weight, and of
the longest axis against the middle one, not the shortest: a disc is what a wall is made of.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.scene.gaussians import Gaussians
from splatpipe.stages.options import TrainConfig


def add_decay(gaussians: Gaussians, visible: Bool[Tensor, " n"], options: TrainConfig, extent: float) -> None:
    """Add to the gradients those of the decay, for the Gaussians that the photo saw.

    Of `opacity_decay` times the mean opacity, and of `scale_decay` times the mean of the three axes' sum over the
    scene's extent; means over all Gaussians.

    Args:
        gaussians: With gradients; these are changed in place.
        visible: Those that step.
        options: Resolved.
        extent: Of the scene, world units.
    """
    opacity_decay, scale_decay = float(options.opacity_decay), float(options.scale_decay)
    logits, scales = gaussians.opacity_logits, gaussians.log_scales
    with torch.no_grad():
        if opacity_decay > 0.0 and logits.grad is not None:
            opacity = torch.sigmoid(logits)
            logits.grad += (opacity_decay / len(gaussians)) * visible * opacity * (1.0 - opacity)
        if scale_decay > 0.0 and scales.grad is not None:
            scales.grad += (scale_decay / (len(gaussians) * extent)) * visible[:, None] * torch.exp(scales)


def limit_needles(log_scales: Float[Tensor, "n 3"], options: TrainConfig) -> None:
    """Leave no axis longer than `max_anisotropy` times the middle one, in place; 0: no limit."""
    if options.max_anisotropy > 0.0:
        a, b, c = log_scales.unbind(dim=1)
        low, high = torch.minimum(a, b), torch.maximum(a, b)
        middle = torch.maximum(low, torch.minimum(high, c))
        torch.minimum(log_scales, (middle + math.log(max(1.0, options.max_anisotropy)))[:, None], out=log_scales)
