"""The loss on parts of a photo, cropped with the margin of SSIM's windows, against the whole photo's."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.loss import SSIM_REACH_PX, Rectangle, photo_loss, photo_loss_reference

LOSS_RTOL = {torch.float64: 1e-12, torch.float32: 2e-6}
GRADIENT_RTOL = {torch.float64: 1e-12, torch.float32: 1e-5}
"""Relative, the gradient in L2: sums in another order."""

CUTS = [
    ((24, 31), (0, 24), (0, 15, 31)),
    ((37, 41), (0, 17, 37), (0, 13, 27, 41)),
    ((30, 30), (0, 2, 30), (0, 28, 30)),  # parts thinner than what is around them
    ((141, 275), (0, 70, 141), (0, 91, 275)),  # over several of the CPU kernel's tiles
]
"""Sizes, with the rows and the columns at which parts end."""


def pair(height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """A render, its photo and a mask."""
    generator = torch.Generator().manual_seed(height * width)
    render, photo = (torch.rand(height, width, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    mask = torch.rand(height, width, generator=generator) > 0.3
    mask[height // 3 : height // 2, : width // 3] = False
    return render, photo, mask


def parts(rows: tuple[int, ...], columns: tuple[int, ...]) -> list[tuple[Rectangle, Rectangle]]:
    """Return the crop of the image, and its part that counts, in the crop's pixels."""
    found = []
    for (top, bottom), (left, right) in itertools.product(itertools.pairwise(rows), itertools.pairwise(columns)):
        cut = (
            max(0, left - SSIM_REACH_PX),
            max(0, top - SSIM_REACH_PX),
            min(columns[-1], right + SSIM_REACH_PX),
            min(rows[-1], bottom + SSIM_REACH_PX),
        )
        found.append((cut, (left - cut[0], top - cut[1], right - cut[0], bottom - cut[1])))
    return found


def of_parts(
    function: Callable[..., Tensor],
    pictures: tuple[Tensor, Tensor, Tensor | None],
    cuts: list[tuple[Rectangle, Rectangle]],
) -> tuple[float, Tensor]:
    """The parts' losses and gradients, weighted by how many of their pixels count."""
    render, photo, mask = pictures
    counts = torch.ones(render.shape[:2], dtype=torch.bool) if mask is None else mask
    total, gradient = 0.0, torch.zeros_like(render)
    for (left, top, right, bottom), inner in cuts:
        here = (slice(top, bottom), slice(left, right))
        leaf = render[here].clone().requires_grad_()
        loss = function(leaf, photo[here], 0.2, None if mask is None else mask[here], inner)
        loss.backward()
        share = int(counts[here][inner[1] : inner[3], inner[0] : inner[2]].sum()) / int(counts.sum())
        assert leaf.grad is not None
        total += share * loss.item()
        gradient[here] += share * leaf.grad
    return total, gradient


def of_whole(function: Callable[..., Tensor], render: Tensor, *others: object) -> tuple[float, Tensor]:
    leaf = render.clone().requires_grad_()
    loss = function(leaf, *others)
    loss.backward()
    assert leaf.grad is not None
    return loss.item(), leaf.grad


def relative(found: Tensor, exact: Tensor) -> float:
    return float(torch.linalg.vector_norm(found.double() - exact.double()) / torch.linalg.vector_norm(exact.double()))


def check_parts(function: Callable[..., Tensor], dtype: torch.dtype, cut: tuple, masked: bool) -> None:
    (height, width), rows, columns = cut
    render, photo, mask = pair(height, width)
    pictures = (render.to(dtype), photo.to(dtype), mask if masked else None)
    loss, gradient = of_whole(function, pictures[0], pictures[1], 0.2, pictures[2])
    found = of_parts(function, pictures, parts(rows, columns))
    assert found[0] == pytest.approx(loss, rel=LOSS_RTOL[dtype])
    assert relative(found[1], gradient) < GRADIENT_RTOL[dtype]


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("cut", CUTS[:3], ids=str)
def test_references_parts_add_up_to_the_whole(cut, masked):
    check_parts(photo_loss_reference, torch.float64, cut, masked)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("cut", CUTS, ids=str)
def test_native_parts_add_up_to_the_whole(isa, cut, masked):
    check_parts(photo_loss, torch.float32, cut, masked)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("inner", [(0, 0, 1, 1), (3, 4, 20, 21), (12, 0, 31, 9), (0, 25, 31, 29), (30, 28, 31, 29)])
def test_native_is_the_reference_wherever_the_counting_pixels_lie(isa, inner, masked):
    """Also closer to the image's border than the windows' radius, where the image is reflected."""
    render, photo, mask = pair(29, 31)
    weights = (0.2, mask if masked else None, inner)
    loss, gradient = of_whole(photo_loss_reference, render, photo, *weights)
    found = of_whole(photo_loss, render.float(), photo.float(), *weights)
    assert found[0] == pytest.approx(loss, rel=1e-5, abs=1e-12)
    assert relative(found[1], gradient) < 5e-5 if bool(gradient.any()) else not found[1].any()


@pytest.mark.parametrize("function", [photo_loss, photo_loss_reference])
def test_only_l1_ends_at_the_counting_pixels(function):
    """A pixel beside them is seen by their windows, so that it has SSIM's gradient; one further off has none."""
    render, photo, _ = pair(40, 40)
    inner = (15, 10, 25, 30)
    _, l1 = of_whole(function, render, photo, 0.0, None, inner)
    _, ssim = of_whole(function, render, photo, 1.0, None, inner)
    assert bool((l1[10:30, 15:25] != 0).all())
    assert int((l1 != 0).any(-1).sum()) == 20 * 10
    assert bool((ssim[5:35, 10:30] != 0).all())
    assert int((ssim != 0).any(-1).sum()) == 30 * 20


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_all_of_it_is_the_same_bits_as_no_rectangle(dtype):
    render, photo, mask = pair(33, 47)
    for given in (None, mask):
        without = of_whole(photo_loss, render.to(dtype), photo.to(dtype), 0.2, given)
        whole = of_whole(photo_loss, render.to(dtype), photo.to(dtype), 0.2, given, (0, 0, 47, 33))
        assert without[0] == whole[0]
        assert torch.equal(without[1], whole[1])


@pytest.mark.parametrize("function", [photo_loss, photo_loss_reference])
def test_nothing_that_counts_inside_gives_zero(function):
    render, photo, mask = pair(20, 20)
    mask[:10] = False
    loss, gradient = of_whole(function, render.float(), photo.float(), 0.2, mask, (0, 0, 20, 10))
    assert loss == 0.0
    assert not gradient.any()


def test_parts_have_the_same_bits_for_any_number_of_threads(isa):
    render, photo, mask = pair(280, 560)
    results = []
    for threads in (1, 2, 3):
        _native.set_threads(threads)
        results.append(of_whole(photo_loss, render.float(), photo.float(), 0.2, mask, (5, 5, 555, 275)))
    for loss, gradient in results[1:]:
        assert loss == results[0][0]
        assert torch.equal(gradient, results[0][1])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("inner", [(0, 0, 21, 20), (5, 5, 5, 20), (-1, 0, 20, 20), (0, 8, 20, 7)])
def test_rectangles_outside_are_refused(dtype, inner):
    render, photo, _ = pair(20, 20)
    with pytest.raises(ValueError, match="no part of"):
        photo_loss(render.to(dtype), photo.to(dtype), 0.2, None, inner)
