"""The CUDA backend apart from the frame: loss, colours and draws, on the CPU in the harness."""

import ctypes
from collections.abc import Callable

import numpy as np
import pytest
import torch
from building import FORWARD, NATIVE, REVERSE, SHUFFLED, build_on_cpu, load
from torch import Tensor

from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, use_kernels
from splatpipe.pipeline.raster.cuda.cuda_api import SplatRectangle
from splatpipe.pipeline.raster.cuda.cuda_library import CudaLibrary
from splatpipe.pipeline.raster.loss import Rectangle, photo_loss, photo_loss_reference
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.morton import morton_keys
from splatpipe.pipeline.train.densify import _split_offsets
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.schedule import resolve_schedule
from splatpipe.pipeline.train.random_numbers import DROPOUT, SPLIT_POSITION, uniform
from splatpipe.pipeline.train.techniques.dropout import dropped

# Relative, the gradient in L2, against float64: those of the CPU's kernel, for the reason given in test_loss.py.
LOSS_RTOL = 1e-5
GRADIENT_RTOL = 5e-5
CPU_RTOL = 2e-5  # against the CPU's kernel, whose sums have another order
COLOUR_RTOL = 1e-6
FLOAT = 2.0**-23  # what torch is given is rounded
NORMAL_ATOL = 1e-5  # offsets of scales up to 1: logarithm, cosine and exponential are the device's

SIZES = [(6, 6), (6, 40), (7, 9), (11, 33), (16, 32), (37, 70), (49, 98)]
"""A tile is 16 x 32: below the window, odd, one exactly, several, and one away from the borders."""

Kernels = ctypes.CDLL


@pytest.fixture(scope="module")
def kernels() -> Kernels:
    sources = [NATIVE / "cuda" / name for name in ("loss.cu", "colour.cu", "density.cu")]
    loaded = load(build_on_cpu(sources, "beside_the_frame"))
    loaded.splat_loss_bytes.restype = loaded.splat_affine_bytes.restype = ctypes.c_int64
    return loaded


@pytest.fixture(params=[(FORWARD, 0), (REVERSE, 0), (SHUFFLED, 5)], ids=["forward", "reverse", "shuffled"])
def any_order(kernels: Kernels, request: pytest.FixtureRequest) -> None:
    """Threads and blocks run in several orders."""
    kernels.harness_order(*request.param)


