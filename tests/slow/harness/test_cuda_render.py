"""CUDA tensors under autograd, with the kernels' sources on the CPU: chunks, memory, and what has no gradient."""

import pytest
import torch
from cuda_scenes import (
    CAMERA,
    LIMITS,
    OPTIONS,
    RATES,
    assert_stepped_alike,
    backward_of,
    trained,
    weighted,
)
from on_cpu import kernels_on_cpu, library_on_cpu
from random_scene import random_scene
from torch import Tensor

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.cuda.cuda_forecast import (
    FIRST_PASSES,
    Forecast,
    FrameFacts,
    FrameSize,
    most_pairs_of,
)
from splatpipe.pipeline.raster.cuda_frame import shot_of
from splatpipe.pipeline.raster.device import Device, cpu
from splatpipe.pipeline.raster.gradients import GradientBuffers
from splatpipe.pipeline.raster.isa import isa_name
from splatpipe.pipeline.raster.loss import photo_loss
from splatpipe.pipeline.raster.optim import Adam
from splatpipe.pipeline.raster.rasterizer import RenderOptions, render
from splatpipe.pipeline.splat.model.gaussians import Gaussians


@pytest.fixture
def kernels() -> CudaKernels:
    return kernels_on_cpu()


def test_a_second_backward_pass_adds_up(kernels):
    with use_kernels(kernels):
        scene = random_scene(0).requires_grad_()
        loss = weighted(render(scene, CAMERA, OPTIONS))
        loss.backward(retain_graph=True)
        once = scene.means.grad.clone()
        loss.backward()
        assert torch.equal(scene.means.grad, 2.0 * once)
        plain = scene.detach()
        plain.sh.requires_grad_()  # one parameter alone
        weighted(render(plain, CAMERA, OPTIONS)).backward()
        assert torch.equal(2.0 * plain.sh.grad, scene.sh.grad)
        assert plain.means.grad is None


def test_training_leaves_no_gradient_but_the_probes(kernels):
    scene, buffers, probe = random_scene(0).requires_grad_(), GradientBuffers(), torch.zeros(60, 2, requires_grad=True)
    optimizer = Adam(scene.tensors())
    with use_kernels(kernels):
        rendered = render(scene, CAMERA, OPTIONS, means2d_probe=probe, buffers=buffers)
        weighted(rendered).backward()
        assert buffers.unfinished is not None
        assert all(tensor.grad is None for tensor in (*scene.tensors().values(), probe))
        optimizer.step(scene.tensors(), RATES, rendered.visible, buffers)
    assert buffers.unfinished is None
    assert probe.grad is not None
    assert all(tensor.grad is None for tensor in scene.tensors().values())


@pytest.mark.parametrize("dropout", [False, True], ids=("whole", "dropout"))
def test_another_gradient_besides_the_renders_is_stepped_with_it(kernels, dropout):
    ours, expected = (trained(k, True, dropout, penalty=0.05) for k in (kernels, None))
    assert_stepped_alike(ours, expected)
    without = trained(None, True, dropout)
    assert not torch.allclose(without[0].means, expected[0].means, atol=1e-5)


def test_rows_that_were_not_chosen_can_be_skipped(kernels):
    scene, buffers = random_scene(0).requires_grad_(), GradientBuffers()
    optimizer, before, chosen = Adam(scene.tensors()), scene.detach().clone(), torch.arange(60) < 30
    with use_kernels(kernels):
        rendered = render(scene, CAMERA, OPTIONS, buffers=buffers)
        weighted(rendered).backward()
        optimizer.step(scene.tensors(), RATES, chosen, buffers)
    assert torch.equal(scene.means[30:], before.means[30:])
    moved = (scene.means.detach() != before.means).any(1)
    assert torch.equal(moved[:30], rendered.visible[:30])


