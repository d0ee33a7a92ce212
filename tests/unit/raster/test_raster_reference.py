"""The reference rasterizer against hand calculations, and its gradients against finite differences."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster import reference
from splatpipe.pipeline.raster.rasterizer import Render, RenderOptions, render
from splatpipe.pipeline.splat.model.gaussians import PARAMETERS, Gaussians
from splatpipe.pipeline.splat.model.sh import rgb_to_dc

EXACT = 1e-12  # float64 rounding of a few operations
STEP = 1e-6  # step of the finite differences: h² and 1e-16 / h are both small
FINITE_DIFFERENCE = 2e-6  # relative to the largest entry of the gradient


def camera(width: int = 15, height: int = 11, focal: float = 40.0, **changes: object) -> Camera:
    """At the origin, looking along +z, the principal point on the centre of the middle pixel."""
    view = Camera("view", width, height, focal, focal, width / 2, height / 2, np.eye(4))
    return replace(view, **changes)


def gaussian(position: list[float], sigma: float, opacity: float, rgb: list[float]) -> Gaussians:
    """Return a single isotropic Gaussian of one colour, float64."""
    one = Gaussians.empty(1, 0, torch.float64)
    one.means[0] = torch.tensor(position)
    one.log_scales[:] = math.log(sigma)
    one.opacity_logits[:] = math.log(opacity / (1.0 - opacity))
    one.sh[0, 0] = rgb_to_dc(torch.tensor(rgb, dtype=torch.float64))
    return one


def draw(gaussians: Gaussians, view: Camera, **options: object) -> Render:
    """Render with the reference."""
    return render(gaussians, view, RenderOptions(gaussians.sh_degree, **options), backend="reference")


def test_gaussian_in_the_middle_of_a_pixel_shows_its_colour_there() -> None:
    view = camera()
    for column, row in ((7, 5), (2, 9)):
        x, y = (column + 0.5 - view.cx) / view.fx, (row + 0.5 - view.cy) / view.fy
        result = draw(gaussian([4 * x, 4 * y, 4.0], 0.1, 0.6, [0.2, 0.5, 0.9]), view, background=(1.0, 0.0, 0.5))
        expected = 0.6 * torch.tensor([0.2, 0.5, 0.9]) + 0.4 * torch.tensor([1.0, 0.0, 0.5])
        torch.testing.assert_close(result.colour[row, column], expected.double(), atol=1e-7, rtol=0)
        assert result.alpha[row, column] == pytest.approx(0.6, abs=EXACT)
        assert torch.argmax(result.alpha) == row * view.width + column


def test_profile_is_the_projected_covariance_with_the_blur() -> None:
    sigma, z, focal = 0.1, 4.0, 40.0
    result = draw(gaussian([0.0, 0.0, z], sigma, 0.6, [1.0, 1.0, 1.0]), camera(focal=focal))
    variance = (focal * sigma / z) ** 2 + 0.3
    for dx, dy in ((1, 0), (0, 2), (-1, 1)):
        expected = 0.6 * math.exp(-0.5 * (dx * dx + dy * dy) / variance)
        assert result.alpha[5 + dy, 7 + dx] == pytest.approx(expected, abs=EXACT)
    assert result.radii[0] == pytest.approx(3.0 * math.sqrt(variance), abs=EXACT)


def test_ellipse_turns_with_its_quaternion() -> None:
    one = gaussian([0.0, 0.0, 4.0], 0.02, 0.9, [1.0, 1.0, 1.0])
    one.log_scales[0, 0] = math.log(0.4)  # long along its own x
    one.quats[0] = 3.0 * torch.tensor(
        [math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]
    )  # 45° about z: x to y, y down
    alpha = draw(one, camera()).alpha
    assert alpha[8, 10] > 0.3  # right and down
    assert alpha[2, 10] == 0.0


def test_opacity_compensation_keeps_the_energy_of_blurred_gaussians() -> None:
    sigma, z, focal = 0.01, 4.0, 40.0
    sharp = (focal * sigma / z) ** 2
    result = draw(gaussian([0.0, 0.0, z], sigma, 0.9, [1.0, 1.0, 1.0]), camera(focal=focal), antialias=True)
    assert result.alpha[5, 7] == pytest.approx(0.9 * sharp / (sharp + 0.3), abs=EXACT)


def test_nearer_gaussian_covers_the_farther_one_whatever_their_order() -> None:
    far, near = gaussian([0, 0, 6.0], 0.2, 0.8, [0, 0, 1.0]), gaussian([0, 0, 3.0], 0.1, 0.7, [1.0, 0, 0])
    for parts in ((far, near), (near, far)):
        result = draw(Gaussians.concat(parts), camera())
        expected = torch.tensor([0.7, 0.0, 0.3 * 0.8], dtype=torch.float64)
        torch.testing.assert_close(result.colour[5, 7], expected, atol=1e-7, rtol=0)
        assert result.depth_sum[5, 7] == pytest.approx(0.7 * 3.0 + 0.3 * 0.8 * 6.0, abs=EXACT)
        assert result.depth_square_sum[5, 7] == pytest.approx(0.7 * 9.0 + 0.3 * 0.8 * 36.0, abs=20.0 * EXACT)
        assert result.median_depth[5, 7] == 3.0
        assert result.median_depth[0, 0] == 0.0


def test_alpha_is_capped_and_the_gaussian_below_the_last_transmittance_is_not_blended() -> None:
    layers = [gaussian([0, 0, 2.0 + i], 0.5, 1.0 - 1e-9, [float(i == 2), 0, 0]) for i in range(3)]
    result = draw(Gaussians.concat(layers), camera())
    assert result.alpha[5, 7] == pytest.approx(1.0 - 1e-4, abs=1e-9)  # 0.01², and no third: 1e-6 is below 1e-4
    assert result.colour[5, 7, 0] == pytest.approx(0.0, abs=EXACT)


def test_contributions_below_an_8_bit_step_are_skipped() -> None:
    alpha = draw(gaussian([0, 0, 4.0], 0.1, 0.6, [1.0, 1.0, 1.0]), camera()).alpha
    assert alpha[alpha > 0].min() >= 1.0 / 255.0 - EXACT
    assert (alpha == 0).any()


def test_gaussians_behind_the_near_plane_or_outside_are_not_visible() -> None:
    positions = [[0, 0, 1.0], [0, 0, 0.1], [0, 0, -1.0], [5.0, 0, 1.0]]
    result = draw(Gaussians.concat([gaussian(p, 0.1, 0.5, [1.0, 1.0, 1.0]) for p in positions]), camera(), near=0.2)
    assert result.visible.tolist() == [True, False, False, False]
    assert (result.radii > 0).tolist() == [True, False, False, False]


def test_gaussians_that_reach_the_cameras_plane_are_not_visible() -> None:
    sizes = (1.49, 1.51)  # its plane is two standard deviations away
    ahead = [gaussian([0, 0, 3.0], size, 0.5, [1.0, 1.0, 1.0]) for size in sizes]
    aside = [gaussian([12.0, 0, 3.0], size, 0.5, [1.0, 1.0, 1.0]) for size in sizes]
    assert draw(Gaussians.concat([*ahead, *aside]), camera()).visible.tolist() == [True, False, False, False]


def test_a_disc_below_the_camera_is_no_veil_over_its_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    disc = gaussian([0.0, 2.0, 0.6], 1.5, 0.9999, [1.0, 1.0, 1.0])  # ground, almost all of it out of view
    disc.log_scales[:, 1] = -5.0
    assert draw(disc, camera(focal=8.0)).alpha.max() == 0.0
    monkeypatch.setattr(reference, "PLANE_SIGMAS", 0.0)
    assert draw(disc, camera(focal=8.0)).alpha.mean() > 0.1  # else it would


def test_projection_agrees_with_the_cameras_own() -> None:
    view = random_camera()
    world = np.linalg.inv(view.cam_from_world) @ [0.3, -0.2, 5.0, 1.0]
    column, row = view.project(world[None, :3])[0] // 1
    alpha = draw(gaussian(list(world[:3]), 0.02, 0.9, [1.0, 1.0, 1.0]), view).alpha
    assert divmod(int(torch.argmax(alpha)), view.width) == (row, column)


def random_camera() -> Camera:
    """Turned, moved, with the principal point off the centre."""
    turn = torch.matrix_exp(torch.tensor([[0, -0.1, 0.2], [0.1, 0, -0.15], [-0.2, 0.15, 0]], dtype=torch.float64))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.numpy(), [0.1, -0.2, 0.3]
    return Camera("view", 14, 10, 13.0, 14.5, 5.0, 6.5, pose)


def random_scene(sh_degree: int) -> Gaussians:
    """Eight overlapping Gaussians, one far outside (its Jacobian clamped), one opaque, one with a clamped colour."""
    generator = torch.Generator().manual_seed(11)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    n = 8
    scene = Gaussians(
        normal(n, 3) * 0.8 + torch.tensor([0, 0, 4.0]),
        normal(n, 3) * 0.4 - 0.8,
        normal(n, 4),
        normal(n),
        normal(n, (sh_degree + 1) ** 2, 3) * 0.2,
    )
    scene.means[0] = torch.tensor([5.5, -4.0, 3.0])
    scene.log_scales[0] = torch.tensor([0.9, 0.7, 0.8])
    scene.opacity_logits[1] = 8.0
    scene.sh[2, 0] = torch.tensor([-3.0, 0.5, -2.5])
    return scene


def loss_of(scene: Gaussians, options: RenderOptions, probe: Tensor) -> Tensor:
    """A weighted sum of all that has a gradient."""
    generator = torch.Generator().manual_seed(5)
    result = render(scene, random_camera(), options, backend="reference", means2d_probe=probe)
    grey = (result.alpha, result.depth_sum, result.depth_square_sum)
    pictures = (result.colour, *(each[..., None] for each in grey))
    return sum((p * torch.randn(p.shape, generator=generator, dtype=torch.float64)).sum() for p in pictures)  # type: ignore[return-value]


@pytest.mark.parametrize(("sh_degree", "antialias"), [(0, False), (3, True)])
def test_gradients_agree_with_finite_differences(sh_degree: int, antialias: bool) -> None:
    options = RenderOptions(sh_degree, background=(0.3, 0.1, 0.6), antialias=antialias, near=0.2, depth_origin=2.0)
    scene, probe = random_scene(sh_degree).requires_grad_(), torch.zeros(8, 2, dtype=torch.float64, requires_grad=True)
    tensors = scene.tensors() | {"probe": probe}
    gradients = torch.autograd.grad(loss_of(scene, options, probe), list(tensors.values()))
    assert all(gradient.abs().max() > 0.01 for gradient in gradients)
    for (name, tensor), gradient in zip(tensors.items(), gradients, strict=True):
        flat, expected = tensor.detach().view(-1), torch.zeros(tensor.numel(), dtype=torch.float64)
        every = 1 if name != "sh" else max(1, tensor.numel() // 60)  # 60 of the SH, from all bands
        picked = range(0, tensor.numel(), every)
        with torch.no_grad():
            for i in picked:
                kept = flat[i].item()
                for sign in (1.0, -1.0):
                    flat[i] = kept + sign * STEP
                    expected[i] += sign * loss_of(scene, options, probe) / (2.0 * STEP)
                flat[i] = kept
        error = (gradient.reshape(-1) - expected)[list(picked)].abs().max() / gradient.abs().max()
        assert error < FINITE_DIFFERENCE, f"{name}: {error:.1e}"


def test_float32_is_close_to_float64() -> None:
    scene = random_scene(3)
    options = RenderOptions(3, near=0.2)
    exact = render(scene, random_camera(), options, backend="reference")
    rounded = render(scene.to(dtype=torch.float32), random_camera(), options, backend="reference")
    assert rounded.colour.dtype == torch.float32
    assert (rounded.colour - exact.colour).abs().max() < 1e-5


def test_chunks_of_rows_make_the_same_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, options = random_scene(1), RenderOptions(1)
    whole = render(scene, random_camera(), options, backend="reference")
    monkeypatch.setattr("splatpipe.pipeline.raster.reference._PAIRS_AT_ONCE", 250)
    assert torch.equal(render(scene, random_camera(), options, backend="reference").colour, whole.colour)


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_gaussian_with_nan_is_skipped(name: str, value: float) -> None:
    scene = random_scene(1)
    getattr(scene, name).view(8, -1)[3, -1] = value
    scene.requires_grad_()
    result = render(scene, random_camera(), RenderOptions(1), backend="reference")
    result.colour.sum().backward()
    others = torch.arange(8) != 3
    expected = render(scene.detach().select(others), random_camera(), RenderOptions(1), backend="reference")
    assert torch.equal(result.colour, expected.colour)
    for tensor in scene.tensors().values():
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()
        assert (tensor.grad[3] == 0).all()


def test_invalid_arguments_are_refused() -> None:
    scene = random_scene(1)
    for view, options in (
        (camera(width=0), RenderOptions(1)),
        (camera(focal=0.0), RenderOptions(1)),
        (camera(), RenderOptions(2)),
        (camera(), RenderOptions(1, near=0.0)),
        (camera(), RenderOptions(1, near=math.nan)),
    ):
        with pytest.raises(ValueError):
            render(scene, view, options)
