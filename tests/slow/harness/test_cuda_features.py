"""``rasterization`` by the CUDA kernels, on the harness and on a card, against the reference in float64."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from activated_scenes import Case, Outcome, arguments, leaves_of, options, render
from building import FORWARD, REVERSE, SHUFFLED, build_on_cpu, load
from on_cpu import ShortOfMemory, kernels_on_cpu, library_on_cpu
from torch import Tensor

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.cuda.cuda_api import SplatShot
from splatpipe.pipeline.raster.cuda.cuda_forecast import Forecast, FrameFacts, FrameSize
from splatpipe.pipeline.raster.cuda.cuda_library import unavailable_reason
from splatpipe.pipeline.raster.feature_kernels import NATIVE
from splatpipe.pipeline.raster.feature_reference import REFERENCE
from splatpipe.pipeline.raster.rasterization import _steps_for, rasterization

LEAST_DB = 60.0  # of an image, its peak the largest value expected, at least 1
GRADIENT = 1e-4  # L2, relative
NO_GRADIENT = 1e-6  # anything smaller is rounding
MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
MANY = Case(60, 33, 2, True, 45, 35, options=options(render_mode="RGB+D", depth="ray", rasterize_mode="antialiased"))


@pytest.fixture(params=["harness", pytest.param("cuda", marks=pytest.mark.cuda)])
def where(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """The device of the tensors."""
    if request.param == "harness":
        with use_kernels(kernels_on_cpu()):
            yield torch.device("cpu")
        return
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    reason = unavailable_reason()
    assert reason is None, reason
    yield torch.device("cuda", 0)


@functools.cache
def expected(case: Case) -> Outcome:
    with use_kernels(None):
        return render(case, torch.float64)


def compare(case: Case, where: torch.device) -> None:
    ours, exact = render(case, torch.float32, where), expected(case)
    for name in ("images", "alphas"):
        truth, image = getattr(exact, name), getattr(ours, name)
        peak, error = max(1.0, float(truth.abs().max())), float((image - truth).square().mean())
        assert error == 0.0 or 10.0 * math.log10(peak * peak / error) >= LEAST_DB, name
    for name, truth in exact.gradients.items():
        error = float((ours.gradients[name] - truth).norm() / truth.norm().clamp_min(NO_GRADIENT))
        assert error < GRADIENT, f"gradient of {name}: {error:.1e}"


def assert_same_bits(one: Outcome, other: Outcome) -> None:
    assert torch.equal(one.images, other.images)
    assert torch.equal(one.alphas, other.alphas)
    for name, gradient in one.gradients.items():
        assert torch.equal(gradient, other.gradients[name]), name


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("render_mode", MODES)
def test_every_mode_agrees_with_the_reference(where: torch.device, render_mode: str, rasterize_mode: str) -> None:
    compare(Case(options=options(render_mode=render_mode, rasterize_mode=rasterize_mode, depth="ray")), where)
    compare(Case(options=options(render_mode=render_mode, rasterize_mode=rasterize_mode)), where)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 16, 17, 32, 33])
@pytest.mark.parametrize(("views", "per_view"), [(1, False), (3, True)])
def test_features_of_any_number_of_channels_agree(
    where: torch.device, channels: int, views: int, per_view: bool
) -> None:
    case = Case(25, channels, views, per_view, 33, 19, seed=2, options=options(render_mode="RGB+D", depth="ray"))
    compare(case, where)


@pytest.mark.parametrize(("degree", "per_view"), [(0, False), (1, True), (2, False), (3, True), (3, False)])
def test_spherical_harmonics_agree(where: torch.device, degree: int, per_view: bool) -> None:
    compare(Case(views=3, per_view=per_view, seed=3, options=options(sh_degree=degree)), where)


@pytest.mark.parametrize(
    "named",
    [
        {"near_plane": 4.0, "far_plane": 4.5, "render_mode": "RGB+D"},
        {"eps2d": 0.0},
        {"eps2d": 1.7, "rasterize_mode": "antialiased", "compensation_min": 0.6},
        {"alpha_max": 0.5, "radius_clip": 9.0},
        {"plane_sigmas": 12.0},
    ],
)
def test_what_is_an_option_agrees(where: torch.device, named: dict[str, Any]) -> None:
    plain = render(Case())
    compare(Case(options=options(**named)), where)
    assert not torch.equal(render(Case(options=options(**named))).images[..., :3], plain.images), "it has no effect"


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 15), (100, 3), (3, 100)])
def test_any_image_size_agrees(where: torch.device, size: tuple[int, int]) -> None:
    for channels in (3, 5):
        compare(Case(width=size[0], height=size[1], channels=channels), where)


@pytest.mark.parametrize("case", [Case(behind=True, views=3), Case(count=0, channels=17), Case(count=0, views=3)])
def test_empty_views_are_the_background(where: torch.device, case: Case) -> None:
    compare(case, where)


@pytest.mark.parametrize("channels", [3, 33])
def test_gradients_by_centres_and_backgrounds_and_magnitudes_agree(where: torch.device, channels: int) -> None:
    found = []
    for dtype, device in ((torch.float32, where), (torch.float64, torch.device("cpu"))):
        case = Case(40, channels, 2)
        given = {name: value.to(device) for name, value in arguments(case, dtype).items()}
        given = {name: value.requires_grad_(name not in ("viewmats", "Ks")) for name, value in given.items()}
        named: dict[str, Any] = {"render_mode": "RGB+D", "depth": "ray", "absgrad": True}
        images, alphas, meta = rasterization(**given, width=41, height=27, **named)
        meta["means2d"].retain_grad()
        ((images.sin() * images).sum() + alphas.sum()).backward()
        asked = (meta["means2d"].grad, meta["means2d"].absgrad, given["backgrounds"].grad)
        found.append([each.cpu().double() for each in asked])
    for ours, exact in zip(*found, strict=True):
        assert float((ours - exact).norm() / exact.norm()) < GRADIENT


def test_bits_are_the_same_from_run_to_run(where: torch.device) -> None:
    first = render(MANY, torch.float32, where)
    library = load(build_on_cpu()) if where.type == "cpu" else None
    for order, seed in ((FORWARD, 0), (REVERSE, 0), (SHUFFLED, 3)):
        if library is not None:
            library.harness_order(order, seed)
        try:
            assert_same_bits(render(MANY, torch.float32, where), first)
        finally:
            if library is not None:
                library.harness_order(FORWARD, 0)


def rendered(kernels: CudaKernels, case: Case = MANY) -> Outcome:
    with use_kernels(kernels):
        return render(case)


def test_views_in_many_chunks_have_the_same_bits() -> None:
    whole, few, blind = rendered(kernels_on_cpu()), kernels_on_cpu(), kernels_on_cpu()
    few.feature_forecast.most_pairs = 1  # so that chunks hold as many pairs as there are Gaussians
    size = FrameSize(MANY.count, 9)
    assert_same_bits(rendered(few), whole)
    assert few.feature_forecast.room(size).passes > 2
    blind.feature_forecast.most_pairs = 1
    blind.feature_forecast.update(FrameFacts(size, MANY.count, pairs=10, chunks=1))  # far too few
    assert blind.feature_forecast.room(size).passes == 1
    assert_same_bits(rendered(blind), whole)


def test_few_channels_in_chunks_that_nobody_foresaw_have_the_same_bits() -> None:
    case, blind = Case(60, 2, width=45, height=35), kernels_on_cpu()
    blind.feature_forecast = Forecast(1)
    blind.feature_forecast.update(FrameFacts(FrameSize(case.count, 9), case.count, pairs=10, chunks=1))
    assert_same_bits(rendered(blind, case), rendered(kernels_on_cpu(), case))


def test_features_leave_the_forecast_of_training_alone() -> None:
    kernels = kernels_on_cpu()
    before = kernels.forecast.room(FrameSize(1000, 100))
    rendered(kernels)
    assert kernels.forecast.room(FrameSize(1000, 100)) == before


class ShortOfFeatures(ShortOfMemory):
    """Kernels on a device with little memory for the backward pass of features."""

    def feature_back_bytes(self, view: Any, count: int, capacity: int, channels: int) -> int:
        size = super().feature_back_bytes(view, count, capacity, channels)
        if size > self.most_bytes:
            raise torch.OutOfMemoryError("out of memory")
        return size


def test_short_memory_makes_chunks_smaller_and_then_is_said_in_words() -> None:
    whole, short = rendered(kernels_on_cpu()), ShortOfFeatures(library_on_cpu(), torch.device("cpu"))
    view = SplatShot(fx=1.0, fy=1.0, sh_count=1, width=45, height=35, whole_width=45, whole_height=35)
    short.most_frame_bytes = short.frame_bytes(view, MANY.count, 100)
    assert_same_bits(rendered(short), whole)
    assert short.feature_forecast.most_pairs < Forecast().most_pairs
    short.most_frame_bytes = 100
    with pytest.raises(MachineError, match="60 Gaussians with 34 channels"):
        rendered(short)
    short.most_frame_bytes, short.most_bytes = 1 << 40, 100
    with pytest.raises(MachineError, match="60 Gaussians with 34 channels"):
        rendered(short)


def test_a_second_backward_pass_adds_up() -> None:
    given = leaves_of(arguments(Case(channels=20), torch.float32))
    kernels = kernels_on_cpu()
    kernels.feature_forecast.most_pairs = 1  # the lists of all chunks but one are made again
    with use_kernels(kernels):
        images, _, _ = rasterization(**given, width=41, height=27)
        images.square().sum().backward(retain_graph=True)
        once = given["colors"].grad.clone()
        images.square().sum().backward()
    assert torch.equal(given["colors"].grad, 2.0 * once)


def unaligned(values: Tensor) -> Tensor:
    """The same values, contiguous, four bytes behind where an allocation begins."""
    memory = torch.empty(values.numel() + 1)
    return memory[1:].copy_(values.flatten()).view(values.shape)


def test_features_may_lie_anywhere() -> None:
    given = arguments(Case(channels=8), torch.float32)
    with use_kernels(kernels_on_cpu()):
        plain, _, _ = rasterization(**given, width=41, height=27)
        moved, _, _ = rasterization(**given | {"colors": unaligned(given["colors"])}, width=41, height=27)
    assert torch.equal(plain, moved)


def test_each_device_and_dtype_has_its_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    cpu = torch.device("cpu")
    assert _steps_for(cpu, torch.float32) is NATIVE
    with use_kernels(kernels_on_cpu()):
        assert _steps_for(cpu, torch.float32) is not NATIVE
        assert _steps_for(cpu, torch.float64) is REFERENCE
    with pytest.warns(UserWarning, match="slow torch reference renders.*none for meta"):
        assert _steps_for(torch.device("meta"), torch.float32) is REFERENCE
    if unavailable_reason() is not None:
        with pytest.warns(UserWarning, match="slow torch reference renders, not rasterization's kernels"):
            assert _steps_for(torch.device("cuda", 0), torch.float32) is REFERENCE
