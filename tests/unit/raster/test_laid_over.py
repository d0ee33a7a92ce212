"""A render composited over the sky by the CPU's kernels: each instruction set against the definition."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.sky import SkyLayer, laid_over_nodes, laid_over_nodes_reference
from splatpipe.pipeline.splat.sky.panorama import STEP_PX, nodes_along

PICTURE_ATOL = 1e-6  # colours are at most 2, in float32
GRADIENT_RTOL = 2e-6  # L2; a node's is a sum over up to 15 x 15 pixels
BACKGROUND = (0.2, 0.5, 0.1)
# One pixel; a last node at the last pixel, one outside; a row, a column; vectors' ends; more columns than a tile.
SIZES = [(1, 1), (17, 33), (18, 34), (1, 40), (40, 1), (9, 15), (50, 64), (23, 700)]


pytestmark = pytest.mark.usefixtures("isa")


class RandomPicture:
    """A random image in front of random nodes.

    Args:
        height, width: Its own.
        kind: ``known`` with a mask and what is around, ``unknown`` without, ``masked`` with a mask alone.
        dtype: Of all numbers.
    """

    def __init__(self, height: int, width: int, kind: str, dtype: torch.dtype = torch.float32) -> None:
        generator = torch.Generator().manual_seed(height * 1000 + width)

        def rand(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator).to(dtype)

        grid = (nodes_along(height), nodes_along(width), 3)
        self.colour, self.weight = rand(height, width, 3), rand(height, width, 3)
        self.alpha, self.nodes, elsewhere = rand(height, width), rand(*grid), rand(*grid)
        mask = rand(height, width) > 0.4
        mask[:, width // 2 + 20 :] = False  # whole vectors and tiles without
        self.behind = SkyLayer(BACKGROUND)
        if kind == "masked":
            self.behind = SkyLayer(BACKGROUND, mask=mask)
        if kind == "known":
            self.behind = SkyLayer(BACKGROUND, elsewhere, mask | (rand(height, width) > 0.7), mask)

    def found(self, reference: bool = False) -> list[Tensor]:
        """Return the image, and the gradients of a weighted sum of it by colour, alpha and nodes."""
        leaves = [tensor.clone().requires_grad_() for tensor in (self.colour, self.alpha, self.nodes)]
        lay = laid_over_nodes_reference if reference else laid_over_nodes
        picture = lay(*leaves, self.behind)
        (self.weight * picture).sum().backward()
        return [picture.detach(), *(torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kind", ["known", "unknown", "masked"])
def test_picture_and_gradients_are_those_of_the_definition(size: tuple[int, int], kind: str) -> None:
    ours = RandomPicture(*size, kind).found()
    exact = RandomPicture(*size, kind, torch.float64).found(reference=True)
    torch.testing.assert_close(ours[0], exact[0].float(), rtol=0, atol=PICTURE_ATOL)
    for gradient, right in zip(ours[1:], exact[1:], strict=True):
        assert torch.linalg.vector_norm(gradient - right) <= GRADIENT_RTOL * torch.linalg.vector_norm(right)
    assert bool(ours[3].any()) == (kind != "unknown")


def test_gradients_of_the_definition_are_those_of_finite_differences() -> None:
    given = RandomPicture(10, 12, "known", torch.float64)
    everywhere = torch.ones(10, 12, dtype=torch.bool)  # elsewhere the nodes have less than their derivative
    behind = replace(given.behind, around=everywhere, mask=everywhere)
    leaves = tuple(tensor.requires_grad_() for tensor in (given.colour, given.alpha, given.nodes))
    assert torch.autograd.gradcheck(lambda *leaves: laid_over_nodes_reference(*leaves, behind), leaves, fast_mode=True)


@pytest.mark.parametrize("kind", ["known", "unknown"])
def test_any_number_of_threads_gives_the_same_bits(kind: str) -> None:
    given, found = RandomPicture(211, 313, kind), []
    for threads in (1, 2, 5):
        _native.set_threads(threads)
        found.append(given.found())
    for other in found[1:]:
        assert all(torch.equal(one, two) for one, two in zip(found[0], other, strict=True))


def test_windows_show_what_the_whole_shows_and_their_gradients_add_up() -> None:
    given = RandomPicture(60, 90, "known")
    whole = given.found()
    picture, by_alpha, by_nodes = (torch.zeros_like(tensor) for tensor in (whole[0], whole[2], whole[3]))
    for rows in (slice(0, 24), slice(24, 60)):
        for columns in (slice(0, 40), slice(40, 90)):
            part = RandomPicture(60, 90, "known")
            there = (
                slice(rows.start // STEP_PX, rows.start // STEP_PX + nodes_along(rows.stop - rows.start)),
                slice(columns.start // STEP_PX, columns.start // STEP_PX + nodes_along(columns.stop - columns.start)),
            )
            full = given.behind
            assert full.elsewhere is not None and full.around is not None and full.mask is not None
            cut = (rows, columns)
            part.colour, part.alpha, part.weight = given.colour[cut], given.alpha[cut], given.weight[cut]
            part.nodes = given.nodes[there]
            part.behind = SkyLayer(BACKGROUND, full.elsewhere[there], full.around[cut], full.mask[cut])
            found = part.found()
            picture[cut], by_alpha[cut] = found[0], found[2]
            by_nodes[there] += found[3]
    torch.testing.assert_close(picture, whole[0], rtol=0, atol=PICTURE_ATOL)
    torch.testing.assert_close(by_alpha, whole[2], rtol=0, atol=PICTURE_ATOL)
    assert torch.linalg.vector_norm(by_nodes - whole[3]) < GRADIENT_RTOL * torch.linalg.vector_norm(whole[3])


def test_values_outside_the_sky_do_not_matter() -> None:
    given = RandomPicture(30, 50, "known")
    expected = given.found()
    mask = given.behind.mask
    assert mask is not None
    given.alpha[~mask] = torch.nan
    given.weight[~mask] = torch.inf
    assert torch.equal(given.found()[3], expected[3])


def test_nodes_that_do_not_fit_are_refused() -> None:
    given = RandomPicture(20, 20, "known")
    for step, around in ((9, given.behind.around), (0, given.behind.around), (6, given.behind.around), (8, None)):
        with pytest.raises(ValueError, match="nodes"):
            laid_over_nodes(given.colour, given.alpha, given.nodes, replace(given.behind, step=step, around=around))


def test_arrays_of_other_sizes_are_refused() -> None:
    colour, alpha, nodes = torch.zeros(20, 20, 3), torch.zeros(20, 20), torch.zeros(4, 4, 3)
    mask, narrow = torch.zeros(20, 20, dtype=torch.uint8), torch.zeros(20, 19, dtype=torch.uint8)
    good = (alpha, nodes, nodes, mask, mask, 8, BACKGROUND)
    _native.lay_over(good, colour, colour.clone())
    for place, wrong in ((0, alpha[:19]), (1, nodes[:3]), (2, nodes[:3]), (3, narrow), (4, narrow)):
        sky = (*good[:place], wrong, *good[place + 1 :])
        with pytest.raises(ValueError, match=r"differ|reach"):
            _native.lay_over(sky, colour, colour.clone())
        with pytest.raises(ValueError, match=r"differ|reach|many"):
            _native.lay_over_backward(sky, colour, alpha.clone(), nodes.clone())
    for arguments in ((colour[:19], alpha, nodes), (colour, alpha[:19], nodes), (colour, alpha, nodes[:3])):
        with pytest.raises(ValueError, match=r"differ|many"):
            _native.lay_over_backward(good, *arguments)
    with pytest.raises(ValueError, match="no mask"):
        _native.lay_over_backward((*good[:4], None, *good[5:]), colour, alpha, nodes)
