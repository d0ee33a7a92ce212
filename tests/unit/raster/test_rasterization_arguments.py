"""What ``rasterization`` takes and returns besides pixels: batches, meta, splatpipe's variants, hostile arguments."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np
import pytest
import torch
from random_scene import random_camera, random_scene
from torch import Tensor

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError
from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.definitions import RenderOptions
from splatpipe.pipeline.raster.rasterization import rasterization
from splatpipe.pipeline.raster.rasterizer import render

SIZE = {"width": 40, "height": 30}
LEAVES = ("means", "quats", "scales", "opacities", "colors")
COLOUR, DEPTH = 1e-5, 1e-4  # two ways of rounding, as in test_raster_native.py
GRADIENT = 1e-4


def scene(dtype: torch.dtype = torch.float32, count: int = 50, channels: int = 3, views: int = 1) -> dict[str, Tensor]:
    """Random Gaussians before a camera, all leaves."""
    generator = torch.Generator().manual_seed(7)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    viewmats = torch.eye(4).repeat(views, 1, 1)
    viewmats[:, 0, 3] = 0.1 * torch.arange(views)
    tensors = {
        "means": normal(count, 3) + torch.tensor([0.0, 0.0, 4.0]),
        "quats": normal(count, 4),
        "scales": torch.exp(0.4 * normal(count, 3) - 1.6),
        "opacities": torch.rand(count, generator=generator),
        "colors": normal(count, channels),
        "viewmats": viewmats,
        "Ks": torch.tensor([[40.0, 0.0, 19.0], [0.0, 42.0, 16.0], [0.0, 0.0, 1.0]]).repeat(views, 1, 1),
    }
    return {name: tensor.to(dtype).requires_grad_(name in LEAVES) for name, tensor in tensors.items()}


def gradients(given: dict[str, Tensor], **named: Any) -> tuple[Tensor, dict[str, Tensor], dict[str, Any]]:
    """Images, the gradients of a weighted sum of them and alpha by leaves and centres, and meta."""
    images, alphas, meta = rasterization(**given, **SIZE, **named)
    meta["means2d"].retain_grad()
    total = images.new_zeros(())
    generator = torch.Generator().manual_seed(5)
    for picture in (images, alphas):
        total = total + (picture * torch.randn(picture.shape, generator=generator, dtype=torch.float64)).sum()
    total.backward()
    found = {name: given[name].grad for name in LEAVES} | {"means2d": meta["means2d"].grad}
    if named.get("absgrad"):
        found["absgrad"] = meta["means2d"].absgrad
    return images.detach(), {name: torch.zeros(1) if grad is None else grad for name, grad in found.items()}, meta


def assert_close(ours: dict[str, Tensor], exact: dict[str, Tensor]) -> None:
    for name, truth in exact.items():
        error = float((ours[name] - truth).norm() / truth.norm().clamp_min(1e-6))
        assert error < GRADIENT, f"gradient of {name}: {error:.1e}"


def slanted(render_mode: str, channels: int, dtype: torch.dtype) -> tuple[Tensor, dict[str, Tensor], dict[str, Any]]:
    named = {"render_mode": render_mode, "depth": "ray", "absgrad": True, "rasterize_mode": "antialiased"}
    return gradients(scene(dtype, channels=channels, views=2), **named)


@functools.cache
def exact_slanted(render_mode: str, channels: int) -> tuple[Tensor, dict[str, Tensor], dict[str, Any]]:
    return slanted(render_mode, channels, torch.float64)


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize(
    ("render_mode", "channels"), [("RGB", 3), ("RGB", 6), ("D", 3), ("RGB+D", 1), ("RGB+D", 3), ("RGB+D", 6)]
)
def test_slanted_depths_and_magnitudes_agree_with_the_reference(render_mode: str, channels: int) -> None:
    ours, exact = slanted(render_mode, channels, torch.float32), exact_slanted(render_mode, channels)
    assert (ours[0] - exact[0]).abs().max() < DEPTH
    assert_close(ours[1], exact[1])
    assert torch.equal(ours[2]["radii"], exact[2]["radii"])


@pytest.mark.parametrize("antialias", [False, True])
def test_with_splatpipes_values_it_renders_as_splatpipe_does(antialias: bool) -> None:
    model, camera = random_scene(3), random_camera(3)
    line = render(model, camera, RenderOptions(3, (0.1, 0.5, 0.9), antialias, near=0.2), backend="native")
    ours, alphas, meta = rasterization(
        model.means,
        model.quats,
        torch.exp(model.log_scales),
        torch.sigmoid(model.opacity_logits),
        model.sh,
        torch.from_numpy(camera.cam_from_world)[None],
        torch.from_numpy(camera.k())[None],
        camera.width,
        camera.height,
        near_plane=0.2,
        sh_degree=3,
        backgrounds=torch.tensor([[0.1, 0.5, 0.9]]),
        render_mode="RGB+D",
        rasterize_mode="antialiased" if antialias else "classic",
        alpha_max=0.99,
        compensation_min=2.5e-5,
        plane_sigmas=2.0,
        depth="ray",
    )
    assert (ours[0, ..., :3] - line.colour).abs().max() < COLOUR
    assert (ours[0, ..., 3] - line.depth_sum).abs().max() < DEPTH
    assert (alphas[0, ..., 0] - line.alpha).abs().max() < COLOUR
    assert not (line.visible & (meta["radii"][0] == 0).any(-1)).any()


def test_batches_render_as_their_scenes_do() -> None:
    parts = [scene(count=20, views=2) for _ in range(6)]
    for index, part in enumerate(parts):
        part["means"] = (part["means"].detach() + 0.05 * index).requires_grad_()
    alone = [gradients(part) for part in parts]
    given = {name: torch.stack([part[name].detach() for part in parts]) for name in parts[0]}
    batch = {
        name: tensor.view(3, 2, *tensor.shape[1:]).requires_grad_(name in LEAVES) for name, tensor in given.items()
    }
    images, alphas, meta = rasterization(**batch, **SIZE)
    assert images.shape == (3, 2, 2, 30, 40, 3) and alphas.shape == (3, 2, 2, 30, 40, 1)
    assert meta["means2d"].shape == meta["radii"].shape == (3, 2, 2, 20, 2)
    assert meta["n_batches"] == 6 and meta["n_cameras"] == 2
    for index, (expected, *_) in enumerate(alone):
        assert torch.equal(images.view(6, 2, 30, 40, 3)[index], expected)
    generator = torch.Generator().manual_seed(5)
    weights = [
        torch.randn(shape, generator=generator, dtype=torch.float64) for shape in ((2, 30, 40, 3), (2, 30, 40, 1))
    ]
    (images * weights[0]).sum().add((alphas * weights[1]).sum()).backward()
    for index, (_, expected_gradients, _) in enumerate(alone):
        grad = batch["means"].grad
        assert grad is not None
        torch.testing.assert_close(grad.view(6, 20, 3)[index], expected_gradients["means"])


@pytest.mark.parametrize(
    ("poses", "ks"), [((3, 2, 1), (3, 2, 1)), ((6, 1), (6, 1)), ((1,), (1,)), ((2, 3, 1), (3, 2, 1))]
)
def test_views_of_other_batches_are_refused(poses: tuple[int, ...], ks: tuple[int, ...]) -> None:
    given = scene(count=4)
    batch = {name: given[name].detach().expand(2, 3, *given[name].shape) for name in LEAVES}
    viewmats, intrinsics = given["viewmats"][0].expand(*poses, 4, 4), given["Ks"][0].expand(*ks, 3, 3)
    with pytest.raises(ValueError, match=r"(viewmats|Ks) is .*, not \(2, 3, 1, "):
        rasterization(**batch, viewmats=viewmats, Ks=intrinsics, **SIZE)


@contextmanager
def other_defaults() -> Iterator[None]:
    """New tensors are float64, and on a device without memory."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with torch.device("meta"):
            yield
    finally:
        torch.set_default_dtype(before)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("sh_degree", [None, 1])
