"""A CUDA step of the first rendered rows, as in a block's training, with the kernels' sources on the CPU."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from on_cpu import kernels_on_cpu
from random_scene import random_camera, random_scene
from torch import Tensor

from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.gradients import GradientBuffers
from splatpipe.pipeline.raster.optim import Adam, sh_rates
from splatpipe.pipeline.raster.rasterizer import RenderOptions, render
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.techniques.dropout import _DropoutLogits

RATES = {"means": 1e-3, "log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 5e-2, "sh": sh_rates(16, 2.5e-3, 1e-4)}
OPTIONS = RenderOptions(3, background=(0.2, 0.3, 0.4), depth=False)
CAMERA = random_camera(0)


@pytest.mark.parametrize("dropout", [False, True], ids=("whole", "dropout"))
@pytest.mark.parametrize("sparse", [True, False], ids=("seen", "all"))
def test_only_the_first_rows_can_be_stepped_without_storing_gradients(
    sparse: bool, dropout: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a block's training: the others are rendered around it."""
    kernels, count, found = kernels_on_cpu(), 35, []
    called: list[str] = []
    call, weight = CudaKernels.call, torch.rand(CAMERA.height, CAMERA.width, 3)
    monkeypatch.setattr(CudaKernels, "call", lambda self, name, *given: (called.append(name), call(self, name, *given)))
    for fused in (True, False):
        whole = random_scene(0).requires_grad_()
        scene, buffers = whole.detach().first(count), GradientBuffers() if fused else None
        optimizer, probe = Adam(scene.tensors()), torch.zeros(1, 2).expand(len(whole), 2).requires_grad_()
        model = whole
        if dropout:
            kept = torch.arange(len(whole)) % 4 > 0
            model = replace(whole, opacity_logits=_DropoutLogits.apply(whole.opacity_logits, kept, 0.25))
        called.clear()
        with use_kernels(kernels):
            rendered = render(model, CAMERA, OPTIONS, means2d_probe=probe, buffers=buffers)
            (rendered.colour * weight).sum().backward()
            for name, tensor in scene.tensors().items():
                gradient = whole.tensors()[name].grad
                tensor.grad = None if gradient is None else gradient[:count]
            rows = rendered.visible[:count] if sparse else None
            optimizer.step(scene.tensors(), RATES, rows, buffers, {"log_scales": (-2.5, -1.5)})
        assert ("splat_step" in called, "splat_project_backward" in called) == (fused, not fused)
        assert int(rendered.visible[count:].sum()) > 5
        assert all(torch.equal(ours[count:], rest[count:]) for ours, rest in rows_of(whole, random_scene(0)))
        assert not (fused and bool(probe.grad[count:].any()))
        found.append([*scene.tensors().values(), *optimizer.mean.values(), *optimizer.square.values()])
        found[-1].append(probe.grad[:count])
    for ours, expected in zip(*found, strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-6)


def rows_of(one: Gaussians, other: Gaussians) -> list[tuple[Tensor, Tensor]]:
    return list(zip(one.detach().tensors().values(), other.tensors().values(), strict=True))