def untouched(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Memory that reveals reads before writes, and missing writes."""
    return torch.full(shape, torch.nan, dtype=dtype)


def memory_of(size: int) -> tuple[ctypes.c_void_p, ctypes.c_int64, Tensor]:
    """Aligned memory with a guard behind it, and its owner."""
    whole = torch.full((size + 512,), 0xFF, dtype=torch.uint8)
    skip = -whole.data_ptr() % 256
    return ctypes.c_void_p(whole.data_ptr() + skip), ctypes.c_int64(size), whole


def at(tensor: Tensor | None) -> ctypes.c_void_p:
    assert tensor is None or tensor.is_contiguous()
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())


def called(kernels: Kernels, function: Callable[..., int], *arguments: object) -> None:
    assert function(*arguments, None) == 0, kernels.harness_message()


def device_loss(
    kernels: Kernels,
    render: Tensor,
    photo: Tensor,
    weight: float = 0.2,
    mask: Tensor | None = None,
    inner: Rectangle | None = None,
) -> tuple[float, Tensor]:
    height, width = render.shape[:2]
    value, gradient = untouched(1, dtype=torch.float64), untouched(height, width, 3)
    pointer, size, kept = memory_of(kernels.splat_loss_bytes(width, height))
    pictures = (at(render), at(photo), at(mask if mask is None else mask.view(torch.uint8)), width, height)
    inner_rectangle = None if inner is None else ctypes.byref(SplatRectangle(*inner))
    weighted = (inner_rectangle, ctypes.c_double(weight), at(gradient), at(value), pointer, size)
    called(kernels, kernels.splat_photo_loss, *pictures, *weighted)
    assert bool((kept[-(512 - 256) :] == 0xFF).all()), "written past the memory"
    return float(value), gradient


def loss_and_gradient(function: Callable[..., Tensor], render: Tensor, *arguments: object) -> tuple[float, Tensor]:
    leaf = render.clone().requires_grad_()
    loss = function(leaf, *arguments)
    loss.backward()
    assert leaf.grad is not None
    return loss.item(), leaf.grad


def pair(kind: str, height: int, width: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(height * width)
    noise, other = (torch.rand(height, width, 3, generator=generator) for _ in range(2))
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    smooth = torch.stack((0.5 + 0.4 * torch.sin(x / 9), 0.5 + 0.45 * torch.cos(y / 7), (x + y) / (height + width)), -1)
    return {
        "random": (noise, other),
        "nearly equal": (smooth + 1e-3 * noise, smooth),
        "white": (1 - 0.01 * noise, torch.ones(height, width, 3)),
    }[kind]


def some_mask(height: int, width: int) -> Tensor:
    mask = torch.rand(height, width, generator=torch.Generator().manual_seed(1)) > 0.4
    mask[:, : width // 4] = False
    return mask


def relative(found: Tensor, exact: Tensor) -> float:
    return float(torch.linalg.vector_norm(found - exact) / torch.linalg.vector_norm(exact))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kind", ["random", "nearly equal", "white"])
def test_loss_and_gradient_are_the_references_and_the_cpus(
    kernels: Kernels, kind: str, size: tuple[int, int], masked: bool
) -> None:
    render, photo = pair(kind, *size)
    mask = some_mask(*size) if masked else None
    loss, gradient = device_loss(kernels, render, photo, 0.2, mask)
    exact = loss_and_gradient(photo_loss_reference, render.double(), photo.double(), 0.2, mask)
    assert loss == pytest.approx(exact[0], rel=LOSS_RTOL, abs=1e-12)
    assert relative(gradient, exact[1]) < GRADIENT_RTOL
    cpu = loss_and_gradient(photo_loss, render, photo, 0.2, mask)
    assert loss == pytest.approx(cpu[0], rel=CPU_RTOL, abs=1e-12)
    assert relative(gradient, cpu[1]) < GRADIENT_RTOL


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("inner", [(0, 0, 1, 1), (5, 3, 40, 30), (33, 0, 70, 17), (0, 5, 70, 37), (69, 36, 70, 37)])
def test_loss_and_gradient_of_a_counting_part_are_the_references_too(
    kernels: Kernels, inner: Rectangle, masked: bool
) -> None:
    render, photo = pair("random", 37, 70)
    mask = some_mask(37, 70) if masked else None
    loss, gradient = device_loss(kernels, render, photo, 0.2, mask, inner)
    exact = loss_and_gradient(photo_loss_reference, render.double(), photo.double(), 0.2, mask, inner)
    assert loss == pytest.approx(exact[0], rel=LOSS_RTOL, abs=1e-12)
    assert relative(gradient, exact[1]) < GRADIENT_RTOL if bool(exact[1].any()) else not gradient.any()
    with use_kernels(CudaKernels(CudaLibrary(build_on_cpu()), torch.device("cpu"))):
        through = loss_and_gradient(photo_loss, render, photo, 0.2, mask, inner)
    assert through[0] == pytest.approx(loss, rel=FLOAT)
    assert torch.equal(through[1], gradient)


def test_a_counting_part_of_the_whole_image_is_none(kernels: Kernels) -> None:
    render, photo = pair("random", 20, 40)
    without, whole = (device_loss(kernels, render, photo, inner=inner) for inner in (None, (0, 0, 40, 20)))
    assert without[0] == whole[0]
    assert torch.equal(without[1], whole[1])


@pytest.mark.parametrize("inner", [(0, 0, 41, 20), (5, 5, 5, 20), (-1, 0, 20, 20), (0, 8, 20, 7)])
def test_a_counting_part_outside_is_refused(kernels: Kernels, inner: Rectangle) -> None:
    with pytest.raises(AssertionError):
        device_loss(kernels, *pair("random", 20, 40), inner=inner)


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_both_parts_of_the_loss_have_their_weights(kernels: Kernels, weight: float) -> None:
    render, photo = pair("random", 37, 70)
    loss, gradient = device_loss(kernels, render, photo, weight, some_mask(37, 70))
    exact = loss_and_gradient(photo_loss_reference, render.double(), photo.double(), weight, some_mask(37, 70))
    assert loss == pytest.approx(exact[0], rel=LOSS_RTOL)
    assert relative(gradient, exact[1]) < GRADIENT_RTOL


def test_loss_has_the_same_bits_in_every_order_of_threads(kernels: Kernels) -> None:
    render, photo = pair("random", 37, 70)
    found = []
    for order, seed in ((FORWARD, 0), (REVERSE, 0), (SHUFFLED, 1), (SHUFFLED, 2)):
        kernels.harness_order(order, seed)
        found.append(device_loss(kernels, render, photo, 0.2, some_mask(37, 70)))
    for loss, gradient in found[1:]:
        assert loss == found[0][0]
        assert torch.equal(gradient, found[0][1])


def test_masked_pixels_neither_count_nor_have_a_gradient(kernels: Kernels) -> None:
    render, photo = pair("random", 40, 50)
    mask = torch.ones(40, 50, dtype=torch.bool)
    mask[10:30, 5:20] = False
    other = torch.where(mask[..., None], render, 1 - render)
    other[12, 7] = torch.nan
    loss, gradient = device_loss(kernels, render, photo, 0.2, mask)
    other_loss, other_gradient = device_loss(kernels, other, photo, 0.2, mask)
    assert loss == other_loss
    assert torch.equal(gradient, other_gradient)
    assert not gradient[~mask].any()
    assert gradient[mask].abs().min() > 0


def test_nothing_to_count_gives_zero(kernels: Kernels) -> None:
    loss, gradient = device_loss(kernels, *pair("random", 20, 40), 0.2, torch.zeros(20, 40, dtype=torch.bool))
    assert loss == 0.0
    assert torch.equal(gradient, torch.zeros(20, 40, 3))


def test_full_mask_is_no_mask(kernels: Kernels) -> None:
    render, photo = pair("random", 20, 40)
    without = device_loss(kernels, render, photo)
    masked = device_loss(kernels, render, photo, 0.2, torch.ones(20, 40, dtype=torch.bool))
    assert without[0] == masked[0]
    assert torch.equal(without[1], masked[1])


def test_too_small_pictures_and_too_little_memory_are_refused(kernels: Kernels) -> None:
    picture = torch.zeros(6, 8, 3)
    size = kernels.splat_loss_bytes(8, 6)
    for height, given, code in ((5, size, -1), (6, size - 1, -2)):
        pictures = (at(picture), at(picture), None, 8, height, None, ctypes.c_double(0.2))
        out = (at(picture), at(picture), at(picture), ctypes.c_int64(given))
        assert kernels.splat_photo_loss(*pictures, *out, None) == code


@pytest.mark.parametrize("pixels", [1, 31, 256, 2048, 5000])
def test_colours_and_their_gradients_are_those_of_the_definition(
    kernels: Kernels, any_order: None, pixels: int
) -> None:
    generator = torch.Generator().manual_seed(pixels)
    picture, upstream = (torch.rand(pixels, 3, generator=generator) for _ in range(2))
    affine = torch.eye(3, 4) + 0.3 * torch.randn(3, 4, generator=generator)
    out, gradient, by_map = untouched(pixels, 3), untouched(pixels, 3), untouched(3, 4)
    called(kernels, kernels.splat_affine_colour, at(affine), at(picture), ctypes.c_int64(pixels), at(out))
    pointer, size, _kept = memory_of(kernels.splat_affine_bytes(ctypes.c_int64(pixels)))
    inputs = (at(affine), at(picture), at(upstream), ctypes.c_int64(pixels))
    called(kernels, kernels.splat_affine_colour_backward, *inputs, at(gradient), at(by_map), pointer, size)

    leaf, exact_map = picture.double().requires_grad_(), affine.double().requires_grad_()
    exact = leaf @ exact_map[:, :3].T + exact_map[:, 3]
    (exact * upstream).sum().backward()
    assert leaf.grad is not None and exact_map.grad is not None
    for ours, right in ((out, exact.detach()), (gradient, leaf.grad), (by_map, exact_map.grad)):
        assert relative(ours, right) < COLOUR_RTOL


@pytest.mark.parametrize(("seed", "step"), [(0, 1), (42, 30_000), (2**63 + 11, 7)])
def test_uniform_numbers_are_those_of_the_cpu_to_the_bit(kernels: Kernels, seed: int, step: int) -> None:
    out = untouched(1000, dtype=torch.float64)
    key = (ctypes.c_uint64(seed), ctypes.c_uint64(step), ctypes.c_uint64(DROPOUT))
    called(kernels, kernels.splat_uniform, *key, ctypes.c_int64(1000), at(out))
    assert np.array_equal(out.numpy(), uniform(seed, step, DROPOUT, np.arange(1000)))


def test_dropout_on_a_device_drops_the_same_gaussians() -> None:
    library = CudaLibrary(build_on_cpu())
    gaussians = Gaussians.empty(500, 1)
    schedule = resolve_schedule(TrainConfig(iterations=100, dropout=0.4))
    expected = dropped(gaussians, schedule, 60).opacity_logits
    with use_kernels(CudaKernels(library, torch.device("cpu"))):
        assert torch.equal(dropped(gaussians, schedule, 60).opacity_logits, expected)
    assert 0 < int((expected < -20.0).sum()) < 500


def test_halves_of_a_split_lie_where_the_cpu_has_them(kernels: Kernels) -> None:
    generator = torch.Generator().manual_seed(3)
    count = 3000
    gaussians = Gaussians(
        means=torch.zeros(count, 3),
        log_scales=-3.0 * torch.rand(count, 3, generator=generator),
        quats=torch.randn(count, 4, generator=generator),
        opacity_logits=torch.zeros(count),
        sh=torch.zeros(count, 1, 3),
    )
    rows = torch.nonzero(torch.rand(count, generator=generator) > 0.5).flatten()
    out = untouched(2 * len(rows), 3)
    key = (ctypes.c_uint64(9), ctypes.c_uint64(600), ctypes.c_uint64(SPLIT_POSITION))
    parents = (at(rows), ctypes.c_int64(len(rows)), at(gaussians.log_scales), at(gaussians.quats))
    called(kernels, kernels.splat_split_offsets, *key, *parents, at(out))
    torch.testing.assert_close(out, _split_offsets(gaussians, rows, 9, 600), rtol=0, atol=NORMAL_ATOL)


def test_morton_keys_interleave_the_places_along_the_axes(kernels: Kernels) -> None:
    lowest, size = np.array([-3.0, 1.0, 5.0], np.float32), np.array([6.0, 2.5, 0.0], np.float32)
    means = torch.rand(300, 3, generator=torch.Generator().manual_seed(2)) * 7.0 - 3.5
    means[0] = torch.tensor([3.0, 3.5, 5.0])  # the box's far corner
    means[1, 0] = torch.nan
    keys = torch.full((300,), -1)
    box = (array.ctypes.data_as(ctypes.c_void_p) for array in (lowest, size))
    called(kernels, kernels.splat_morton, at(means), ctypes.c_int64(300), *box, at(keys))

    assert torch.equal(keys, morton_keys(means, torch.from_numpy(lowest), torch.from_numpy(size)))
    cells = np.array([2**21 / 6.0, 2**21 / 2.5, 0.0], np.float32)
    places = np.nan_to_num((means.numpy() - lowest) * cells, nan=0.0).clip(0, 2**21 - 1).astype(int)
    for place, key in zip(places.tolist(), keys.tolist(), strict=True):
        expected = sum(((place[axis] >> bit) & 1) << (3 * bit + axis) for axis in range(3) for bit in range(21))
        assert key == expected


def test_nothing_to_do_is_no_error(kernels: Kernels) -> None:
    key, none = (ctypes.c_uint64(0),) * 3, ctypes.c_int64(0)
    called(kernels, kernels.splat_uniform, *key, none, None)
    called(kernels, kernels.splat_split_offsets, *key, None, none, None, None, None)
    called(kernels, kernels.splat_morton, None, none, None, None, None)
    called(kernels, kernels.splat_affine_colour, None, None, none, None)