def test_torchs_default_dtype_and_device_do_not_matter(sh_degree: int | None, dtype: torch.dtype) -> None:
    named: dict[str, Any] = {"render_mode": "RGB+ED", "rasterize_mode": "antialiased", "depth": "ray", "absgrad": True}
    outcomes = []
    for defaults in (nullcontext, other_defaults):
        given = scene(dtype, count=20)
        if sh_degree is not None:
            given["colors"] = given["colors"].detach()[:, None].repeat(1, 4, 1).requires_grad_()
        backgrounds = given["means"].new_ones(1, 3, requires_grad=True)
        with defaults():
            images, alphas, _ = rasterization(**given, **SIZE, **named, sh_degree=sh_degree, backgrounds=backgrounds)
            (images.square().sum() + alphas.sum()).backward()
        outcomes.append([images.detach(), alphas.detach(), backgrounds.grad, *[given[name].grad for name in LEAVES]])
    for usual, other in zip(*outcomes, strict=True):
        assert usual is not None and other is not None and torch.equal(usual, other)


def test_numbers_of_numpy_are_numbers() -> None:
    given = scene() | {"colors": torch.ones(50, 4, 3)}
    usual = rasterization(**given, **SIZE, near_plane=0.25, alpha_max=0.5, sh_degree=1)[0]
    size = {name: np.int64(side) for name, side in SIZE.items()}
    numbers = {"near_plane": np.float32(0.25), "alpha_max": np.float64(0.5), "sh_degree": np.int64(1)}
    assert torch.equal(rasterization(**given, **size, **numbers)[0], usual)  # type: ignore[arg-type]


