"""Activated Gaussians with plain features or spherical harmonics, rendered by ``rasterization``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from splatpipe.pipeline.raster.rasterization import rasterization

LEAVES = ("means", "quats", "scales", "opacities", "colors")


@dataclass(frozen=True)
class Case:
    """What to render; other arguments of ``rasterization`` in ``options``."""

    count: int = 40
    channels: int = 3
    views: int = 1
    per_view: bool = False
    width: int = 41
    height: int = 27
    seed: int = 1
    behind: bool = False
    options: tuple[tuple[str, Any], ...] = field(default=())

    def option(self, name: str, default: Any) -> Any:
        return dict(self.options).get(name, default)


def arguments(case: Case, dtype: torch.dtype) -> dict[str, Tensor]:
    """Random Gaussians before turned and moved cameras: some out of view, two opaque, two not there at all."""
    generator = torch.Generator().manual_seed(case.seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    n, c = case.count, case.views
    means = normal(n, 3) * torch.tensor([1.6, 1.2, 1.0]) + torch.tensor([0.0, 0.0, 4.0])
    if case.behind:
        means[:, 2] = -2.0
    opacities = torch.rand(n, generator=generator, dtype=torch.float64)
    opacities[:2], opacities[2:4] = 1.0, 0.0
    degree = case.option("sh_degree", None)
    of_colors = (case.channels,) if degree is None else (16, 3)
    colors = normal(*((c,) if case.per_view else ()), n, *of_colors)  # of either sign
    viewmats, ks = torch.eye(4, dtype=torch.float64).repeat(c, 1, 1), torch.eye(3, dtype=torch.float64).repeat(c, 1, 1)
    for view in range(c):
        turn = normal(3, 3) * 0.1
        viewmats[view, :3, :3] = torch.matrix_exp(turn - turn.T)
        viewmats[view, :3, 3] = normal(3) * 0.2
        ks[view, 0, 0], ks[view, 1, 1] = 40.0 + 3.0 * view, 43.0
        ks[view, 0, 2], ks[view, 1, 2] = 0.45 * case.width, 0.55 * case.height
    tensors = {
        "means": means,
        "quats": normal(n, 4),
        "scales": torch.exp(normal(n, 3) * 0.4 - 1.5),
        "opacities": opacities,
        "colors": colors,
        "viewmats": viewmats,
        "Ks": ks,
    }
    if case.option("render_mode", "RGB") not in ("D", "ED"):
        tensors["backgrounds"] = normal(c, 3 if degree is not None else case.channels)
    return {name: tensor.to(torch.float32).to(dtype) for name, tensor in tensors.items()}  # both of the same numbers


@dataclass(frozen=True)
class Outcome:
    """Images, alpha, and the gradients of a weighted sum of both."""

    images: Tensor
    alphas: Tensor
    gradients: dict[str, Tensor]


def differentiate(given: dict[str, Tensor], images: Tensor, alphas: Tensor) -> Outcome:
    generator = torch.Generator().manual_seed(5)
    total = images.new_zeros(())
    for picture in (images, alphas):
        weights = torch.randn(picture.shape, generator=generator, dtype=torch.float64)
        total = total + (picture * weights.to(picture.device)).sum()
    leaves = [given[name] for name in LEAVES]
    gradients = (
        torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True)
        if total.requires_grad
        else [torch.zeros_like(leaf) for leaf in leaves]
    )
    on_cpu = {name: gradient.cpu() for name, gradient in zip(LEAVES, gradients, strict=True)}
    return Outcome(images.detach().cpu(), alphas.detach().cpu(), on_cpu)


def leaves_of(given: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.requires_grad_(name in LEAVES) for name, tensor in given.items()}


def render(case: Case, dtype: torch.dtype = torch.float32, where: torch.device | None = None) -> Outcome:
    """Render on a device, the CPU by default; the outcome is on the CPU."""
    given = leaves_of({name: tensor.to(where) for name, tensor in arguments(case, dtype).items()})
    images, alphas, _ = rasterization(**given, width=case.width, height=case.height, **dict(case.options))
    return differentiate(given, images, alphas)


def options(**named: Any) -> tuple[tuple[str, Any], ...]:
    return tuple(named.items())
