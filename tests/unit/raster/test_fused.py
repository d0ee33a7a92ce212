"""``fused_ssim`` and ``FusedAdam`` against plain torch."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from splatpipe.pipeline.raster.fused_adam import FusedAdam
from splatpipe.pipeline.raster.fused_ssim import fused_ssim
from splatpipe.pipeline.raster.isa import _native

SSIM, SSIM_GRADIENT = 5e-5, 2e-4  # of photo_loss


def plain_ssim(img1: Tensor, img2: Tensor, padding: str) -> Tensor:
    """Mean SSIM by convolutions with zeros beyond the borders, or without such windows."""
    taps = torch.exp(-0.5 * ((torch.arange(11, dtype=torch.float64) - 5.0) / 1.5) ** 2)
    taps = (taps / taps.sum()).to(img1)
    window = (taps[:, None] * taps)[None, None]

    def blur(image: Tensor) -> Tensor:
        b, c, h, w = image.shape
        blurred = conv2d(image.reshape(b * c, 1, h, w), window, padding=5 if padding == "same" else 0)
        return blurred.reshape(b, c, *blurred.shape[2:])

    mu1, mu2 = blur(img1), blur(img2)
    var1, var2, both = blur(img1 * img1) - mu1**2, blur(img2 * img2) - mu2**2, blur(img1 * img2) - mu1 * mu2
    c1, c2 = 0.01**2, 0.03**2
    return ((2 * mu1 * mu2 + c1) * (2 * both + c2) / ((mu1**2 + mu2**2 + c1) * (var1 + var2 + c2))).mean()


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("padding", ["same", "valid"])
@pytest.mark.parametrize("shape", [(1, 3, 30, 41), (2, 1, 17, 15), (2, 4, 11, 12), (3, 5, 40, 16)])
def test_ssim_agrees_with_its_definition(shape: tuple[int, ...], padding: str) -> None:
    generator = torch.Generator().manual_seed(1)
    img1, img2 = torch.rand(shape, generator=generator), torch.rand(shape, generator=generator)
    img2 = 0.7 * img1 + 0.3 * img2
    ours = img1.clone().requires_grad_()
    exact = img1.double().requires_grad_()
    value, truth = fused_ssim(ours, img2, padding), plain_ssim(exact, img2.double(), padding)  # type: ignore[arg-type]
    assert (value - truth).abs().detach() < SSIM
    value.backward()
    truth.backward()
    assert ours.grad is not None and exact.grad is not None
    assert (ours.grad - exact.grad).norm() < SSIM_GRADIENT * exact.grad.norm()


def test_small_images_and_images_like_themselves() -> None:
    one = torch.rand(1, 3, 3, 2)
    assert abs(float(fused_ssim(one, one)) - 1.0) < SSIM
    assert abs(float(fused_ssim(one.double(), 0.5 * one.double()) - plain_ssim(one, 0.5 * one, "same"))) < SSIM
    assert not fused_ssim(one.requires_grad_(), one, train=False).requires_grad


@pytest.mark.parametrize(
    ("img1", "img2", "padding"),
    [
        (torch.zeros(3, 20, 20), torch.zeros(3, 20, 20), "same"),
        (torch.zeros(1, 3, 20, 20), torch.zeros(1, 3, 20, 21), "same"),
        (torch.zeros(1, 3, 0, 20), torch.zeros(1, 3, 0, 20), "same"),
        (torch.zeros(1, 3, 20, 20), torch.zeros(1, 3, 20, 20).double(), "same"),
        (torch.zeros(1, 3, 20, 20, dtype=torch.uint8), torch.zeros(1, 3, 20, 20, dtype=torch.uint8), "same"),
        (torch.zeros(1, 3, 10, 20), torch.zeros(1, 3, 10, 20), "valid"),
        (torch.zeros(1, 3, 20, 20), torch.zeros(1, 3, 20, 20), "reflect"),
    ],
)
def test_images_that_cannot_be_compared_are_refused(img1: Tensor, img2: Tensor, padding: str) -> None:
    with pytest.raises(ValueError, match=r"\.$"):
        fused_ssim(img1, img2, padding)  # type: ignore[arg-type]


SHAPES = ((5, 3), (7,), (4, 16, 3), (3, 5, 33), (6, 100), (0, 3), ())


def trained(
    kind: type[torch.optim.Optimizer], steps: int, dtype: torch.dtype = torch.float32
) -> tuple[list[Tensor], torch.optim.Optimizer]:
    generator = torch.Generator().manual_seed(2)
    leaves = [torch.randn(shape, generator=generator).to(dtype).requires_grad_() for shape in SHAPES]
    groups = [{"params": leaves[:2], "lr": 0.01}, {"params": leaves[2:], "lr": 0.02, "betas": (0.8, 0.99)}]
    optimizer = kind(groups, eps=1e-12)  # type: ignore[call-arg, arg-type]
    for _ in range(steps):
        for leaf in leaves:
            leaf.grad = torch.randn(leaf.shape, generator=generator).to(dtype)
        optimizer.step()
    return leaves, optimizer


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_adam_steps_as_torchs_does(dtype: torch.dtype) -> None:
    (ours, fused), (theirs, plain) = trained(FusedAdam, 20, dtype), trained(torch.optim.Adam, 20, dtype)
    for mine, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-5)
        for name in ("step", "exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(fused.state[mine][name], plain.state[other][name], rtol=1e-4, atol=1e-6)


def test_adams_state_survives_saving_and_threads_do_not_matter() -> None:
    _native.set_threads(1)
    leaves, optimizer = trained(FusedAdam, 3)
    _native.set_threads(5)
    again, other = trained(FusedAdam, 3)
    assert all(torch.equal(a, b) for a, b in zip(leaves, again, strict=True))
    fresh = FusedAdam([{"params": again[:2]}, {"params": again[2:]}])
    fresh.load_state_dict(copy.deepcopy(optimizer.state_dict()))  # torch does not copy it
    for stepped in (optimizer, fresh):
        stepped.step()
    assert all(torch.equal(a, b) for a, b in zip(leaves, again, strict=True))
    assert other.state_dict()["param_groups"][1]["lr"] == 0.02


@pytest.mark.parametrize("shape", [(4, 3), (4, 100)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_adam_leaves_out_rows_that_are_not_visible_or_not_finite(shape: tuple[int, ...], dtype: torch.dtype) -> None:
    leaf = torch.ones(shape, dtype=dtype, requires_grad=True)
    optimizer = FusedAdam([leaf], lr=0.1)
    leaf.grad = torch.ones(shape, dtype=dtype)
    leaf.grad[2] = math.nan
    optimizer.step(visible=torch.tensor([True, False, True, True]))
    assert (leaf[[1, 2]] == 1.0).all()
    torch.testing.assert_close(leaf[[0, 3]], torch.full_like(leaf[[0, 3]], 0.9))
    assert (optimizer.state[leaf]["exp_avg"][[1, 2]] == 0.0).all()
    with pytest.raises(ValueError, match="visible"):
        optimizer.step(visible=torch.ones(3, dtype=torch.bool))


def test_adam_evaluates_a_closure() -> None:
    leaf = torch.ones(3, requires_grad=True)
    optimizer = FusedAdam([leaf], lr=0.1)

    def loss() -> float:
        optimizer.zero_grad()
        value = leaf.square().sum()
        value.backward()
        return float(value.detach())

    assert optimizer.step(loss) == 3.0
    assert (leaf < 1.0).all()


def test_adam_steps_the_same_whatever_torchs_defaults() -> None:
    usual, _ = trained(FusedAdam, 1)
    leaves, optimizer = trained(FusedAdam, 0)
    generator = torch.Generator().manual_seed(2)
    for shape in SHAPES:
        torch.randn(shape, generator=generator)
    for leaf in leaves:
        leaf.grad = torch.randn(leaf.shape, generator=generator)
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with torch.device("meta"):
            optimizer.step()
    finally:
        torch.set_default_dtype(before)
    assert all(torch.equal(a, b) for a, b in zip(leaves, usual, strict=True))


def test_adam_refuses_a_sparse_gradient() -> None:
    leaf = torch.ones(3, 2, requires_grad=True)
    leaf.grad = torch.sparse_coo_tensor(torch.tensor([[1]]), torch.ones(1, 2), (3, 2), check_invariants=True)
    with pytest.raises(ValueError, match="sparse"):
        FusedAdam([leaf]).step()
    assert (leaf == 1.0).all()


@pytest.mark.parametrize("named", [{"betas": (2, 3)}, {"betas": (0.9,)}, {"lr": math.inf}, {"eps": -1.0}])
def test_adam_refuses_hostile_numbers_of_a_group(named: dict[str, float]) -> None:
    optimizer = FusedAdam([torch.zeros(1, requires_grad=True)])
    with pytest.raises(ValueError, match="Adam cannot work"):
        optimizer.add_param_group({"params": [torch.zeros(2, requires_grad=True)], **named})
    assert len(optimizer.param_groups) == 1
    optimizer.add_param_group({"params": [torch.zeros(2, requires_grad=True)], "betas": (0.5, 0.9)})
    assert [group["betas"] for group in optimizer.param_groups] == [(0.9, 0.999), (0.5, 0.9)]


@pytest.mark.parametrize("named", [{"lr": -1.0}, {"lr": math.nan}, {"betas": (0.9, 1.0)}, {"eps": 0.0}])
def test_adam_refuses_hostile_numbers(named: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="Adam cannot work"):
        FusedAdam([torch.zeros(1, requires_grad=True)], **named)  # type: ignore[arg-type]
