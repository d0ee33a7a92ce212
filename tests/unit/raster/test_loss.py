"""The native photometric loss against its definition by kornia in float64."""

import functools
from pathlib import Path

import kornia
import numpy as np
import pytest
import torch
from PIL import Image

from splatpipe.demo import capture_path
from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.loss import photo_loss, photo_loss_reference

# Relative, the gradient in L2, against float64. The worst case is a flat white image, where the variances of the
# windows are differences of float32 numbers near one; kornia's own float32 is off by 2e-3 and 1e-4 there.
LOSS_RTOL = 1e-5
GRADIENT_RTOL = 5e-5

SIZES = [(6, 6), (6, 40), (7, 9), (11, 11), (12, 11), (37, 259), (129, 33), (130, 270)]
"""A tile is 128 x 256: below the window, odd, and over several tiles."""


def smooth(h: int, w: int) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    return torch.stack([0.5 + 0.4 * torch.sin(x / 30), 0.5 + 0.45 * torch.cos(y / 25), (x + y) / (h + w)], dim=-1)


def crop(path: Path, h: int, w: int) -> torch.Tensor:
    """A part of a photo that has some of everything."""
    with Image.open(path) as image:
        part = np.array(image.convert("RGB"))[200 : 200 + h, 300 : 300 + w]
    return torch.from_numpy(part.astype(np.float32) / 255.0)


