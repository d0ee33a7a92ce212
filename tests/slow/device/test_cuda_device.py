"""On a real device: what the harness cannot show. Run by ``benchmarks/gpu/gpu_visit.py``, without tests/conftest.py.

The kernels' numbers are proven without a device, by the harness; here, that the compiled ones give the same.
"""

import hashlib
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch import Tensor

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.colour import affine_colour
from splatpipe.pipeline.raster.cuda import cuda, cuda_library
from splatpipe.pipeline.raster.gradients import GradientBuffers
from splatpipe.pipeline.raster.loss import SSIM_REACH_PX, Rectangle, photo_loss
from splatpipe.pipeline.raster.optim import Adam
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import coefficient_count
from splatpipe.pipeline.splat.quality import metrics

MISSING = cuda_library.unavailable_reason()
pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(MISSING is not None, reason="" if MISSING is None else MISSING.reason),
]

CPU = torch.device("cpu")
COUNT = 20_000
WIDTH, HEIGHT = 403, 299  # no whole tiles
WHOLE = (0, 0, WIDTH, HEIGHT)
MIN_DB = 60.0  # between renders: single pixels lie on a threshold of alpha
MAX_RELATIVE = 1e-3  # error over a gradient's norm: equal terms in other orders of sums
SSIM_WEIGHT = 0.2


@pytest.fixture
def device() -> Iterator[torch.device]:
    yield torch.device("cuda", torch.cuda.current_device())
    torch.cuda.set_per_process_memory_fraction(1.0)
    torch.cuda.empty_cache()
    cuda._on_cuda.cache_clear()  # with the forecast from its earlier frames


def scene(count: int = COUNT) -> Gaussians:
    """Small and large Gaussians in front of the camera, some behind it, thousands overlapping."""
    generator = torch.Generator().manual_seed(11)
    model = Gaussians.empty(count, 3)
    model.means = torch.randn(count, 3, generator=generator) * torch.tensor([2.0, 1.5, 2.5]) + torch.tensor([0, 0, 5.0])
    model.log_scales = -3.5 + 0.8 * torch.randn(count, 3, generator=generator)
    model.log_scales[: count // 100] += 2.5
    model.quats = torch.randn(count, 4, generator=generator)
    model.opacity_logits = 1.5 * torch.randn(count, generator=generator)
    model.sh = 0.2 * torch.randn(count, coefficient_count(3), 3, generator=generator)
    return model


def camera(width: int = WIDTH, height: int = HEIGHT) -> Camera:
    return Camera("view", width, height, 0.8 * width, 0.81 * width, width / 2 + 2.5, height / 2 - 1.0, np.eye(4))


def photo(width: int = WIDTH, height: int = HEIGHT) -> Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(3))


def everything(model: Gaussians, where: torch.device, depth: bool, part: Rectangle = WHOLE) -> dict[str, Tensor]:
    """Return images, loss and gradients of a view or a window of it, whose rim does not count; moved to the CPU."""
    left, top, right, bottom = part
    here, view = (slice(top, bottom), slice(left, right)), camera().crop(left, top, right - left, bottom - top)
    inner = None if part == WHOLE else (SSIM_REACH_PX, SSIM_REACH_PX, view.width - 2, view.height - 2)
    leaves = model.clone().to(where).requires_grad_()
    probe = torch.zeros(len(model), 2, device=where, requires_grad=True)
    affine = (torch.eye(3, 4) + 0.05).to(where).requires_grad_()
    options = RenderOptions(3, (0.1, 0.5, 0.9), antialias=not depth, depth=depth, magnitudes=not depth)
    render = rasterizer.render(leaves, view, options, means2d_probe=probe)
    mask = (torch.arange(HEIGHT)[:, None] + torch.arange(WIDTH) > 100).to(where)
    compensated = affine_colour(render.colour, affine)
    loss = photo_loss(compensated, photo()[here].to(where), SSIM_WEIGHT, mask[here], inner)
    if depth:
        loss = loss + 0.01 * (render.depth_sum.mean() + render.depth_square_sum.mean())
    loss.backward()
    found = {name: tensor.grad for name, tensor in leaves.tensors().items()}
    found |= {"means2d": probe.grad, "affine": affine.grad, "loss": loss.detach(), "colour": render.colour.detach()}
    found |= {"alpha": render.alpha.detach(), "visible": render.visible, "radii": render.radii}
    return {name: tensor.cpu() for name, tensor in found.items() if tensor is not None}


def digest(tensors: dict[str, Tensor]) -> str:
    return hashlib.sha256(
        b"".join(tensors[name].contiguous().numpy().tobytes() for name in sorted(tensors))
    ).hexdigest()