def test_poses_with_a_gradient_render_where_none_is_wanted() -> None:
    given = scene()
    usual = rasterization(**given, **SIZE)[0]
    for name in ("viewmats", "Ks"):
        given[name].requires_grad_()
    with torch.no_grad():
        assert torch.equal(rasterization(**given, **SIZE)[0], usual)


def test_meta_is_what_gsplats_strategies_read() -> None:
    given = scene(views=3)
    given["means"] = (given["means"].detach() * torch.tensor([3.0, 3.0, 1.0])).requires_grad_()  # some out of view
    _, found, meta = gradients(given, absgrad=True, rasterize_mode="antialiased")
    seen = (meta["radii"] > 0).all(-1)
    assert 0 < int(seen.sum()) < seen.numel()
    assert meta["radii"].dtype == torch.int32 and meta["radii"].shape == meta["means2d"].shape == (3, 50, 2)
    assert meta["gaussian_ids"] is None and (meta["width"], meta["height"], meta["n_cameras"]) == (40, 30, 3)
    assert (found["means2d"][~seen] == 0).all() and (meta["means2d"][~seen] == 0).all()
    assert (found["absgrad"] >= found["means2d"].abs() * (1.0 - 1e-4) - 1e-6).all()
    assert found["absgrad"].sum() > 1.2 * found["means2d"].abs().sum()
    xx, xy, yy = meta["conics"][seen].unbind(-1)
    covariance = torch.linalg.inv(torch.stack([torch.stack([xx, xy], -1), torch.stack([xy, yy], -1)], -2).double())
    sigmas = torch.sqrt(2.0 * torch.log(255.0 * meta["opacities"][seen].double())).clamp_max(3.33)
    radii = sigmas[:, None] * covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((meta["radii"][seen] - radii).abs() <= 1.0 + 1e-3).all() and (meta["radii"][seen] >= radii - 1e-3).all()
    assert (meta["depths"][seen] > 0.0).all()


def test_losses_of_meta_reach_the_gaussians() -> None:
    found = []
    for dtype in (torch.float32, torch.float64):
        given = scene(dtype)
        _, _, meta = rasterization(**given, **SIZE, rasterize_mode="antialiased")
        (meta["means2d"].square().sum() + meta["depths"].sum() + meta["opacities"].sum()).backward()
        found.append({name: given[name].grad for name in ("means", "quats", "scales", "opacities")})
    assert_close(found[0], found[1])  # type: ignore[arg-type]


def test_the_sign_of_a_scale_does_not_matter() -> None:
    given = scene()
    negative = given | {"scales": (-given["scales"].detach()).requires_grad_()}
    (ours, by, _), (same, by_negative, _) = gradients(given), gradients(negative)
    assert torch.equal(ours, same)
    assert torch.equal(by["scales"], -by_negative["scales"])


def test_gaussians_within_the_clipped_radius_are_skipped() -> None:
    given = scene()
    _, _, everything = rasterization(**given, **SIZE)
    _, _, clipped = rasterization(**given, **SIZE, radius_clip=6.0)
    stays = (everything["radii"] > 6).any(-1, keepdim=True)
    assert torch.equal(clipped["radii"], torch.where(stays, everything["radii"], 0))
    assert 0 < int((clipped["radii"] > 0).sum()) < int((everything["radii"] > 0).sum())


