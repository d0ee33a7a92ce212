"""A training loop as gsplat's users write it: its ``DefaultStrategy``, on what we have in place of its kernels."""

from __future__ import annotations

import math
import sys
import time
from typing import Any

import torch
from gsplat import DefaultStrategy
from torch import Tensor
from torch.nn import Parameter

from splatpipe.pipeline.raster.fused_adam import FusedAdam
from splatpipe.pipeline.raster.fused_ssim import fused_ssim
from splatpipe.pipeline.raster.isa import _native
from splatpipe.pipeline.raster.rasterization import rasterization

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
VIEWS, STEPS, START = 8, 700, 120
RATES = {"means": 2e-3, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh": 5e-3}
MODES: dict[str, Any] = {"sh_degree": 1, "rasterize_mode": "antialiased"}
SSIM_SHARE = 0.2


class CountingStrategy(DefaultStrategy):  # type: ignore[misc]
    """Counts what it cloned, split and pruned."""

    cloned = split = pruned = 0

    def _grow_gs(self, *arguments: Any) -> tuple[int, int]:
        cloned, split = super()._grow_gs(*arguments)
        self.cloned, self.split = self.cloned + cloned, self.split + split
        return cloned, split

    def _prune_gs(self, *arguments: Any) -> int:
        pruned: int = super()._prune_gs(*arguments)
        self.pruned += pruned
        return pruned


def cameras() -> tuple[Tensor, Tensor]:
    """Views from all around: viewmats (v, 4, 4), Ks (v, 3, 3)."""
    viewmats = torch.eye(4).repeat(VIEWS, 1, 1)
    for view in range(VIEWS):
        angle = 2.0 * math.pi * view / VIEWS
        viewmats[view, 0, 0] = viewmats[view, 2, 2] = math.cos(angle)
        viewmats[view, 0, 2], viewmats[view, 2, 0] = math.sin(angle), -math.sin(angle)
        viewmats[view, 2, 3] = 4.0
    ks = torch.tensor([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return viewmats, ks.repeat(VIEWS, 1, 1)


def photos(generator: torch.Generator) -> Tensor:
    """Images (v, h, w, 3) of three hundred small, opaque Gaussians of all colours in a ball."""
    count = 300
    means = torch.randn(count, 3, generator=generator)
    means = 1.2 * torch.rand(count, 1, generator=generator) ** (1 / 3) * means / means.norm(dim=-1, keepdim=True)
    scales = torch.exp(0.3 * torch.randn(count, 3, generator=generator) - 2.6)
    quats, colors = torch.randn(count, 4, generator=generator), torch.rand(count, 3, generator=generator)
    with torch.no_grad():
        shown, _, _ = rasterization(means, quats, scales, torch.full((count,), 0.95), colors, *cameras(), WIDTH, HEIGHT)
    return shown


def parameters(generator: torch.Generator) -> dict[str, Parameter]:
    """Few Gaussians to begin with: too large, grey, a quarter of them far off, where nothing is to be seen."""
    means = 0.7 * torch.randn(START, 3, generator=generator)
    means[: START // 4] *= 2.5
    return {
        "means": Parameter(means),
        "scales": Parameter(torch.full((START, 3), -1.8)),
        "quats": Parameter(torch.randn(START, 4, generator=generator)),
        "opacities": Parameter(torch.full((START,), -1.0)),
        "sh": Parameter(torch.zeros(START, 4, 3)),
    }


def shown(params: dict[str, Parameter], viewmats: Tensor, ks: Tensor) -> tuple[Tensor, dict[str, Any]]:
    images, _, info = rasterization(
        params["means"],
        params["quats"],
        torch.exp(params["scales"]),
        torch.sigmoid(params["opacities"]),
        params["sh"],
        viewmats,
        ks,
        WIDTH,
        HEIGHT,
        **MODES,
    )
    return images, info


def psnr(params: dict[str, Parameter], truth: Tensor) -> float:
    with torch.no_grad():
        return -10.0 * math.log10(float((shown(params, *cameras())[0].clamp(0.0, 1.0) - truth).square().mean()))


def test_gsplats_strategy_clones_splits_and_prunes_on_our_rasterization(capsys: Any) -> None:
    _native.set_threads(2)
    generator = torch.Generator().manual_seed(1)
    torch.manual_seed(1)  # of the strategy's samples
    truth, (viewmats, ks) = photos(generator), cameras()
    params = parameters(generator)
    optimizers = {name: FusedAdam([params[name]], lr=rate, eps=1e-15) for name, rate in RATES.items()}
    strategy = CountingStrategy(
        prune_opa=0.02,
        grow_grad2d=0.002,
        grow_scale3d=0.05,
        refine_start_iter=70,
        refine_stop_iter=490,
        refine_every=35,
        reset_every=315,
    )
    strategy.check_sanity(params, optimizers)
    state, begun, losses = strategy.initialize_state(scene_scale=2.0), time.perf_counter(), []
    before = psnr(params, truth)
    for step in range(STEPS):
        views = torch.randperm(VIEWS, generator=generator)[:1]
        images, info = shown(params, viewmats[views], ks[views])
        strategy.step_pre_backward(params, optimizers, state, step, info)
        similarity = fused_ssim(images.permute(0, 3, 1, 2), truth[views].permute(0, 3, 1, 2))
        loss = (1.0 - SSIM_SHARE) * (images - truth[views]).abs().mean() + SSIM_SHARE * (1.0 - similarity)
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        strategy.step_post_backward(params, optimizers, state, step, info)
        losses.append(float(loss.detach()))
    after, seconds = psnr(params, truth), time.perf_counter() - begun
    made = f"{strategy.cloned} cloned, {strategy.split} split, {strategy.pruned} pruned"
    last = sum(losses[-50:]) / 50
    with capsys.disabled():
        print(f"\n{STEPS} steps in {seconds:.0f} s; loss {losses[0]:.3f} to {last:.3f}")
        print(f"PSNR {before:.1f} to {after:.1f} dB; {made}; {START} to {len(params['means'])} Gaussians")
    assert strategy.cloned > 20 and strategy.split > 20 and strategy.pruned > 20
    assert len(params["means"]) > START
    assert after > before + 8.0 and last < 0.4 * losses[0]
    assert "gsplat.cuda._backend" not in sys.modules  # nothing of gsplat's kernels was needed