def pair(kind: str, h: int, w: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A render and its photo."""
    generator = torch.Generator().manual_seed(h * w)
    noise = torch.rand(h, w, 3, generator=generator)
    match kind:
        case "random":
            return noise, torch.rand(h, w, 3, generator=generator)
        case "smooth":
            return (smooth(h, w) + 0.05 * noise).clamp(0, 1), smooth(h, w)
        case "nearly equal":
            return smooth(h, w) + 1e-3 * noise, smooth(h, w)
        case "black":
            return 0.01 * noise, torch.zeros(h, w, 3)
        case "white":
            return 1 - 0.01 * noise, torch.ones(h, w, 3)
        case "photo":  # two neighbouring photos of a house: edges, shadows, sky
            first, second = sorted(capture_path().glob("*.JPG"))[:2]
            return crop(first, h, w), crop(second, h, w)
        case _:
            raise ValueError(kind)


def loss_and_gradient(function, render, *args) -> tuple[float, torch.Tensor]:
    leaf = render.clone().requires_grad_()
    loss = function(leaf, *args)
    loss.backward()
    return loss.item(), leaf.grad


@functools.cache
def exact_loss_and_gradient(kind: str, size: tuple[int, int], weight: float, masked: bool):
    render, photo = (image.double() for image in pair(kind, *size))
    return loss_and_gradient(photo_loss_reference, render, photo, weight, some_mask(size) if masked else None)


def some_mask(size: tuple[int, int]) -> torch.Tensor:
    mask = torch.rand(size, generator=torch.Generator().manual_seed(1)) > 0.4
    mask[:, : size[1] // 4] = False
    return mask


def assert_as_reference(kind: str, size: tuple[int, int], weight: float = 0.2, masked: bool = False) -> None:
    mask = some_mask(size) if masked else None
    loss, gradient = loss_and_gradient(photo_loss, *pair(kind, *size), weight, mask)
    exact = exact_loss_and_gradient(kind, size, weight, masked)
    assert loss == pytest.approx(exact[0], rel=LOSS_RTOL, abs=1e-12)
    error = torch.linalg.vector_norm(gradient - exact[1])
    assert error <= GRADIENT_RTOL * torch.linalg.vector_norm(exact[1])


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kind", ["random", "smooth", "nearly equal", "black", "white", "photo"])
def test_native_loss_and_gradient_are_the_reference(isa, kind, size):
    assert_as_reference(kind, size)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("size", [(6, 6), (140, 270)])
def test_masked_native_loss_and_gradient_are_the_reference(isa, size, weight):
    assert_as_reference("random", size, weight, masked=True)


def test_reference_is_l1_and_kornias_ssim():
    render, photo = (image.double() for image in pair("random", 20, 30))
    chw = [image.permute(2, 0, 1)[None] for image in (render, photo)]
    dssim = 2 * kornia.losses.ssim_loss(*chw, 11, eps=1e-12)  # kornia's loss is half of 1 - SSIM
    expected = 0.8 * (render - photo).abs().mean() + 0.2 * dssim
    torch.testing.assert_close(photo_loss_reference(render, photo), expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize("function", [photo_loss, photo_loss_reference])
def test_masked_pixels_neither_count_nor_get_a_gradient(function):
    render, photo = pair("random", 40, 50)
    mask = torch.ones(40, 50, dtype=torch.bool)
    mask[10:30, 5:20] = False
    other = torch.where(mask[..., None], render, 1 - render)
    other[12, 7] = torch.nan
    loss, gradient = loss_and_gradient(function, render, photo, 0.2, mask)
    other_loss, other_gradient = loss_and_gradient(function, other, photo, 0.2, mask)
    assert loss == other_loss
    assert torch.equal(gradient, other_gradient)
    assert not gradient[~mask].any()
    assert gradient[mask].abs().min() > 0


@pytest.mark.parametrize("function", [photo_loss, photo_loss_reference])
def test_nothing_to_count_gives_zero(function):
    render, photo = pair("random", 8, 8)
    loss, gradient = loss_and_gradient(function, render, photo, 0.2, torch.zeros(8, 8, dtype=torch.bool))
    assert loss == 0.0
    assert not gradient.any()


def test_full_mask_is_no_mask():
    render, photo = pair("random", 30, 40)
    everywhere = torch.ones(30, 40, dtype=torch.bool)
    without = loss_and_gradient(photo_loss, render, photo, 0.2, None)
    masked = loss_and_gradient(photo_loss, render, photo, 0.2, everywhere)
    assert without[0] == masked[0]
    assert torch.equal(without[1], masked[1])


def test_equal_images_have_no_gradient_but_rounding():
    photo = smooth(30, 40)
    loss, gradient = loss_and_gradient(photo_loss, photo.clone(), photo)
    assert 0.0 <= loss < 1e-6
    assert gradient.abs().max() < 1e-9


@pytest.mark.parametrize("masked", [False, True])
def test_same_bits_for_any_number_of_threads(isa, masked):
    render, photo = pair("random", 300, 600)
    mask = torch.rand(300, 600) > 0.2 if masked else None
    results = []
    for threads in (1, 2, 3, 8):
        _native.set_threads(threads)
        results.append(loss_and_gradient(photo_loss, render, photo, 0.2, mask))
    for loss, gradient in results[1:]:
        assert loss == results[0][0]
        assert torch.equal(gradient, results[0][1])


def test_gradient_follows_the_chain_rule_and_any_layout():
    render, photo = pair("random", 20, 24)
    leaf = render.permute(2, 0, 1).contiguous().requires_grad_()  # what comes out of a convolution
    (3.0 * photo_loss(leaf.permute(1, 2, 0), photo.double())).backward()
    _, expected = loss_and_gradient(photo_loss, render, photo)
    torch.testing.assert_close(leaf.grad.permute(1, 2, 0), 3.0 * expected)


def test_float64_takes_the_reference():
    render, photo = (image.double() for image in pair("random", 9, 9))
    assert photo_loss(render, photo).dtype == torch.float64
    assert torch.equal(photo_loss(render, photo), photo_loss_reference(render, photo))


@pytest.mark.parametrize("function", [photo_loss, photo_loss_reference])
def test_images_that_cannot_be_compared_are_refused(function):
    with pytest.raises(ValueError, match="6 pixels a side"):
        function(torch.zeros(5, 40, 3), torch.zeros(5, 40, 3))
    with pytest.raises((ValueError, TypeError)):
        function(torch.zeros(8, 9, 3), torch.zeros(9, 8, 3))
    with pytest.raises((ValueError, TypeError)):
        function(torch.zeros(8, 9, 3), torch.zeros(8, 9, 3), 0.2, torch.zeros(9, 8, dtype=torch.bool))