@pytest.mark.parametrize("fused", [True, False], ids=("fused", "apart"))
def test_rows_with_gradients_that_are_not_finite_are_left_out_and_counted(kernels, fused):
    scene, buffers = random_scene(0).requires_grad_(), GradientBuffers()
    optimizer = Adam(scene.tensors())
    before = scene.detach().clone()
    with use_kernels(kernels):
        rendered = render(scene, CAMERA, OPTIONS, buffers=buffers if fused else None)
        row, column = (rendered.alpha > 0.5).nonzero()[0].tolist()
        upstream = torch.zeros_like(rendered.colour)
        upstream[row, column] = torch.inf
        rendered.colour.backward(upstream)
        optimizer.step(scene.tensors(), RATES, rendered.visible, buffers)
    skipped = optimizer.take_skipped()
    assert 0 < skipped <= int(rendered.visible.sum())
    assert optimizer.take_skipped() == 0
    unchanged = (scene.means.detach() == before.means).all(1)
    assert int((unchanged & rendered.visible).sum()) >= skipped
    assert all(bool(tensor.isfinite().all()) for tensor in (*scene.tensors().values(), *optimizer.mean.values()))


def test_a_view_in_many_chunks_has_the_same_bits_and_is_forecast(kernels):
    whole, gradients = backward_of(RenderOptions(3), kernels)
    assert kernels.forecast.room(FrameSize(60, 20)).passes == 1
    few = kernels_on_cpu()
    few.forecast.most_pairs = 1  # so that chunks hold as many pairs as there are Gaussians
    for _ in range(2):
        chunked, ours = backward_of(RenderOptions(3), few)
        assert all(torch.equal(getattr(chunked, name), picture) for name, picture in vars(whole).items())
        assert all(torch.equal(ours[name], gradient) for name, gradient in gradients.items())
    room = few.forecast.room(FrameSize(60, 20))
    assert room.capacity == 60
    assert 3 < room.passes < FIRST_PASSES


def test_what_was_not_forecast_is_still_rendered(kernels):
    whole, gradients = backward_of(RenderOptions(3), kernels)
    blind = kernels_on_cpu()
    blind.forecast.most_pairs = 1
    blind.forecast.update(FrameFacts(FrameSize(60, 20), 60, pairs=10, chunks=1))  # far too few
    assert blind.forecast.room(FrameSize(60, 20)).passes == 1
    chunked, ours = backward_of(RenderOptions(3), blind)
    assert all(torch.equal(getattr(chunked, name), picture) for name, picture in vars(whole).items())
    assert all(torch.equal(ours[name], gradient) for name, gradient in gradients.items())
    assert blind.forecast.room(FrameSize(60, 20)).passes > 3  # it has learned


def test_a_memory_limit_acts_like_a_smaller_device_while_it_lasts(kernels):
    kernels.forecast.most_pairs = most_pairs_of(24 << 30)
    with use_kernels(kernels):
        for limit_bytes, least in ((0, 24 << 30), (8 << 30, 8 << 30), (141 << 30, 24 << 30)):  # a smaller limit is kept
            with pytest.raises(MachineError), cpu().memory_limit(limit_bytes):
                assert kernels.forecast.most_pairs == most_pairs_of(least)
                raise MachineError("It fails.")
            assert kernels.forecast.most_pairs == most_pairs_of(24 << 30)


def test_forecast_never_waits(kernels, monkeypatch):
    monkeypatch.setattr("splatpipe.pipeline.raster.cuda.cuda_forecast.PendingFacts.arrived", lambda self: False)
    for _ in range(2):
        backward_of(OPTIONS, kernels)
    assert kernels.forecast.room(FrameSize(60, 20)).passes == FIRST_PASSES  # nothing is known yet
    monkeypatch.undo()
    assert kernels.forecast.room(FrameSize(60, 20)).passes == 1


class ShortOfMemory(CudaKernels):
    """Kernels on a device that never has more than some bytes free."""

    most_bytes = 1 << 40

    def empty(self, size_bytes: int) -> Tensor:
        if size_bytes > self.most_bytes:
            raise torch.OutOfMemoryError("out of memory")
        return super().empty(size_bytes)


