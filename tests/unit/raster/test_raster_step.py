"""The backward pass fused with the optimiser's step: bit-identical to running them one after the other."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from random_scene import random_camera, random_scene
from torch import Tensor

from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.gradients import GradientBuffers
from splatpipe.pipeline.raster.optim import Adam, sh_rates
from splatpipe.pipeline.raster.rasterizer import RenderOptions, render
from splatpipe.pipeline.raster.step_lengths import FarSteps
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.techniques.dropout import _DropoutLogits

LIMITS = {"log_scales": (-2.5, -1.0)}
WIDE, TALL = random_camera(0), random_camera(3, 31, 64)
STEPS = 4
FAR = FarSteps((0.3, -0.2, 0.1), 2.0)  # in the middle of the scenes


pytestmark = pytest.mark.usefixtures("isa")


def rates_of(scene: Gaussians) -> dict[str, float | Tensor]:
    plain = {"means": 1e-3, "log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 5e-2}
    return plain | {"sh": sh_rates(scene.sh.shape[1], 2.5e-3, 1e-4)}


def spread_scene(n: int, sh_degree: int) -> Gaussians:
    """Rows that are seen lie between others that are not, and whole runs side by side."""
    scene = random_scene(5, n, sh_degree)
    scene.means[n // 3 : n // 2, 0] += 40.0
    scene.means[::3, 2] -= 40.0
    return scene


def trained(start: Gaussians, fused: bool, dropout: bool = False, magnitudes: bool = False) -> list[Tensor]:
    """Parameters, moments and all gradients of the probe after some steps."""
    scene, buffers = start.clone().requires_grad_(), GradientBuffers() if fused else None
    optimizer, probes = Adam(scene.tensors()), []
    kept = torch.arange(len(scene)) % 4 > 0
    for step in range(STEPS):
        model, probe = scene, torch.zeros(len(scene), 2, requires_grad=True)
        if dropout:
            model = replace(scene, opacity_logits=_DropoutLogits.apply(scene.opacity_logits, kept, 0.25))
        options = RenderOptions(min(step, scene.sh_degree), depth=step % 2 == 1, magnitudes=magnitudes)
        rendered = render(model, (WIDE, TALL)[step % 2], options, means2d_probe=probe, buffers=buffers)
        pictures = (rendered.colour, rendered.alpha, rendered.depth_square_sum)
        torch.stack([picture.square().mean() for picture in pictures if picture.requires_grad]).sum().backward()
        assert (scene.sh.grad is None) == fused
        optimizer.step(scene.tensors(), rates_of(scene), rendered.visible, buffers, LIMITS, FAR)
        assert probe.grad.is_sparse == fused
        probes.append(probe.grad.to_dense())
        for tensor in scene.tensors().values():
            tensor.grad = None
    return [*scene.tensors().values(), *optimizer.mean.values(), *optimizer.square.values(), *probes]


@pytest.mark.parametrize("count", [0, 1, 33, 3000])
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_the_fused_step_has_the_bits_of_backward_pass_and_step(count: int, sh_degree: int) -> None:
    start = spread_scene(count, sh_degree)
    for ours, right in zip(trained(start, True), trained(start, False), strict=True):
        assert torch.equal(ours, right)


@pytest.mark.parametrize("dropout", [False, True], ids=("whole", "dropout"))
@pytest.mark.parametrize("magnitudes", [False, True], ids=("sums", "magnitudes"))
def test_left_out_rows_and_statistics_are_the_same(dropout: bool, magnitudes: bool) -> None:
    start = spread_scene(500, 3)
    ours, right = (trained(start, fused, dropout, magnitudes) for fused in (True, False))
    assert all(torch.equal(mine, other) for mine, other in zip(ours, right, strict=True))


def test_any_number_of_threads_gives_the_same_bits() -> None:
    start, found = spread_scene(5000, 3), []
    for threads in (1, 2, 5):
        _native.set_threads(threads)
        found.append(trained(start, True))
    assert all(torch.equal(one, other) for each in found[1:] for one, other in zip(found[0], each, strict=True))


def test_rows_with_gradients_that_are_not_finite_are_unchanged_and_counted() -> None:
    found = []
    for buffers in (GradientBuffers(), None):
        scene = random_scene(0).requires_grad_()
        optimizer, before = Adam(scene.tensors()), scene.detach().clone()
        rendered = render(scene, WIDE, RenderOptions(3, depth=False), buffers=buffers)
        row, column = (rendered.alpha > 0.5).nonzero()[0].tolist()
        upstream = torch.zeros_like(rendered.colour)
        upstream[row, column] = torch.inf
        rendered.colour.backward(upstream)
        optimizer.step(scene.tensors(), rates_of(scene), rendered.visible, buffers)
        skipped = optimizer.take_skipped()
        assert 0 < skipped <= int(rendered.visible.sum())
        unchanged = (scene.means.detach() == before.means).all(1)
        assert int((unchanged & rendered.visible).sum()) >= skipped
        found.append([skipped, *scene.tensors().values(), *optimizer.mean.values()])
    assert found[0][0] == found[1][0]
    assert all(torch.equal(ours, right) for ours, right in zip(found[0][1:], found[1][1:], strict=True))


@pytest.mark.parametrize("reason", ["another gradient", "other rows", "all rows"])
def test_steps_that_cannot_be_fused_run_separately(reason: str) -> None:
    found = []
    for buffers in (GradientBuffers(), None):
        scene = random_scene(1).requires_grad_()
        optimizer = Adam(scene.tensors())
        rendered = render(scene, WIDE, RenderOptions(3, depth=False), buffers=buffers)
        loss = rendered.colour.square().mean()
        (loss + 0.05 * scene.means.square().sum() if reason == "another gradient" else loss).backward()
        rows = {"other rows": torch.arange(60) < 30, "all rows": None}.get(reason, rendered.visible)
        optimizer.step(scene.tensors(), rates_of(scene), rows, buffers)
        found.append([*scene.tensors().values(), *optimizer.mean.values()])
    assert all(torch.equal(ours, right) for ours, right in zip(*found, strict=True))


@pytest.mark.parametrize("dropout", [False, True], ids=("whole", "dropout"))
def test_only_the_first_rows_can_be_stepped(dropout: bool) -> None:
    found, count = [], 330
    for fused in (True, False):
        whole = spread_scene(500, 3).requires_grad_()
        scene, buffers = whole.detach().first(count), GradientBuffers() if fused else None
        optimizer, probe = Adam(scene.tensors()), torch.zeros(1, 2).expand(500, 2).requires_grad_()
        model = whole
        if dropout:
            model = replace(
                whole, opacity_logits=_DropoutLogits.apply(whole.opacity_logits, torch.arange(500) % 4 > 0, 0.25)
            )
        rendered = render(model, WIDE, RenderOptions(3, depth=False), means2d_probe=probe, buffers=buffers)
        rendered.colour.square().mean().backward()
        for name, tensor in scene.tensors().items():
            gradient = whole.tensors()[name].grad
            tensor.grad = None if gradient is None else gradient[:count]
        optimizer.step(scene.tensors(), rates_of(scene), rendered.visible[:count], buffers, LIMITS)
        assert 0 < int(rendered.visible[:count].sum()) < int(rendered.visible.sum())
        rows = probe.grad.to_dense()
        assert not (fused and bool(rows[count:].any()))
        found.append([*whole.tensors().values(), *optimizer.mean.values(), *optimizer.square.values(), rows[:count]])
    assert all(torch.equal(ours, right) for ours, right in zip(*found, strict=True))


def test_a_step_touches_no_row_that_is_not_seen() -> None:
    scene, buffers = spread_scene(300, 3).requires_grad_(), GradientBuffers()
    optimizer, before = Adam(scene.tensors()), scene.detach().clone()
    for moments in (optimizer.mean, optimizer.square):
        for tensor in moments.values():
            tensor.fill_(0.5)
    rendered = render(scene, WIDE, RenderOptions(3, depth=False), buffers=buffers)
    rendered.colour.square().mean().backward()
    assert buffers.unfinished is not None
    optimizer.step(scene.tensors(), rates_of(scene), rendered.visible, buffers)
    assert buffers.unfinished is None
    unseen = ~rendered.visible
    assert 0 < int(unseen.sum()) < 300
    for name, tensor in scene.tensors().items():
        assert torch.equal(tensor[unseen], getattr(before, name)[unseen]), name
        assert not bool((tensor[~unseen] == getattr(before, name)[~unseen]).all())
        for moments in (optimizer.mean, optimizer.square):
            assert bool((moments[name][unseen] == 0.5).all()) and bool((moments[name][~unseen] != 0.5).any())


def test_all_scales_are_clamped_at_the_first_step_and_after_rows_were_exchanged() -> None:
    scene, buffers = spread_scene(90, 3).requires_grad_(), GradientBuffers()
    optimizer, (least, most) = Adam(scene.tensors()), LIMITS["log_scales"]
    for exchanged in (False, True):
        if exchanged:
            optimizer.select(torch.arange(90))
            scene.log_scales.detach().add_(1.0)
        rendered = render(scene, WIDE, RenderOptions(3, depth=False), buffers=buffers)
        rendered.colour.square().mean().backward()
        assert not bool(((scene.log_scales >= least) & (scene.log_scales <= most))[~rendered.visible].all())
        optimizer.step(scene.tensors(), rates_of(scene), rendered.visible, buffers, LIMITS)
        assert bool(((scene.log_scales >= least) & (scene.log_scales <= most)).all())
