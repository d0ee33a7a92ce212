"""Dropout, for captures of few views."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.schedule import resolve_schedule
from splatpipe.pipeline.train.techniques.dropout import dropped, share_at

FRONT = Camera("front", 32, 24, 30.0, 30.0, 16.0, 12.0, np.eye(4))


def wall(depth: float, count: int = 30) -> Gaussians:
    """An opaque wall of Gaussians across the view of ``FRONT``, some of them nearer by up to a tenth."""
    generator = torch.Generator().manual_seed(2)
    gaussians = Gaussians.empty(count, 1)
    gaussians.means = (torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([3.0, 2.4, 0.2])
    # Evenly apart: where two change places in the order, a sum of slanted depths jumps.
    gaussians.means[:, 2] = depth + 0.2 * (torch.argsort(gaussians.means[:, 2]).argsort() / count - 0.5)
    gaussians.log_scales = torch.full((count, 3), math.log(0.35)) + 0.2 * torch.rand(count, 3, generator=generator)
    gaussians.quats = torch.randn(count, 4, generator=generator)
    gaussians.opacity_logits = 1.0 + torch.rand(count, generator=generator)
    return gaussians


def test_share_of_dropped_gaussians_rises_to_the_option_and_they_are_not_projected() -> None:
    schedule = resolve_schedule(TrainConfig(iterations=100, dropout=0.4))
    gaussians = Gaussians.concat([wall(4.0)] * 100).requires_grad_()
    for iteration in (25, 100, 300):
        share = share_at(schedule, iteration)
        assert share == pytest.approx(0.4 * min(1.0, iteration / 100))
        model = dropped(gaussians, schedule, iteration)
        left_out = model.opacity_logits.detach() < -20.0
        assert float(left_out.float().mean()) == pytest.approx(share, abs=4.0 * math.sqrt(0.25 / len(gaussians)))
        rendered = rasterizer.render(model, FRONT, rasterizer.RenderOptions(sh_degree=0))
        assert not bool(rendered.visible[left_out].any())
        gaussians.opacity_logits.grad = None
        rendered.colour.sum().backward()
        assert not bool(gaussians.opacity_logits.grad[left_out].any())
    assert not torch.equal(dropped(gaussians, schedule, 98).opacity_logits, model.opacity_logits)
    again = dropped(gaussians, schedule, 300).opacity_logits
    assert torch.equal(again, model.opacity_logits)
    assert dropped(gaussians, resolve_schedule(TrainConfig(dropout=0.0)), 50) is gaussians


def test_dropping_keeps_what_a_pixel_shows_on_average() -> None:
    schedule = resolve_schedule(TrainConfig(iterations=1, dropout=0.25))
    gaussians = wall(4.0)
    gaussians.opacity_logits -= 1.5  # below 0.75, so that no scaled opacity reaches 1
    settings = rasterizer.RenderOptions(sh_degree=0)
    with torch.no_grad():
        whole = rasterizer.render(gaussians, FRONT, settings).alpha
        draws = [rasterizer.render(dropped(gaussians, schedule, draw), FRONT, settings).alpha for draw in range(1, 401)]
    stacked = torch.stack(draws)
    error = (stacked.mean(dim=0) - whole).abs()
    # Five standard errors, and the flanks of up to three Gaussians that only scaled opacities lift above 1/255.
    assert bool((error < 5.0 * stacked.std(dim=0) / math.sqrt(len(draws)) + 3.0 / 255.0).all())
    assert float(error.mean()) < 0.01 < 0.05 * float(whole.mean())


def test_gradient_through_dropping_is_that_of_the_scaled_opacity() -> None:
    schedule = resolve_schedule(TrainConfig(iterations=1, dropout=0.25))
    logits = torch.linspace(-6.0, 0.9, 40).requires_grad_()
    gaussians = replace(wall(4.0, 40), opacity_logits=logits)
    torch.sigmoid(dropped(gaussians, schedule, 7).opacity_logits).sum().backward()
    kept = dropped(gaussians, schedule, 7).opacity_logits.detach() > -20.0
    opacity = torch.sigmoid(logits.detach())
    torch.testing.assert_close(logits.grad, kept * opacity * (1.0 - opacity) / 0.75, rtol=1e-4, atol=1e-7)
