"""Decay of opacity and size: what the photos do not ask for goes.

Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", NeurIPS 2024: the loss has λ_o · mean(α) and
λ_s · mean(s) besides, s being the scales in a frame whose extent is about 5.
"""

from __future__ import annotations

import torch

from splatpipe.pipeline.scene.gaussians import Gaussians
from splatpipe.stages.line import TrainConfig


def add_decay(gaussians: Gaussians, options: TrainConfig) -> None:
    """Add the decays' gradients to those of the loss, in place.

    Args:
        gaussians: With the loss's gradients; without them nothing is added.
        options: Resolved.
    """
    opacity_decay, scale_decay = float(options.opacity_decay), float(options.scale_decay)
    logits, log_scales = gaussians.opacity_logits, gaussians.log_scales
    if opacity_decay > 0.0 and logits.grad is not None:
        opacity = torch.sigmoid(logits.detach())
        logits.grad += opacity_decay / len(logits) * opacity * (1.0 - opacity)
    if scale_decay > 0.0 and log_scales.grad is not None:
        log_scales.grad += scale_decay / log_scales.numel() * torch.exp(log_scales.detach())