def stepped(where: torch.device, steps: int = 3) -> dict[str, Tensor]:
    """Parameters after steps of Adam on one photo, by training's seam: the backward pass ends with the step."""
    model = scene().to(where).requires_grad_()
    adam, buffers = Adam(model.tensors()), GradientBuffers()
    rates: dict[str, float | Tensor] = dict.fromkeys(model.tensors(), 1e-3)
    for _ in range(steps):
        render = rasterizer.render(model, camera(), RenderOptions(3, depth=False), buffers=buffers)
        photo_loss(render.colour, photo().to(where), SSIM_WEIGHT).backward()
        with torch.no_grad():
            adam.step(model.tensors(), rates, render.visible, buffers=buffers)
        for tensor in model.tensors().values():
            tensor.grad = None
    return {name: tensor.detach().cpu() for name, tensor in model.tensors().items()}


@pytest.mark.parametrize("part", [WHOLE, (150, 80, 290, 211)])
@pytest.mark.parametrize("depth", [False, True])
def test_pictures_losses_and_gradients_are_the_cpus(device: torch.device, depth: bool, part: Rectangle) -> None:
    here, there = everything(scene(), CPU, depth, part), everything(scene(), device, depth, part)
    assert metrics.psnr(there.pop("colour"), here.pop("colour")) > MIN_DB
    assert (there.pop("alpha") - here.pop("alpha")).square().mean() < 10 ** (-MIN_DB / 10)
    seen_by_one = here.pop("visible") != there.pop("visible")
    assert seen_by_one.float().mean() < 1e-4  # ellipses that touch the image's edge
    assert set(here) == set(there)
    for name, expected in here.items():
        assert torch.isfinite(there[name]).all(), name
        assert (there[name] - expected).norm() <= MAX_RELATIVE * expected.norm(), name


def test_steps_are_the_cpus(device: torch.device) -> None:
    here, there, start = stepped(CPU), stepped(device), scene().tensors()
    for name, expected in here.items():
        # Adam's first steps follow a gradient's sign: where rounding decides it, the two may diverge by all steps.
        apart = (there[name] - expected).abs() > 1e-2 * (expected - start[name]).abs() + 1e-6
        assert apart.float().mean() < 2e-3, name


def test_the_same_bits_every_time_and_on_every_stream(device: torch.device) -> None:
    first = digest(everything(scene(), device, depth=True))
    assert digest(everything(scene(), device, depth=True)) == first
    other = torch.cuda.Stream(device)
    other.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(other):
        assert digest(everything(scene(), device, depth=True)) == first
    assert digest(stepped(device)) == digest(stepped(device))


@pytest.mark.parametrize("most_pairs", [1 << 22, 1 << 16, 1])
def test_chunks_do_not_change_a_bit(device: torch.device, most_pairs: int) -> None:
    expected = digest(everything(scene(), device, depth=False))
    kernels = cuda.kernels_of(device)
    assert kernels is not None
    kernels.forecast.most_pairs = most_pairs
    for _ in range(2):  # not forecast at first, so that a cooperative launch does the rest; then forecast
        assert digest(everything(scene(), device, depth=False)) == expected
        torch.cuda.synchronize(device)


def test_short_memory_leads_to_smaller_chunks_with_the_same_bits(device: torch.device) -> None:
    model, view, options = scene().to(device), camera(1600, 1200), RenderOptions(3, depth=False)
    model.log_scales += 3.0  # hundreds of tiles each: nearly all of a frame's memory is for pairs
    with torch.no_grad():
        expected = rasterizer.render(model, view, options).colour
        torch.cuda.synchronize(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        rasterizer.render(model, view, options)  # with the capacity that the first one requested
        wanted = torch.cuda.max_memory_allocated(device) - before
        kernels = cuda.kernels_of(device)
        assert kernels is not None
        full, most = torch.cuda.get_device_properties(device).total_memory, kernels.forecast.most_pairs
        torch.cuda.empty_cache()
        torch.cuda.set_per_process_memory_fraction((torch.cuda.memory_reserved(device) + 0.75 * wanted) / full)
        assert torch.equal(rasterizer.render(model, view, options).colour, expected)
        assert kernels.forecast.most_pairs < most


def test_insufficient_memory_is_reported(device: torch.device) -> None:
    model, options = scene().to(device), RenderOptions(3, depth=False)
    torch.cuda.empty_cache()
    full = torch.cuda.get_device_properties(device).total_memory
    torch.cuda.set_per_process_memory_fraction(torch.cuda.memory_reserved(device) / full)
    with pytest.raises(MachineError, match="Not enough memory on the graphics card"):
        rasterizer.render(model, camera(1600, 1200), options)
    with pytest.raises(torch.OutOfMemoryError):  # in training, which then lowers its cap
        rasterizer.render(model, camera(1600, 1200), options, buffers=GradientBuffers())


def test_draws_are_those_of_train_draws(device: torch.device) -> None:
    from splatpipe.pipeline.train.random_numbers import uniform

    kernels = cuda.kernels_of(device)
    assert kernels is not None
    expected = uniform(5, 600, 1, np.arange(10_000))
    assert np.array_equal(kernels.uniform(5, 600, 1, 10_000).cpu().numpy(), np.asarray(expected))
