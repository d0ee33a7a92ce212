"""``rasterization`` against a dense oracle: every pixel times every Gaussian, projected by gsplat's torch code."""

from __future__ import annotations

import functools
import math
from typing import Any

import pytest
import torch
from activated_scenes import LEAVES, Case, Outcome, arguments, differentiate, leaves_of, options, render
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci, _spherical_harmonics
from torch import Tensor

from splatpipe.pipeline.raster.rasterization import rasterization

LEAST_DB = 60.0  # of an image, its peak the largest value expected, at least 1
GRADIENT = 1e-4  # L2, relative, float32 with the kernels against float64
NO_GRADIENT = 1e-6  # anything smaller is rounding
MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


def oracle(case: Case, given: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Images and alpha, by their definition."""
    means, mode = given["means"], case.option("render_mode", "RGB")
    covariances, _ = _quat_scale_to_covar_preci(given["quats"], given["scales"], True, False)
    radii, means2d, depths, conics, compensations = _fully_fused_projection(
        means,
        covariances,
        given["viewmats"],
        given["Ks"],
        case.width,
        case.height,
        case.option("eps2d", 0.3),
        case.option("near_plane", 0.01),
        case.option("far_plane", 1e10),
        case.option("rasterize_mode", "classic") == "antialiased",
    )
    opacities = given["opacities"].expand(case.views, -1) * (1.0 if compensations is None else compensations)
    colors = given["colors"] if case.per_view else given["colors"].expand(case.views, *given["colors"].shape)
    if case.option("sh_degree", None) is not None:
        towards = means - torch.linalg.inv(given["viewmats"])[:, None, :3, 3]
        colors = (_spherical_harmonics(case.option("sh_degree", 0), towards, colors) + 0.5).clamp_min(0.0)
    behind = given.get("backgrounds", means.new_zeros(case.views, colors.shape[-1]))
    if mode != "RGB":
        colors = depths[..., None] if mode in ("D", "ED") else torch.cat([colors, depths[..., None]], -1)
        zero = means.new_zeros(case.views, 1)
        behind = zero if mode in ("D", "ED") else torch.cat([behind, zero], -1)
    rendered = []
    for view in range(case.views):
        order = [i for i in depths[view].argsort(stable=True).tolist() if (radii[view, i] > 0).all()]
        rendered.append(
            composite(case, means2d[view], conics[view], opacities[view], colors[view], behind[view], order)
        )
    images, alphas = (torch.stack(parts) for parts in zip(*rendered, strict=True))
    if mode in ("ED", "RGB+ED"):
        images = torch.cat([images[..., :-1], images[..., -1:] / alphas.clamp_min(1e-10)], -1)
    return images, alphas


def composite(
    case: Case, means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, behind: Tensor, order: list[int]
) -> tuple[Tensor, Tensor]:
    """One view, front to back; images (h, w, d), alpha (h, w, 1)."""
    x = torch.arange(case.width, dtype=colors.dtype) + 0.5
    y = torch.arange(case.height, dtype=colors.dtype)[:, None] + 0.5
    left, weights = torch.ones(case.height, case.width, dtype=colors.dtype), []
    ended = torch.zeros_like(left).bool()
    for i in order:
        dx, dy, (xx, xy, yy) = x - means2d[i, 0], y - means2d[i, 1], conics[i]
        alpha = (opacities[i] * torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)).clamp_max(0.999)
        alpha = torch.where(alpha < 1.0 / 255.0, 0.0, alpha)
        ended = ended | (left * (1.0 - alpha) <= 1e-4)
        alpha = torch.where(ended, 0.0, alpha)
        weights.append(left * alpha)
        left = left * (1.0 - alpha)
    image = torch.einsum("nhw,nd->hwd", torch.stack(weights), colors[order]) if order else 0.0
    return image + left[..., None] * behind, 1.0 - left[..., None]


@functools.cache
def expected(case: Case) -> Outcome:
    given = leaves_of(arguments(case, torch.float64))
    return differentiate(given, *oracle(case, given))


def compare(case: Case, dtype: torch.dtype = torch.float32, gradient: float = GRADIENT) -> None:
    ours, exact = render(case, dtype), expected(case)
    for name in ("images", "alphas"):
        truth, image = getattr(exact, name), getattr(ours, name)
        assert image.shape == truth.shape and image.dtype == dtype
        peak, error = max(1.0, float(truth.abs().max())), float((image - truth).square().mean())
        assert error == 0.0 or 10.0 * math.log10(peak * peak / error) >= LEAST_DB, name
    for name, truth in exact.gradients.items():
        error = float((ours.gradients[name] - truth).norm() / truth.norm().clamp_min(NO_GRADIENT))
        assert error < gradient, f"gradient of {name}: {error:.1e}"


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("render_mode", MODES)
def test_every_mode_agrees_with_the_oracle(render_mode: str, rasterize_mode: str) -> None:
    compare(Case(options=options(render_mode=render_mode, rasterize_mode=rasterize_mode)))


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize(
    ("channels", "views", "per_view"),
    [
        (3, 1, True),
        (3, 3, False),
        *[(channels, *views) for channels in (1, 3, 32, 33) for views in ((1, False), (3, True))],
    ],
)
def test_features_of_any_number_of_channels_agree_with_the_oracle(channels: int, views: int, per_view: bool) -> None:
    for mode in ("RGB", "RGB+D"):
        compare(Case(25, channels, views, per_view, 33, 19, seed=2, options=options(render_mode=mode)))


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize(("views", "per_view"), [(1, False), (3, False), (3, True)])
@pytest.mark.parametrize("degree", range(4))
def test_spherical_harmonics_agree_with_the_oracle(degree: int, views: int, per_view: bool) -> None:
    compare(Case(views=views, per_view=per_view, seed=3, options=options(sh_degree=degree)))


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 15), (100, 3), (3, 100)])
def test_any_image_size_agrees_with_the_oracle(size: tuple[int, int]) -> None:
    for channels in (3, 5):
        case = Case(width=size[0], height=size[1], channels=channels, options=options(render_mode="RGB+D"))
        compare(case)


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("case", [Case(behind=True, views=3), Case(count=0), Case(count=0, views=3)])
@pytest.mark.parametrize("render_mode", MODES)
def test_empty_views_are_the_background(case: Case, render_mode: str) -> None:
    compare(Case(case.count, views=case.views, behind=case.behind, options=options(render_mode=render_mode)))


@pytest.mark.parametrize(
    "named",
    [
        {"near_plane": 3.5},
        {"far_plane": 4.0},
        {"eps2d": 0.0},
        {"eps2d": 1.7, "rasterize_mode": "antialiased"},
        {"near_plane": 4.0, "far_plane": 4.5, "render_mode": "RGB+D"},
    ],
)
def test_planes_and_blur_agree_with_the_oracle(named: dict[str, Any]) -> None:
    compare(Case(options=options(**named)))


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("render_mode", MODES)
def test_the_reference_agrees_with_the_oracle(render_mode: str, rasterize_mode: str) -> None:
    size = {"count": 25, "views": 2, "width": 23, "height": 17}
    case = Case(**size, options=options(render_mode=render_mode, rasterize_mode=rasterize_mode))
    compare(case, torch.float64, 1e-10)


@pytest.mark.parametrize("degree", [0, 3])
def test_spherical_harmonics_of_the_reference_agree_with_the_oracle(degree: int) -> None:
    case = Case(25, views=2, per_view=True, width=23, height=17, options=options(sh_degree=degree))
    compare(case, torch.float64, 1e-10)


@pytest.mark.parametrize(
    "named",
    [
        {"render_mode": "RGB+ED"},
        {"render_mode": "RGB+D", "rasterize_mode": "antialiased", "depth": "ray"},
        {"sh_degree": 1, "rasterize_mode": "antialiased"},
    ],
)
def test_gradients_of_the_reference_agree_with_finite_differences(named: dict[str, Any]) -> None:
    case = Case(count=3, width=3, height=3, seed=4, options=options(**named))
    given = arguments(case, torch.float64)
    given["means"] = 0.2 * given["means"] + torch.tensor([0.0, 0.0, 3.0])
    given["scales"], given["viewmats"] = 3.0 * given["scales"], torch.eye(4, dtype=torch.float64)[None]
    given["opacities"] = torch.tensor([0.3, 0.9, 0.6], dtype=torch.float64)
    if "sh_degree" in named:
        given["colors"] = 0.2 * given["colors"][:, :4]
    given = leaves_of(given)
    given["backgrounds"].requires_grad_()

    def images(*leaves: Tensor) -> tuple[Tensor, Tensor]:
        tensors = given | dict(zip((*LEAVES, "backgrounds"), leaves, strict=True))
        return rasterization(**tensors, width=case.width, height=case.height, **named)[:2]

    leaves = [given[name] for name in (*LEAVES, "backgrounds")]
    assert float(images(*leaves)[1].detach().min()) > 0.1  # every pixel counts
    assert torch.autograd.gradcheck(images, leaves)