def test_short_memory_makes_chunks_smaller_and_then_is_reported():
    kernels, scene = ShortOfMemory(library_on_cpu(), torch.device("cpu")), random_scene(0)
    with use_kernels(kernels):
        expected = render(scene, CAMERA, OPTIONS).colour
        kernels.forecast = Forecast()
        assert kernels.forecast.room(FrameSize(60, 20)).capacity > 200
        kernels.most_bytes = kernels.frame_bytes(shot_of(CAMERA, OPTIONS, 16), 60, 200)
        with pytest.raises(torch.OutOfMemoryError):  # training handles that itself, in order to report it
            render(scene.clone().requires_grad_(), CAMERA, OPTIONS, buffers=GradientBuffers())
        assert kernels.forecast.most_pairs == Forecast().most_pairs
        assert torch.equal(render(scene, CAMERA, OPTIONS).colour, expected)
        assert 60 <= kernels.forecast.most_pairs <= 200
        kernels.most_bytes = 100
        with pytest.raises(MachineError, match="60 Gaussians"):
            render(scene, CAMERA, OPTIONS)
        assert kernels.forecast.most_pairs == 60
        with pytest.raises(torch.OutOfMemoryError):  # training handles it
            render(scene.requires_grad_(), CAMERA, OPTIONS, buffers=GradientBuffers())
        assert not kernels.forecast.shrink()


class ShortOnce(CudaKernels):
    """Kernels on a device that once has no memory for the backward pass, the second of a frame's two allocations."""

    pieces = 0

    def empty(self, size_bytes: int) -> Tensor:
        self.pieces += 1
        if self.pieces == 2:
            raise torch.OutOfMemoryError("out of memory")
        return super().empty(size_bytes)


def test_an_iteration_repeated_with_smaller_chunks_has_the_same_result(kernels):
    expected = trained(kernels, sparse=True, dropout=False, steps=1)
    short = ShortOnce(library_on_cpu(), torch.device("cpu"))
    with pytest.raises(torch.OutOfMemoryError):
        trained(short, sparse=True, dropout=False, steps=1)
    assert short.forecast.shrink()
    ours = trained(short, sparse=True, dropout=False, steps=1)
    assert torch.equal(ours[2], expected[2])
    assert all(torch.equal(getattr(ours[0], name), tensor) for name, tensor in expected[0].tensors().items())


def test_an_empty_model_is_the_background(kernels):
    nothing, buffers = Gaussians.empty(0, 3).requires_grad_(), GradientBuffers()
    with use_kernels(kernels):
        render(nothing, CAMERA, OPTIONS).colour.sum().backward()
        assert nothing.means.grad.shape == (0, 3)
        for tensor in nothing.tensors().values():
            tensor.grad = None
        rendered = render(nothing, CAMERA, OPTIONS, buffers=buffers)
        torch.testing.assert_close(rendered.colour, torch.tensor(OPTIONS.background).expand(53, 70, 3))
        rendered.colour.sum().backward()
        Adam(nothing.tensors()).step(nothing.tensors(), RATES, rendered.visible, buffers, LIMITS)


def test_kernels_get_only_supported_inputs(kernels):
    with use_kernels(kernels):
        assert Device("", torch.device("cpu")).kernels == kernels.facts.described()
        doubles = random_scene(0).to(dtype=torch.float64)
        assert render(doubles, CAMERA, OPTIONS).colour.dtype == torch.float64
        with pytest.raises(ValueError, match="float64"):
            render(doubles, CAMERA, OPTIONS, backend="cuda")
        with pytest.raises(ValueError, match="a tensor on meta"):
            photo_loss(torch.rand(9, 9, 3), torch.rand(9, 9, 3, device="meta"))
    assert Device("", torch.device("cpu")).kernels == isa_name()
    with pytest.raises(ValueError, match="no CUDA kernels"):
        render(random_scene(0), CAMERA, OPTIONS, backend="cuda")
    with pytest.raises(ValueError, match="no kernels for meta"):
        _ = Device("", torch.device("meta")).kernels
