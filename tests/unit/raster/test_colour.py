"""Affine maps of an image's colours: on every instruction set that this CPU has."""

import pytest
import torch
from torch import Tensor

from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.colour import affine_colour

pytestmark = pytest.mark.usefixtures("isa")


def gradients(
    height: int, width: int, dtype: torch.dtype, strided: bool = False
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Return the mapped image, and the gradients of a weighted sum of it by image and map."""
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


def test_any_number_of_threads_gives_the_same_bits() -> None:
    found = []
    for threads in (1, 2, 5):
        _native.set_threads(threads)
        found.append(gradients(211, 313, torch.float32))
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True) if a is not None and b is not None)
