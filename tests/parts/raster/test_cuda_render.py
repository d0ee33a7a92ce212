"""CUDA tensors under autograd, verified with the kernels' sources on the CPU: gradients, fused step, memory."""

import numpy as np
import pytest
import torch
from cuda_scenes import OPTIONS, assert_stepped_alike, backward_of, facts, trained
from on_cpu import kernels_on_cpu
from random_scene import random_scene

from splatpipe.pipeline.raster.colour import affine_colour
from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.cuda.cuda_forecast import (
    CAPACITY_MARGIN,
    FIRST_PASSES,
    WINDOW_FRAMES,
    Forecast,
    FrameSize,
    most_pairs_of,
)
from splatpipe.pipeline.raster.loss import photo_loss
from splatpipe.pipeline.raster.optim import Adam
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.train.densify import _split_offsets
from splatpipe.pipeline.train.random_numbers import SPLIT_POSITION, uniform

# Two float32 computations of the same sums in another order; between the backends the largest seen was 2e-6.
GRADIENT_RTOL = 1e-5


@pytest.fixture
def kernels() -> CudaKernels:
    return kernels_on_cpu()


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


@pytest.mark.parametrize("dropout", [False, True], ids=("whole", "dropout"))
@pytest.mark.parametrize("sparse", [True, False], ids=("seen", "all"))
def test_the_fused_step_is_the_backward_pass_and_the_step(kernels, sparse, dropout):
    assert_stepped_alike(trained(kernels, sparse, dropout), trained(None, sparse, dropout))


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


def test_forecast_keeps_the_recent_maximum_and_forgets_it():
    forecast, size = Forecast(), FrameSize(1000, 400)
    assert forecast.room(size).passes == FIRST_PASSES
    for pairs in (5000, 9000, 4000):
        forecast.update(facts(pairs))
    assert 9000 < forecast.room(size).capacity < 1.5 * 9000
    assert forecast.room(size).passes == 1
    for _ in range(2 * WINDOW_FRAMES):
        forecast.update(facts(4000))
    assert 4000 < forecast.room(size).capacity < 1.5 * 4000


def test_a_larger_device_holds_more_pairs_at_a_time_within_limits() -> None:
    sizes = [most_pairs_of(memory << 30) for memory in (0, 1, 8, 24, 141, 4096)]
    assert sizes == [1 << 22, 1 << 22, 1 << 23, 3 << 23, 141 << 20, 1 << 28]


def test_forecast_grows_with_the_model_and_the_picture_and_keeps_to_its_limit():
    forecast = Forecast(most_pairs=20_000)
    forecast.update(facts(8000))
    assert forecast.room(FrameSize(1500, 400)).capacity > 1.5 * 8000
    larger = forecast.room(FrameSize(1000, 4000))
    assert larger.capacity == 20_000
    assert larger.capacity * larger.passes > CAPACITY_MARGIN * 10 * 8000  # one more: chunks end with a tile
    assert forecast.room(FrameSize(50_000, 400)).capacity == 50_000  # any tile's pairs must fit
    assert forecast.room(FrameSize(10, 200_000)).passes > 3  # a chunk's tiles have 16 bits
