"""Affine maps of a picture's colours, one or a grid of them: on every instruction set that this CPU has."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch import Tensor

from splatpipe.pipeline.raster import _native, set_threads
from splatpipe.pipeline.raster.colour import affine_colour, bilateral_colour


@pytest.fixture(params=_native.isas(), autouse=True)
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    before = _native.isa()
    _native.set_isa(request.param)
    yield request.param
    _native.set_isa(before)
    set_threads(2)


def gradients(
    height: int, width: int, dtype: torch.dtype, strided: bool = False
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """The mapped picture, and the gradients of a weighted sum of it by the picture and by the map."""
    generator = torch.Generator().manual_seed(height * 1000 + width)
    picture, weights = (torch.rand(height, width, 3, generator=generator).to(dtype) for _ in range(2))
    affine = (torch.eye(3, 4) + 0.3 * torch.randn(3, 4, generator=generator)).to(dtype).requires_grad_()
    if strided:
        picture = picture.permute(1, 0, 2).contiguous().permute(1, 0, 2)
    picture.requires_grad_()
    out = affine_colour(picture, affine)
    (out * weights).sum().backward()
    return out.detach(), picture.grad, affine.grad


@pytest.mark.parametrize("size", [(1, 1), (1, 15), (3, 16), (7, 37), (130, 257)])
@pytest.mark.parametrize("strided", [False, True])
def test_map_and_gradients_are_those_of_the_definition(size: tuple[int, int], strided: bool) -> None:
    for ours, exact in zip(gradients(*size, torch.float32, strided), gradients(*size, torch.float64), strict=True):
        assert ours is not None and exact is not None
        assert torch.linalg.vector_norm(ours - exact) < 1e-6 * torch.linalg.vector_norm(exact)


def test_any_number_of_threads_leaves_the_same_bits() -> None:
    found = []
    for threads in (1, 2, 5):
        set_threads(threads)
        found.append(gradients(211, 313, torch.float32))
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True) if a is not None and b is not None)


def bilateral_gradients(
    size: tuple[int, int], nodes: tuple[int, int, int], dtype: torch.dtype
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """The mapped picture, some of it brighter than 1 and darker than 0, and gradients of a weighted sum of it."""
    generator = torch.Generator().manual_seed(size[0] * 1000 + size[1])
    picture = (1.2 * torch.rand(*size, 3, generator=generator) - 0.1).to(dtype).requires_grad_()
    weights = torch.randn(*size, 3, generator=generator).to(dtype)
    grid = (torch.eye(3, 4).reshape(12) + 0.3 * torch.randn(*nodes, 12, generator=generator)).to(dtype)
    grid.requires_grad_()
    out = bilateral_colour(picture, grid)
    (out * weights).sum().backward()
    return out.detach(), picture.grad, grid.grad


@pytest.mark.parametrize("nodes", [(2, 2, 2), (4, 8, 8), (16, 5, 64)])
@pytest.mark.parametrize("size", [(1, 1), (1, 15), (3, 16), (7, 37), (130, 257)])
def test_a_grid_of_maps_and_its_gradients_are_those_of_the_definition(
    size: tuple[int, int], nodes: tuple[int, int, int]
) -> None:
    found, exact = (bilateral_gradients(size, nodes, dtype) for dtype in (torch.float32, torch.float64))
    for ours, theirs in zip(found, exact, strict=True):
        assert ours is not None and theirs is not None
        assert torch.linalg.vector_norm(ours - theirs) < 1e-5 * torch.linalg.vector_norm(theirs)


def test_a_pixel_blends_the_maps_of_the_eight_nodes_around_it() -> None:
    rng = np.random.default_rng(1)
    picture, grid = rng.random((5, 9, 3)), rng.normal(size=(3, 4, 2, 3, 4))
    expected = np.zeros_like(picture)
    for y, x in np.ndindex(5, 9):
        luminance = picture[y, x] @ [0.299, 0.587, 0.114]
        place = np.array([2 * luminance, 3 * (y + 0.5) / 5, (x + 0.5) / 9])
        below = np.floor(place).astype(int)
        for corner in np.ndindex(2, 2, 2):
            node = below + corner
            affine = grid[tuple(node)] * np.prod(1.0 - np.abs(place - node))
            expected[y, x] += affine[:, :3] @ picture[y, x] + affine[:, 3]
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
        found = bilateral_colour(torch.tensor(picture).to(dtype), torch.tensor(grid.reshape(3, 4, 2, 12)).to(dtype))
        assert np.abs(found.numpy() - expected).max() < tolerance


def test_gradients_of_a_grid_are_finite_differences_of_the_definition() -> None:
    generator = torch.Generator().manual_seed(3)
    picture = torch.rand(3, 5, 3, generator=generator, dtype=torch.float64)
    level = 3.0 * (picture @ torch.tensor([0.299, 0.587, 0.114], dtype=torch.float64))
    assert float((level - level.round()).abs().min()) > 1e-3  # no luminance at a node, where the slope jumps
    grid = torch.randn(4, 2, 3, 12, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(bilateral_colour, (picture.requires_grad_(), grid.requires_grad_()))


def test_luminance_beyond_black_and_white_takes_the_last_map_and_has_no_slope() -> None:
    grid = torch.eye(3, 4).reshape(12).repeat(2, 2, 2, 1)
    grid[1] *= 3.0
    picture = torch.tensor([-0.5, 2.0]).view(1, 2, 1).repeat(1, 1, 3).requires_grad_()
    out = bilateral_colour(picture, grid)
    out.sum().backward()
    assert torch.allclose(out[0, :, 0], torch.tensor([-0.5, 6.0]))
    assert picture.grad is not None and torch.allclose(picture.grad[0, :, 0], torch.tensor([1.0, 3.0]))


def test_a_grid_of_one_map_is_that_map() -> None:
    generator = torch.Generator().manual_seed(2)
    picture, affine = torch.rand(60, 200, 3, generator=generator), torch.randn(3, 4, generator=generator)
    grid = affine.reshape(12).repeat(4, 8, 8, 1)
    assert torch.allclose(bilateral_colour(picture, grid), affine_colour(picture, affine), atol=1e-5)


def test_any_number_of_threads_slices_a_grid_to_the_same_bits() -> None:
    found = []
    for threads in (1, 2, 5):
        set_threads(threads)
        found.append(bilateral_gradients((211, 313), (4, 8, 8), torch.float32))
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True) if a is not None and b is not None)


@pytest.mark.parametrize("nodes", [(1, 8, 8), (17, 8, 8), (4, 1, 8), (4, 8, 65)])
def test_grids_too_small_or_too_large_are_refused(nodes: tuple[int, int, int]) -> None:
    with pytest.raises(ValueError, match="a grid has"):
        bilateral_colour(torch.zeros(8, 8, 3), torch.zeros(*nodes, 12))
