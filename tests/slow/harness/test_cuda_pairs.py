"""A view with more pairs than 32 bits can count on a CUDA device; without one, with more chunks, on the CPU."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from on_cpu import kernels_on_cpu
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, kernels_of
from splatpipe.pipeline.raster.cuda.cuda_forecast import Forecast, FrameFacts, FrameSize
from splatpipe.pipeline.raster.cuda.cuda_library import unavailable_reason
from splatpipe.pipeline.raster.cuda_frame import CudaFrame, shot_of
from splatpipe.pipeline.raster.definitions import RenderOptions
from splatpipe.pipeline.splat.model.gaussians import PARAMETERS

TILE_PX = 16
OPACITY = 0.05
NEAREST = 250
"""Number of nearest Gaussians, enough to saturate every pixel: 0.95^250 is far below the limit of 1e-4."""


@dataclass(frozen=True)
class DeviceSetup:
    """Where the kernels run, and how large a scene they get there.

    Attributes:
        kernels: With a forecast that knows the view.
        size: Size of the image, pixels.
        count: Gaussians.
        capacity: Pairs of a chunk.
    """

    kernels: CudaKernels
    size: tuple[int, int]
    count: int
    capacity: int

    @property
    def tiles(self) -> int:
        width, height = self.size
        return math.ceil(width / TILE_PX) * math.ceil(height / TILE_PX)


@pytest.fixture(params=["harness", pytest.param("cuda", marks=pytest.mark.cuda)])
def place(request: pytest.FixtureRequest) -> DeviceSetup:
    if request.param == "harness":
        return DeviceSetup(kernels_on_cpu(), (60, 40), 500, 1100)
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    reason = unavailable_reason()
    assert reason is None, reason
    kernels = kernels_of(torch.device("cuda", 0))
    assert kernels is not None
    return DeviceSetup(kernels, (3840, 2160), 67_000, 1 << 25)


def covering_discs(count: int) -> tuple[Tensor, ...]:
    """Discs that cover the whole view, from near to far."""
    generator = torch.Generator().manual_seed(3)
    means = torch.zeros(count, 3)
    means[:, 2] = torch.linspace(4.0, 9.0, count)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    logits = torch.full((count,), math.log(OPACITY / (1.0 - OPACITY)))
    colours = torch.rand(count, 1, 3, generator=generator)
    log_scales = torch.tensor([math.log(100.0), math.log(100.0), -5.0]).repeat(count, 1)
    return means, log_scales, quats, logits, colours


@dataclass(frozen=True)
class PairsResult:
    picture: Tensor
    gradients: tuple[Tensor, ...]
    pairs: int
    chunks: int


def rendered(place: DeviceSetup, parameters: tuple[Tensor, ...]) -> PairsResult:
    kernels, (width, height), count = place.kernels, place.size, len(parameters[0])
    camera = Camera("view", width, height, float(width), float(width), width / 2, height / 2, np.eye(4))
    device = kernels.device
    colour, alpha = torch.empty(height, width, 3, device=device), torch.empty(height, width, device=device)
    radii, visible = torch.empty(count, device=device), torch.empty(count, dtype=torch.uint8, device=device)
    before, kernels.forecast = kernels.forecast, Forecast(place.capacity)
    try:
        pairs = count * place.tiles
        size = FrameSize(count, place.tiles)
        kernels.forecast.update(FrameFacts(size, place.capacity, pairs, math.ceil(pairs / place.capacity)))
        outputs = (colour, alpha, None, None, None, radii, visible)
        shot = shot_of(camera, RenderOptions(0, depth=False), 1)
        frame = CudaFrame.render(kernels, shot, tuple(p.to(device) for p in parameters), outputs)
        back = frame.blend_backward((torch.ones_like(colour), None, None, None))
        gradients, _ = frame.project_backward(back)
    finally:
        kernels.forecast = before
    facts = frame.memory[:24].view(torch.int64).tolist()
    return PairsResult(colour.cpu(), tuple(gradient.cpu() for gradient in gradients), facts[0], facts[2])


def test_a_view_of_very_many_pairs_is_that_of_its_nearest_gaussians(place):
    everything = covering_discs(place.count)
    assert (1.0 - OPACITY) ** NEAREST < 1e-5
    ours = rendered(place, everything)
    nearest = rendered(place, tuple(tensor[:NEAREST] for tensor in everything))
    assert ours.pairs == place.count * place.tiles
    assert ours.chunks >= ours.pairs / place.capacity
    if place.kernels.device.type == "cuda":
        assert ours.pairs > 1 << 31
    assert torch.equal(ours.picture, nearest.picture)
    for name, gradient, expected in zip(PARAMETERS, ours.gradients, nearest.gradients, strict=True):
        assert torch.equal(gradient[:NEAREST], expected), name
        assert not gradient[NEAREST:].any(), name
    assert nearest.gradients[-1].any()