def test_backgrounds_have_a_gradient() -> None:
    given = scene()
    backgrounds = torch.zeros(1, 3, requires_grad=True)
    images, alphas, _ = rasterization(**given, **SIZE, backgrounds=backgrounds)
    images.sum().backward()
    assert backgrounds.grad is not None
    torch.testing.assert_close(backgrounds.grad, (1.0 - alphas).sum((1, 2)).expand(1, 3))


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize("channels", [3, 7])
def test_any_number_of_threads_gives_the_same_bits(channels: int) -> None:
    outcomes = []
    for threads in (1, 2, 5):
        _native.set_threads(threads)
        images, found, _ = gradients(scene(count=3000, channels=channels, views=2), absgrad=True, render_mode="RGB+D")
        outcomes.append([images, *found.values()])
    for other in outcomes[1:]:
        assert all(torch.equal(a, b) for a, b in zip(outcomes[0], other, strict=True))


def test_a_render_keeps_its_instruction_set_for_its_gradient() -> None:
    given = scene()
    images, _, _ = rasterization(**given, **SIZE)
    found = []
    used = _native.isa()
    try:
        for isa in _native.isas():
            _native.set_isa(isa)
            found.append(torch.autograd.grad(images.sum(), given["colors"], retain_graph=True)[0])
    finally:
        _native.set_isa(used)
    assert all(torch.equal(found[0], other) for other in found)


def test_huge_gaussians_are_skipped_and_do_not_affect_the_others() -> None:
    given = scene()
    tensors = {name: tensor.detach().clone() for name, tensor in given.items()}
    tensors["scales"][3], tensors["means"][5] = 3e38, torch.tensor([3e38, 0.0, 1.0])
    tensors["quats"][7], tensors["quats"][9] = 3e38, 0.0
    for dtype in (torch.float32, torch.float64):
        hostile = {name: tensor.to(dtype, copy=True).requires_grad_(name in LEAVES) for name, tensor in tensors.items()}
        images, found, meta = gradients(hostile)
        assert images.isfinite().all() and all(grad.isfinite().all() for grad in found.values())
        if dtype == torch.float32:
            assert (meta["radii"][0, [3, 5, 7]] == 0).all()
        assert (meta["radii"][0, 9] > 0).all()  # the zero quaternion is the identity


def set_value(name: str, value: float) -> Callable[[dict[str, Any]], None]:
    def change(given: dict[str, Any]) -> None:
        given[name] = given[name].detach().clone()
        given[name].view(-1)[1] = value

    return change


