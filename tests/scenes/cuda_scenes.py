"""Renders and steps of a random scene, by CUDA kernels or the CPU's."""

from dataclasses import replace

import torch
from random_scene import random_camera, random_scene
from torch import Tensor

from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.cuda.cuda_forecast import (
    FrameFacts,
    FrameSize,
)
from splatpipe.pipeline.raster.gradients import GradientBuffers
from splatpipe.pipeline.raster.optim import Adam, sh_rates
from splatpipe.pipeline.raster.rasterizer import Render, RenderOptions, render
from splatpipe.pipeline.train.techniques.dropout import _DropoutLogits

# A step is the rate times a quotient of moments, and Adam divides by small ones: what differs in the tenth place of a
# gradient near zero differs in the third of its first step.
STEP_SHARE = 2e-2

RATES = {"means": 1e-3, "log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 5e-2, "sh": sh_rates(16, 2.5e-3, 1e-4)}

LIMITS = {"log_scales": (-2.5, -1.0)}

OPTIONS = RenderOptions(3, background=(0.2, 0.3, 0.4), depth=False)

CAMERA = random_camera(0)


def weighted(rendered: Render) -> Tensor:
    """Return a scalar that depends on every image with a gradient."""
    generator = torch.Generator().manual_seed(1)
    pictures = (rendered.colour, rendered.alpha, rendered.depth_sum, rendered.depth_square_sum)
    terms = [(p * torch.randn(p.shape, generator=generator)).sum() for p in pictures if p.requires_grad]
    return torch.stack(terms).sum()


def backward_of(options: RenderOptions, kernels: CudaKernels | None) -> tuple[Render, dict[str, Tensor]]:
    scene, probe = random_scene(0).requires_grad_(), torch.zeros(60, 2, requires_grad=True)
    with use_kernels(kernels):
        rendered = render(scene, CAMERA, options, means2d_probe=probe)
        weighted(rendered).backward()
    return rendered, {name: tensor.grad for name, tensor in (scene.tensors() | {"means2d": probe}).items()}


def trained(kernels: CudaKernels | None, sparse: bool, dropout: bool, penalty: float = 0.0, steps: int = 2):
    """The model, its optimiser and the last gradient of the probe after some steps."""
    scene = random_scene(0).requires_grad_()
    buffers = None if kernels is None else GradientBuffers()
    optimizer, kept = Adam(scene.tensors()), torch.arange(60) % 4 > 0
    with use_kernels(kernels):
        for _ in range(steps):
            model, probe = scene, torch.zeros(60, 2, requires_grad=True)
            if dropout:
                model = replace(scene, opacity_logits=_DropoutLogits.apply(scene.opacity_logits, kept, 0.25))
            rendered = render(model, CAMERA, OPTIONS, means2d_probe=probe, buffers=buffers)
            loss = weighted(rendered)
            if penalty:
                loss = loss + penalty * scene.means.square().sum()
            loss.backward()
            visible = rendered.visible if sparse else None
            optimizer.step(scene.tensors(), RATES, visible, buffers, LIMITS)
            assert (scene.sh.grad is None) == (kernels is not None and not penalty)  # where the step was fused
            for tensor in scene.tensors().values():
                tensor.grad = None
    return scene, optimizer, probe.grad


def assert_stepped_alike(ours, expected, steps: int = 2) -> None:
    start = random_scene(0)
    for name, tensor in expected[0].tensors().items():
        moved = (tensor.detach() - getattr(start, name)).abs().max()
        assert (getattr(ours[0], name) - tensor).abs().max() <= STEP_SHARE * moved, name
        for moments in ("mean", "square"):
            found, right = getattr(ours[1], moments)[name], getattr(expected[1], moments)[name]
            assert (found - right).norm() <= 1e-2 * right.norm(), (moments, name)
    assert (ours[2] - expected[2]).norm() <= 1e-2 * expected[2].norm()
    assert ours[1].step_count == expected[1].step_count == steps


def facts(pairs: int) -> FrameFacts:
    return FrameFacts(FrameSize(1000, 400), 100_000, pairs, chunks=1)
