"""CUDA tensors under autograd, verified with the kernels' sources on the CPU: gradients, fused step, memory."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.raster.colour import affine_colour
from splatpipe.pipeline.raster.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.cuda_forecast import (
    FIRST_PASSES,
    MARGIN,
    WINDOW,
    Forecast,
    FrameFacts,
    FrameSize,
    most_pairs_of,
)
from splatpipe.pipeline.raster.cuda_frame import shot_of
from splatpipe.pipeline.raster.device import cpu
from splatpipe.pipeline.raster.loss import photo_loss
from splatpipe.pipeline.raster.optim import Adam, sh_rates
from splatpipe.pipeline.raster.rasterizer import GradientBuffers, Render, RenderOptions, isa_name, kernels_name, render
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.train.densify import _split_offsets
from splatpipe.pipeline.train.dropout import _DropoutLogits
from splatpipe.pipeline.train.random_numbers import SPLIT_POSITION, uniform

sys.path.insert(0, str(Path(__file__).parent / "harness"))
sys.path.insert(0, str(Path(__file__).parent / "scenes"))
from on_cpu import kernels_on_cpu, library_on_cpu
from random_scene import random_camera, random_scene

# Two float32 computations of the same sums in another order; between the backends the largest seen was 2e-6.
GRADIENT_RTOL = 1e-5
# A step is the rate times a quotient of moments, and Adam divides by small ones: what differs in the tenth place of a
# gradient near zero differs in the third of its first step.
STEP_SHARE = 2e-2
RATES = {"means": 1e-3, "log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 5e-2, "sh": sh_rates(16, 2.5e-3, 1e-4)}
LIMITS = {"log_scales": (-2.5, -1.0)}
OPTIONS = RenderOptions(3, background=(0.2, 0.3, 0.4), depth=False)
CAMERA = random_camera(0)


@pytest.fixture
def kernels() -> CudaKernels:
    return kernels_on_cpu()


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


@pytest.mark.parametrize(
    "options",
    [OPTIONS, RenderOptions(3, depth_origin=2.0, near=3.0), RenderOptions(1, antialias=True, magnitudes=True)],
    ids=("colour", "depth", "alias"),
)
def test_pictures_and_gradients_are_the_cpus(kernels, options):
    expected, gradients = backward_of(options, None)
    rendered, ours = backward_of(options, kernels)
    for name, picture in vars(expected).items():
        torch.testing.assert_close(getattr(rendered, name), picture, rtol=1e-5, atol=2e-5, msg=name)
    for name, gradient in gradients.items():
        assert (ours[name] - gradient).norm() <= GRADIENT_RTOL * gradient.norm(), name


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


@pytest.mark.parametrize("dropout", [False, True], ids=("whole", "dropout"))
@pytest.mark.parametrize("sparse", [True, False], ids=("seen", "all"))
def test_the_fused_step_is_the_backward_pass_and_the_step(kernels, sparse, dropout):
    assert_stepped_alike(trained(kernels, sparse, dropout), trained(None, sparse, dropout))


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


def test_loss_and_colours_are_the_cpus(kernels):
    generator = torch.Generator().manual_seed(3)
    photo, mask = torch.rand(41, 37, 3, generator=generator), torch.rand(41, 37, generator=generator) > 0.2
    start, turn = (
        torch.rand(41, 37, 3, generator=generator),
        torch.eye(3, 4) + 0.1 * torch.rand(3, 4, generator=generator),
    )
    found = []
    for device in (None, kernels):
        picture, affine = start.clone().requires_grad_(), turn.clone().requires_grad_()
        with use_kernels(device):
            loss = 3.0 * photo_loss(affine_colour(picture, affine), photo, 0.2, mask)
            loss.backward()
        found.append((loss.detach(), picture.grad, affine.grad))
    for ours, expected in zip(found[1], found[0], strict=True):
        torch.testing.assert_close(ours, expected, rtol=2e-4, atol=1e-8)


def test_adam_alone_is_the_cpus(kernels):
    found = []
    for device in (None, kernels):
        generator = torch.Generator().manual_seed(4)
        tensors = {
            name: torch.randn(50, size, generator=generator).requires_grad_() for name, size in (("a", 3), ("b", 12))
        }
        optimizer, visible = Adam(tensors), torch.rand(50, generator=generator) > 0.3
        with use_kernels(device):
            for _ in range(3):
                for tensor in tensors.values():
                    tensor.grad = torch.randn(tensor.shape, generator=generator)
                optimizer.step(tensors, {"a": 0.1, "b": torch.arange(12) * 0.01}, visible, limits={"a": (-1.0, 1.0)})
        found.append([tensor.detach() for tensor in (*tensors.values(), *optimizer.state_dict().values())])
    for ours, expected in zip(found[1], found[0], strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-5, atol=1e-7)


def test_draws_and_places_are_the_cpus(kernels):
    draw, scene = (-7, 300, SPLIT_POSITION), random_scene(0)
    assert torch.equal(kernels.uniform(*draw, 100), torch.from_numpy(uniform(*draw, np.arange(100))))
    rows = torch.tensor([3, 59, 20])
    offsets = kernels.split_offsets(draw, rows, scene.log_scales, scene.quats)
    torch.testing.assert_close(offsets, _split_offsets(scene, rows, *draw[:2]), rtol=1e-4, atol=1e-5)
    means = torch.tensor([[1.9, 1.9, 1.9], [0.1, 0.1, 0.1], [1.9, 0.1, 0.1], [0.1, 0.2, 0.1]])
    assert kernels.morton(means, (0.0, 0.0, 0.0), (2.0, 2.0, 2.0)).argsort().tolist() == [1, 3, 2, 0]


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
    blind.forecast.learn(FrameFacts(FrameSize(60, 20), 60, pairs=10, chunks=1))  # far too few
    assert blind.forecast.room(FrameSize(60, 20)).passes == 1
    chunked, ours = backward_of(RenderOptions(3), blind)
    assert all(torch.equal(getattr(chunked, name), picture) for name, picture in vars(whole).items())
    assert all(torch.equal(ours[name], gradient) for name, gradient in gradients.items())
    assert blind.forecast.room(FrameSize(60, 20)).passes > 3  # it has learned


def facts(pairs: int) -> FrameFacts:
    return FrameFacts(FrameSize(1000, 400), 100_000, pairs, chunks=1)


def test_forecast_keeps_the_recent_maximum_and_forgets_it():
    forecast, size = Forecast(), FrameSize(1000, 400)
    assert forecast.room(size).passes == FIRST_PASSES
    for pairs in (5000, 9000, 4000):
        forecast.learn(facts(pairs))
    assert 9000 < forecast.room(size).capacity < 1.5 * 9000
    assert forecast.room(size).passes == 1
    for _ in range(2 * WINDOW):
        forecast.learn(facts(4000))
    assert 4000 < forecast.room(size).capacity < 1.5 * 4000


def test_a_larger_device_holds_more_pairs_at_a_time_within_limits() -> None:
    sizes = [most_pairs_of(memory << 30) for memory in (0, 1, 8, 24, 141, 4096)]
    assert sizes == [1 << 22, 1 << 22, 1 << 23, 3 << 23, 141 << 20, 1 << 28]


def test_a_memory_limit_acts_like_a_smaller_device_while_it_lasts(kernels):
    kernels.forecast.most_pairs = most_pairs_of(24 << 30)
    with use_kernels(kernels):
        for limit_bytes, least in ((0, 24 << 30), (8 << 30, 8 << 30), (141 << 30, 24 << 30)):  # a smaller limit is kept
            with pytest.raises(MachineError), cpu().memory_limit(limit_bytes):
                assert kernels.forecast.most_pairs == most_pairs_of(least)
                raise MachineError("It fails.")
            assert kernels.forecast.most_pairs == most_pairs_of(24 << 30)


def test_forecast_grows_with_the_model_and_the_picture_and_keeps_to_its_limit():
    forecast = Forecast(most_pairs=20_000)
    forecast.learn(facts(8000))
    assert forecast.room(FrameSize(1500, 400)).capacity > 1.5 * 8000
    larger = forecast.room(FrameSize(1000, 4000))
    assert larger.capacity == 20_000
    assert larger.capacity * larger.passes > MARGIN * 10 * 8000  # one more: chunks end with a tile
    assert forecast.room(FrameSize(50_000, 400)).capacity == 50_000  # any tile's pairs must fit
    assert forecast.room(FrameSize(10, 200_000)).passes > 3  # a chunk's tiles have 16 bits


def test_forecast_never_waits(kernels, monkeypatch):
    monkeypatch.setattr("splatpipe.pipeline.raster.cuda_forecast.PendingFacts.arrived", lambda self: False)
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
        assert kernels_name(torch.device("cpu")) == kernels.facts.described()
        doubles = random_scene(0).to(dtype=torch.float64)
        assert render(doubles, CAMERA, OPTIONS).colour.dtype == torch.float64
        with pytest.raises(ValueError, match="float64"):
            render(doubles, CAMERA, OPTIONS, backend="cuda")
        with pytest.raises(ValueError, match="a tensor on meta"):
            photo_loss(torch.rand(9, 9, 3), torch.rand(9, 9, 3, device="meta"))
    assert kernels_name(torch.device("cpu")) == isa_name()
    with pytest.raises(ValueError, match="no CUDA kernels"):
        render(random_scene(0), CAMERA, OPTIONS, backend="cuda")
    with pytest.raises(ValueError, match="no kernels for meta"):
        kernels_name(torch.device("meta"))
