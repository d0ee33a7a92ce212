"""CUDA kernels run on the device of their tensors, whichever is torch's current one or the library's own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import activated_scenes
import pytest
import torch
from activated_scenes import Case, options
from building import build_on_cpu, load
from on_cpu import kernels_on_cpu
from random_scene import random_camera, random_scene

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.raster.colour import affine_colour
from splatpipe.pipeline.raster.cuda import cuda, cuda_forecast
from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.cuda.cuda_api import CALLS, SplatFrameFacts
from splatpipe.pipeline.raster.cuda.cuda_forecast import FrameSize, PendingFacts
from splatpipe.pipeline.raster.gradients import GradientBuffers
from splatpipe.pipeline.raster.loss import photo_loss
from splatpipe.pipeline.raster.optim import Adam
from splatpipe.pipeline.raster.rasterizer import RenderOptions, render
from splatpipe.pipeline.raster.sky import SkyLayer, laid_over_nodes

CAMERA, OPTIONS = random_camera(0), RenderOptions(3, depth=False)
SECOND = torch.device("cuda", 1)


def use_all(kernels: CudaKernels) -> None:
    """Call every function that runs something on a device."""
    scene, buffers = random_scene(0).requires_grad_(), GradientBuffers()
    affine, nodes = torch.eye(3, 4).requires_grad_(), torch.rand(8, 10, 3, requires_grad=True)
    rates = dict.fromkeys(scene.tensors(), 1e-3)
    with use_kernels(kernels):
        for finished in (True, False):  # the backward pass, by itself and by the step
            rendered = render(scene, CAMERA, OPTIONS, buffers=None if finished else buffers)
            mask = torch.ones(rendered.alpha.shape, dtype=torch.bool)
            behind = SkyLayer((0.0, 0.0, 0.0), mask=mask, step=8)
            picture = laid_over_nodes(rendered.colour, rendered.alpha, nodes, behind)
            photo_loss(affine_colour(picture, affine), torch.zeros_like(picture)).backward()
            Adam(scene.tensors()).step(scene.tensors(), rates, rendered.visible, None if finished else buffers)
            for tensor in scene.tensors().values():
                tensor.grad = None
    case = Case(20, 5, options=options(rasterize_mode="antialiased"))
    with use_kernels(kernels):
        activated_scenes.render(case)
        activated_scenes.render(Case(20, options=options(sh_degree=1)))
    draw = (1, 2, 3)
    kernels.uniform(*draw, 5)
    kernels.split_offsets(draw, torch.tensor([2, 7]), scene.log_scales.detach(), scene.quats.detach())
    kernels.morton(scene.means.detach(), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The functions of the library that were called, in order."""
    names: list[str] = []
    call, harness = CudaKernels.call, load(build_on_cpu())

    def recorded(kernels: CudaKernels, name: str, *arguments: object) -> None:
        before = harness.harness_used(1 - kernels.index)
        call(kernels, name, *arguments)
        names.append(name)
        assert harness.harness_used(1 - kernels.index) == before, f"{name} ran on the other device"

    monkeypatch.setattr(CudaKernels, "call", recorded)
    return names


def test_every_function_runs_on_the_device_of_its_tensors(called: list[str]) -> None:
    harness = load(build_on_cpu())
    for index in (1, 0):
        kernels = kernels_on_cpu()
        kernels.index = index  # the harness's devices share the memory of the CPU
        before = harness.harness_used(index)
        called.clear()
        use_all(kernels)
        assert set(called) == CALLS.keys() - {"splat_device"}
        assert harness.harness_used(index) >= before + len(called)


def test_a_device_that_does_not_exist_is_reported() -> None:
    kernels = kernels_on_cpu()
    kernels.index = 7
    with pytest.raises(MachineError, match="The graphics card failed in splat_uniform"):
        kernels.uniform(1, 2, 3, 4)
    kernels.index = 0
    assert len(kernels.uniform(1, 2, 3, 4)) == 4


@pytest.fixture
def devices(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Two CUDA devices, of which torch's current one is the first; what happens to it."""
    log: list[object] = []

    @contextmanager
    def device(wanted: torch.device) -> Iterator[None]:
        log.append(f"at {wanted}")
        yield
        log.append("back")

    monkeypatch.setattr(torch.cuda, "device", device)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda where: SimpleNamespace(cuda_stream=40 + where.index))
    return log


def test_torchs_current_device_is_the_tensors_during_a_call_and_its_own_afterwards(
    devices: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    def call(name: str, number: int, stream: object) -> None:
        where = stream._obj  # type: ignore[attr-defined]
        devices.append((name, number, where.stream, where.device))

    kernels = kernels_on_cpu()
    kernels.device, kernels.index = SECOND, 1
    monkeypatch.setattr(kernels, "_library", SimpleNamespace(call=call))
    kernels.call("splat_uniform", 5)
    assert devices == ["at cuda:1", ("splat_uniform", 5, 41, 1), "back"]


def test_facts_are_awaited_on_the_stream_of_their_device(
    devices: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Event:
        def record(self, stream: SimpleNamespace) -> None:
            devices.append(stream.cuda_stream)

    class Memory:
        """Of the second device."""

        device = SECOND

        def __getitem__(self, part: slice) -> torch.Tensor:
            return torch.zeros(part.stop, dtype=torch.uint8)

    empty = torch.empty

    def not_pinned(count: int, dtype: torch.dtype, pin_memory: bool) -> torch.Tensor:
        assert pin_memory
        return empty(count, dtype=dtype)

    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(cuda_forecast.torch, "empty", not_pinned)
    facts = PendingFacts(Memory(), FrameSize(1, 1), 1)  # type: ignore[arg-type]
    assert devices == [41] and len(facts._numbers) == len(SplatFrameFacts._fields_)


def test_a_tensor_without_a_number_is_on_torchs_current_device(monkeypatch: pytest.MonkeyPatch) -> None:
    second = kernels_on_cpu()
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    monkeypatch.setattr(cuda, "_on_cuda", lambda index: second if index == 1 else None)
    assert cuda.kernels_of(torch.device("cuda")) is second and cuda.kernels_of(torch.device("cuda", 0)) is None
