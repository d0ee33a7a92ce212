"""Whole iterations on a CUDA device against the CPU's; without one, the kernels' sources on the CPU."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
import torch
from on_cpu import kernels_on_cpu
from random_scene import random_camera, random_scene
from torch import Tensor
from waiting import never_waiting

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.colour import affine_colour
from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, kernels_of, use_kernels
from splatpipe.pipeline.raster.cuda.cuda_library import unavailable_reason
from splatpipe.pipeline.raster.device import Device
from splatpipe.pipeline.raster.gradients import GradientBuffers
from splatpipe.pipeline.raster.loss import photo_loss
from splatpipe.pipeline.raster.optim import Adam, sh_rates
from splatpipe.pipeline.raster.rasterizer import RenderOptions, render
from splatpipe.pipeline.splat.model.gaussians import Gaussians

MIN_PSNR = 60.0  # agreement of a device's render with the CPU's, dB: an eighth of a step of eight bits
GRADIENT_RTOL = 1e-3  # L2; the device's exponential and reciprocals are faster and less exact
RATES = {"means": 1e-4, "log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 5e-2, "sh": sh_rates(16, 2.5e-3, 1.25e-4)}
STEPS = 3
# A step is the rate times a quotient of moments: gradients near zero differ in their sign, and their rows in the step.
STEP_SHARE = 0.02


@dataclass(frozen=True)
class DeviceSetup:
    """Where the kernels run, and how large a scene they get there.

    Attributes:
        kernels: None on a real device, which has its own.
        device: Of the tensors.
        scene: On the CPU.
        camera: Sees most of it.
    """

    kernels: CudaKernels | None
    device: torch.device
    scene: Gaussians
    camera: Camera


@pytest.fixture(params=["harness", pytest.param("cuda", marks=pytest.mark.cuda)])
def place(request: pytest.FixtureRequest) -> Iterator[DeviceSetup]:
    if request.param == "cuda":
        if not torch.cuda.is_available():
            pytest.skip("no CUDA device")
        reason = unavailable_reason()
        assert reason is None, reason
        scene = random_scene(1, n=50_000, size=-4.0)
        yield DeviceSetup(None, torch.device("cuda", 0), scene, random_camera(1, 801, 499))
    else:
        with use_kernels(None):  # what a test puts there is removed afterwards
            yield DeviceSetup(
                kernels_on_cpu(), torch.device("cpu"), random_scene(1, n=200, size=-2.0), random_camera(1)
            )


def photo_of(camera: Camera) -> Tensor:
    generator = torch.Generator().manual_seed(7)
    return torch.rand(camera.height, camera.width, 3, generator=generator)


def backward_at(
    place: DeviceSetup | None, given: DeviceSetup, options: RenderOptions
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the image and every gradient, on a device or on the CPU."""
    device = torch.device("cpu") if place is None else place.device
    with use_kernels(None if place is None else place.kernels):
        scene = given.scene.to(device).detach().clone().requires_grad_()
        probe = torch.zeros(len(scene), 2, device=device, requires_grad=True)
        rendered = render(scene, given.camera, options, means2d_probe=probe)
        photo_loss(rendered.colour, photo_of(given.camera).to(device)).backward()
    tensors = scene.tensors() | {"means2d": probe}
    return rendered.colour.detach().cpu(), {name: tensor.grad.cpu() for name, tensor in tensors.items()}


@pytest.mark.parametrize("options", [RenderOptions(3), RenderOptions(3, antialias=True, magnitudes=True, depth=False)])
def test_renders_and_gradients_agree_with_the_cpus(place, options):
    expected, gradients = backward_at(None, place, options)
    picture, ours = backward_at(place, place, options)
    assert float(expected.std()) > 0.1
    assert -10.0 * torch.log10((picture - expected).square().mean().double()) >= MIN_PSNR
    for name, gradient in gradients.items():
        assert (ours[name] - gradient).norm() <= GRADIENT_RTOL * gradient.norm(), name


def train(place: DeviceSetup | None, given: DeviceSetup) -> list[Tensor]:
    """A few iterations; everything that they changed, with the gradients on the screen."""
    device = torch.device("cpu") if place is None else place.device
    photo = photo_of(given.camera).to(device)
    scene = given.scene.to(device).detach().clone().requires_grad_()
    affine = torch.eye(3, 4).to(device).requires_grad_()
    optimizer, beside, buffers = Adam(scene.tensors()), Adam({"affine": affine[None]}), GradientBuffers()
    with use_kernels(None if place is None else place.kernels), never_waiting(device):
        for _ in range(STEPS):
            probe = torch.zeros(len(scene), 2, device=device, requires_grad=True)
            rendered = render(scene, given.camera, RenderOptions(3, depth=False), means2d_probe=probe, buffers=buffers)
            (0.5 * photo_loss(affine_colour(rendered.colour, affine), photo)).backward()
            optimizer.step(scene.tensors(), RATES, rendered.visible, buffers, {"log_scales": (-9.0, 1.0)})
            maps = affine.detach()[None].clone()
            maps.grad = affine.grad[None]
            beside.step({"affine": maps}, {"affine": 1e-2})
            affine = maps[0].requires_grad_()
            for tensor in scene.tensors().values():
                tensor.grad = None
    assert optimizer.take_skipped() == 0
    return [tensor.detach().cpu() for tensor in (*scene.tensors().values(), affine, probe.grad.to_dense())]


def test_iterations_never_wait_and_give_the_cpus_results(place):
    start = [*place.scene.tensors().values(), torch.eye(3, 4), torch.zeros(len(place.scene), 2)]
    for ours, expected, before in zip(train(place, place), train(None, place), start, strict=True):
        moved = (expected - before).norm()
        assert moved > 0.0
        assert (ours - expected).norm() <= STEP_SHARE * moved


def test_iterations_have_the_same_bits_twice(place):
    first, second = train(place, place), train(place, place)
    assert all(torch.equal(ours, again) for ours, again in zip(first, second, strict=True))


def test_the_device_is_named(place):
    with use_kernels(place.kernels):
        kernels = kernels_of(place.device)
        assert kernels is not None
        assert Device("", place.device).kernels == kernels.facts.described()
    assert Device("", place.device).kernels.startswith("cuda sm_") == (place.device.type == "cuda")


def test_waiting_is_forbidden_despite_torchs_note_and_allowed_again_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    modes: list[str] = []

    def set_mode(mode: str) -> None:
        if mode != "default" and not modes:
            warnings.warn("Synchronization debug mode is a prototype feature", UserWarning, stacklevel=1)
        modes.append(mode)

    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", set_mode)
    with pytest.raises(RuntimeError, match="it waited"), never_waiting(torch.device("cuda", 0)):
        assert modes == ["error"]
        raise RuntimeError("it waited")
    with never_waiting(torch.device("cpu")):
        pass
    assert modes == ["error", "default"]