def set_argument(name: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda given: given.__setitem__(name, value)


def cut(name: str, dim: int) -> Callable[[dict[str, Any]], None]:
    return lambda given: given.__setitem__(name, given[name].detach().narrow(dim, 0, given[name].shape[dim] - 1))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        *[(set_value(name, bad), f"{name} has values that are not finite")
          for name in (*LEAVES, "viewmats", "Ks") for bad in (math.nan, math.inf, -math.inf)],
        *[(cut(name, 0), r"is \(") for name in ("quats", "scales", "opacities", "colors", "Ks")],
        *[(cut(name, -1), r"is \(") for name in ("means", "quats", "scales", "viewmats", "Ks")],
        *[(set_argument(name, value), name) for name in ("width", "height") for value in (0, -3, 65_537)],
        *[(set_argument(name, value), name) for name in ("near_plane", "far_plane", "radius_clip", "eps2d")
          for value in (-1.0, math.nan)],
        *[(set_argument("alpha_max", value), "alpha_max") for value in (0.0, 1.0, math.nan)],
        (set_argument("means", None), "means is no tensor"),
        (set_argument("means", torch.zeros(3)), "means is not"),
        (set_argument("means", torch.zeros(50, 3, dtype=torch.int32)), "float32"),
        (set_argument("means", torch.zeros(50, 3, dtype=torch.float16)), "float32"),
        (set_argument("colors", torch.zeros(50, 3, dtype=torch.float64)), "float32"),
        (set_argument("colors", torch.zeros(50, 0)), "channels"),
        (set_argument("colors", torch.zeros(2, 50, 3)), "neither"),
        (set_argument("viewmats", torch.zeros(0, 4, 4)), "no view"),
        (set_argument("viewmats", torch.zeros(1, 4, 4)), "last row"),
        (set_argument("viewmats", torch.tensor([[[0.0] * 4] * 3 + [[0.0, 0.0, 0.0, 1.0]]])), "inverted"),
        (set_argument("Ks", None), "Ks is no tensor"),
        (set_argument("Ks", np.eye(3)[None]), "Ks is no tensor"),
        (set_argument("Ks", torch.zeros(1, 3, 3)), "last row"),
        (set_argument("Ks", torch.diag(torch.tensor([0.0, 1.0, 1.0]))[None]), "focal length"),
        (set_argument("backgrounds", torch.zeros(3)), "backgrounds"),
        (set_argument("backgrounds", torch.full((1, 3), math.nan)), "backgrounds"),
        (set_argument("backgrounds", torch.zeros(1, 3, dtype=torch.float64)), "backgrounds"),
        (set_argument("render_mode", "rgb"), "choose from RGB, D, ED"),
        (set_argument("rasterize_mode", "sharp"), "choose from classic"),
        (set_argument("depth", "median"), "choose from centre"),
        (set_argument("sh_degree", 1), "neither"),
        (set_argument("sh_degree", -1), "neither"),
    ],
)  # fmt: skip
def test_hostile_arguments_are_refused(change: Callable[[dict[str, Any]], None], says: str) -> None:
    given: dict[str, Any] = scene() | SIZE
    change(given)
    with pytest.raises(ValueError, match=says):
        rasterization(**given)


def test_spherical_harmonics_need_their_coefficients() -> None:
    given = scene() | {"colors": torch.zeros(50, 4, 3)}
    with pytest.raises(ValueError, match="degree 2 needs 9"):
        rasterization(**given, **SIZE, sh_degree=2)
    with pytest.raises(ValueError, match="sh_degree is -1"):
        rasterization(**given, **SIZE, sh_degree=-1)
    of_degree_four = scene() | {"colors": torch.zeros(50, 25, 3)}
    with pytest.raises(NotImplementedError, match="above degree 3"):
        rasterization(**of_degree_four, **SIZE, sh_degree=4)
    assert (rasterization(**of_degree_four, **SIZE, sh_degree=3)[0] >= 0.0).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("packed", True),
        ("sparse_grad", True),
        ("distributed", True),
        ("camera_model", "fisheye"),
        ("covars", torch.zeros(50, 3, 3)),
        ("with_ut", True),
        ("with_eval3d", True),
        ("radial_coeffs", torch.zeros(1, 6)),
        ("viewmats_rs", torch.eye(4)[None]),
        ("rolling_shutter", 3),
        ("viewmats", torch.eye(4)[None].requires_grad_()),
        ("Ks", torch.eye(3)[None].requires_grad_()),
        ("Ks", torch.tensor([[[9.0, 0.1, 5.0], [0.0, 9.0, 5.0], [0.0, 0.0, 1.0]]])),
    ],
)
def test_what_is_not_there_is_said_in_words(name: str, value: object) -> None:
    given: dict[str, Any] = scene() | SIZE | {name: value}
    with pytest.raises(NotImplementedError, match="does not support"):
        rasterization(**given)


def test_images_that_no_memory_holds_are_refused() -> None:
    given = scene(count=1, channels=65_536)
    with pytest.raises(MachineError, match="1 images of 65536 x 65536 pixels with 65536 channels"):
        rasterization(**given, width=65_536, height=65_536)


def test_more_splats_than_memory_holds_are_refused() -> None:
    count = 1 << 17  # each covers all of the picture's 16,384 tiles
    means = torch.tensor([0.0, 0.0, 100.0]).repeat(count, 1)
    quats, scales = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1), torch.tensor([3e3, 3e3, 1e-3]).repeat(count, 1)
    ks = torch.tensor([[[1000.0, 0.0, 32_768.0], [0.0, 1000.0, 32.0], [0.0, 0.0, 1.0]]])
    with pytest.raises(SplatpipeError, match="32-bit"):
        rasterization(
            means, quats, scales, torch.full((count,), 0.5), torch.ones(count, 1), torch.eye(4)[None], ks, 65_536, 64
        )
