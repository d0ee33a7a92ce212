"""The native rasterizer against the reference in float64, on every instruction set that this CPU has."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from random_scene import random_camera, random_scene
from torch import Tensor

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.rasterizer import Render, RenderOptions, render
from splatpipe.pipeline.splat.model.gaussians import PARAMETERS, Gaussians

# Tolerances of float32 against float64.
COLOUR = 1e-5  # sums of up to 60 rounded terms of size 1
DEPTH = 1e-4  # sums of as many rounded depths of up to 10
SQUARES = ("depth_square_sum", 10.0 * DEPTH)  # depths are at most ten from the origin

GRADIENT = 3e-5  # L2 over all Gaussians, relative: sums over a hundred pixels, through divisions by 1 - alpha
THIN_GRADIENT = 1e-3  # limit where the covariance's eigenvalues are 10^6 apart, 3e-7 · √10^6 relative
NO_GRADIENT = 1e-6  # anything smaller is rounding, or from a Gaussian far below a pixel
FLIPPED = 4  # pixels in which one rounding decides whether a Gaussian at a threshold (1/255, 1e-4) counts
FLIP = 1e-3  # how much larger than a rounding such a pixel's difference is


pytestmark = pytest.mark.usefixtures("isa")


@dataclass
class RenderOutcome:
    """A render and the gradients of a weighted sum of it."""

    render: Render
    gradients: dict[str, Tensor]


def evaluate(
    scene: Gaussians, camera: Camera, options: RenderOptions, backend: str = "native", weight: Tensor | None = None
) -> RenderOutcome:
    """Render and differentiate; every image's random weights are multiplied by ``weight`` (h, w)."""
    scene = scene.detach().clone().requires_grad_()
    probe = torch.zeros(len(scene), 2, dtype=scene.means.dtype, requires_grad=True)
    result = render(scene, camera, options, backend=backend, means2d_probe=probe)  # type: ignore[arg-type]
    generator = torch.Generator().manual_seed(5)
    total = torch.zeros((), dtype=scene.means.dtype)
    grey = (result.alpha, result.depth_sum, result.depth_square_sum)
    for picture in (result.colour, *(each[..., None] for each in grey)):
        weights = torch.randn(picture.shape, generator=generator)
        total = total + (picture * weights * (1.0 if weight is None else weight[..., None])).sum()
    leaves = scene.tensors() | {"means2d": probe}
    return RenderOutcome(result, dict(zip(leaves, torch.autograd.grad(total, list(leaves.values())), strict=True)))


@dataclass(frozen=True)
class _Arguments:
    """Arguments of ``evaluate_exactly``, to cache its result: three instruction sets request each."""

    tensors: bytes
    camera: str
    options: RenderOptions
    weight: bytes


_ANSWERS: dict[_Arguments, RenderOutcome] = {}


def evaluate_exactly(
    scene: Gaussians, camera: Camera, options: RenderOptions, weight: Tensor | None = None
) -> RenderOutcome:
    """``evaluate`` with the reference in float64."""
    arguments = _Arguments(
        b"".join(tensor.numpy().tobytes() for tensor in scene.tensors().values()),
        repr(camera),
        options,
        b"" if weight is None else weight.numpy().tobytes(),
    )
    if arguments not in _ANSWERS:
        exact_scene = scene.to(dtype=torch.float64)
        _ANSWERS[arguments] = evaluate(
            exact_scene, camera, options, "reference", None if weight is None else weight.double()
        )
    return _ANSWERS[arguments]


def compare(scene: Gaussians, camera: Camera, options: RenderOptions, gradient: float = GRADIENT) -> None:
    """Assert that native and reference agree."""
    with torch.no_grad():
        ours = render(scene, camera, options, backend="native")
    exact = evaluate_exactly(scene, camera, options).render
    flipped = (ours.colour - exact.colour).abs().amax(-1) > FLIP
    flipped |= (ours.median_depth - exact.median_depth).abs() > 0.01
    assert flipped.sum() <= FLIPPED
    same = ~flipped
    for name, limit in (("colour", COLOUR), ("alpha", COLOUR), ("depth_sum", DEPTH), ("median_depth", DEPTH), SQUARES):
        error = (getattr(ours, name) - getattr(exact, name))[same].abs().max()
        assert error < limit, f"{name}: {error:.1e}"
    assert torch.equal(ours.visible, exact.visible)
    torch.testing.assert_close(ours.radii.double(), exact.radii, rtol=1e-4, atol=1e-4)

    ours_back = evaluate(scene, camera, options, "native", same.float())
    exact_back = evaluate_exactly(scene, camera, options, same if flipped.any() else None)
    for name, expected in exact_back.gradients.items():
        error = (ours_back.gradients[name] - expected).norm() / expected.norm().clamp_min(NO_GRADIENT)
        assert error < gradient, f"gradient of {name}: {error:.1e}"


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_the_reference(seed: int, antialias: bool) -> None:
    options = RenderOptions(3, background=(0.1, 0.5, 0.9), antialias=antialias, near=0.2, depth_origin=3.0)
    compare(random_scene(seed), random_camera(seed), options)


@pytest.mark.parametrize("antialias", [False, True])
def test_magnitudes_of_the_screen_gradient_agree_with_the_reference(antialias: bool) -> None:
    options = RenderOptions(1, antialias=antialias, near=0.2, magnitudes=True)
    compare(random_scene(9, 60), random_camera(9), options)
    compare(random_scene(9, 60), random_camera(9), replace(options, depth=False))


def test_magnitudes_do_not_cancel_and_change_no_other_gradient() -> None:
    scene, camera, options = random_scene(10, 40), random_camera(10), RenderOptions(1, near=0.2)
    signed, sizes = evaluate(scene, camera, options), evaluate(scene, camera, replace(options, magnitudes=True))
    for name in scene.tensors():
        assert torch.equal(signed.gradients[name], sizes.gradients[name])
    ours, theirs = sizes.gradients["means2d"], signed.gradients["means2d"].abs()
    assert (ours >= theirs * (1.0 - 1e-4)).all() and ours.sum() > 1.5 * theirs.sum()


def test_contributing_pairs_are_those_of_the_reference() -> None:
    scene = random_scene(11, 60, 0)
    scene.opacity_logits += 3.0  # so that pixels saturate
    camera, options = random_camera(11), RenderOptions(0, near=0.2)
    frame = _native.Frame()
    tensors = [torch.empty(camera.height, camera.width, 3), torch.empty(camera.height, camera.width), None]
    tensors += [torch.empty(len(scene)), torch.empty(len(scene), dtype=torch.uint8)]
    size, intrinsics = (camera.width, camera.height), (camera.fx, camera.fy, camera.cx, camera.cy)
    view = (np.ascontiguousarray(camera.cam_from_world, np.float64), size, intrinsics)
    how = (0, False, options.near, options.depth_origin, options.background)
    frame.forward(tuple(scene.tensors().values()), view, how, tuple(tensors))
    # Every blended pair changes its pixel's alpha; the reference's alphas are recomputed one Gaussian at a time.
    assert frame.contributing_pairs() == pytest.approx(
        blended_pairs(scene.to(dtype=torch.float64), camera, options), rel=2e-3
    )


def blended_pairs(scene: Gaussians, camera: Camera, options: RenderOptions) -> int:
    """Count by the definition: each Gaussian's own alpha image, front to back."""
    with torch.no_grad():
        depths = scene.means @ torch.from_numpy(camera.cam_from_world[2, :3].copy()) + camera.cam_from_world[2, 3]
        left, alive, count = torch.ones(camera.height, camera.width, dtype=torch.float64), None, 0
        for row in torch.argsort(depths, stable=True).tolist():
            alpha = render(scene.select(torch.tensor([row])), camera, options, backend="reference").alpha
            after = left * (1.0 - alpha)
            alive = torch.ones_like(left, dtype=torch.bool) if alive is None else alive
            alive &= after >= 1e-4
            count += int((alive & (alpha > 0.0)).sum())
            left = torch.where(alive, after, left)
    return count


@pytest.mark.parametrize("sh_degree", range(4))
def test_every_sh_degree_agrees_with_the_reference(sh_degree: int) -> None:
    compare(random_scene(7, 40, sh_degree), random_camera(7), RenderOptions(sh_degree, near=0.2))
    if sh_degree < 3:  # fewer bands than the scene holds: the others have no gradient
        scene = random_scene(8, 20, 3)
        compare(scene, random_camera(8, 40, 30), RenderOptions(sh_degree, near=0.2))
        outcome = evaluate(scene, random_camera(8, 40, 30), RenderOptions(sh_degree))
        assert (outcome.gradients["sh"][:, (sh_degree + 1) ** 2 :] == 0).all()


def test_opaque_layers_end_pixels_as_in_the_reference() -> None:
    scene = random_scene(3, 80, 0, size=-0.5)
    scene.opacity_logits += 4.0
    compare(scene, random_camera(3), RenderOptions(0, background=(1.0, 1.0, 1.0), near=0.2))


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 15), (200, 3), (3, 200)])
def test_any_picture_size_agrees_with_the_reference(size: tuple[int, int]) -> None:
    compare(random_scene(4, 30), random_camera(4, *size), RenderOptions(3, near=0.2))


@pytest.mark.parametrize("antialias", [False, True])
def test_long_thin_gaussians_keep_their_precision(antialias: bool) -> None:
    scene = random_scene(5, 20, 0)
    scene.log_scales[:] = torch.tensor([1.5, -5.0, -5.0])  # a thousand times longer than wide
    compare(scene, random_camera(5), RenderOptions(0, antialias=antialias, near=0.2), THIN_GRADIENT)


@pytest.mark.parametrize("log_scale", [-30.0, -10.0, 3.0, 8.0])
def test_tiny_and_huge_gaussians_agree_with_the_reference(log_scale: float) -> None:
    scene = random_scene(6, 12, 0)
    scene.log_scales = 0.2 * scene.log_scales + log_scale
    scene.means[:, 2] = scene.means[:, 2].abs() + 1.0
    compare(scene, random_camera(6), RenderOptions(0, near=0.2))


def test_an_empty_view_is_the_background() -> None:
    behind = random_scene(1, 20)
    behind.means[:, 2] = -5.0
    for scene in (behind, Gaussians.empty(0, 3)):
        outcome = evaluate(scene, random_camera(1), RenderOptions(3, background=(0.2, 0.4, 0.6)))
        result = outcome.render
        torch.testing.assert_close(result.colour, torch.tensor([0.2, 0.4, 0.6]).expand_as(result.colour))
        assert not result.visible.any()
        for picture in (result.alpha, result.depth_sum, result.median_depth, result.radii):
            assert (picture == 0).all()
        assert all((gradient == 0).all() for gradient in outcome.gradients.values())


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3e38, -3e38])
@pytest.mark.parametrize("name", PARAMETERS)
def test_hostile_numbers_are_skipped_and_do_not_affect_the_others(name: str, value: float) -> None:
    scene, camera, options = random_scene(2), random_camera(2), RenderOptions(3, near=0.2)
    flat = getattr(scene, name).view(len(scene), -1)
    flat[5] = value
    flat[17, -1] = value
    hostile = torch.zeros(len(scene), dtype=torch.bool)
    hostile[[5, 17]] = True
    if (name, value) in (("log_scales", -3e38), ("opacity_logits", 3e38)):
        hostile[:] = False  # without any extent, or as opaque as can be: nothing is wrong with those
    outcome, others = evaluate(scene, camera, options), evaluate(scene.select(~hostile), camera, options)
    assert torch.equal(outcome.render.colour, others.render.colour)
    assert torch.equal(outcome.render.depth_sum, others.render.depth_sum)
    assert not outcome.render.visible[hostile].any()
    for key, gradient in outcome.gradients.items():
        assert gradient.isfinite().all()
        assert torch.equal(gradient[~hostile], others.gradients[key])
        assert (gradient[hostile] == 0).all()


def test_zero_quaternion_is_the_identity_without_gradient() -> None:
    scene = random_scene(2, 10, 0)
    scene.quats[:] = 0.0
    compare(scene, random_camera(2), RenderOptions(0, near=0.2))
    identity = scene.clone()
    identity.quats[:, 0] = 1.0
    ours, same = (
        evaluate(scene, random_camera(2), RenderOptions(0)),
        evaluate(identity, random_camera(2), RenderOptions(0)),
    )
    assert torch.equal(ours.render.colour, same.render.colour)
    assert (ours.gradients["quats"] == 0).all()


def same_bits(a: RenderOutcome, b: RenderOutcome) -> bool:
    pictures = ("colour", "alpha", "depth_sum", "depth_square_sum", "median_depth", "visible", "radii")
    return all(torch.equal(getattr(a.render, p), getattr(b.render, p)) for p in pictures) and all(
        torch.equal(a.gradients[name], b.gradients[name]) for name in a.gradients
    )


def test_a_render_keeps_its_instruction_set_for_its_gradient() -> None:
    scene, camera, options = random_scene(12), random_camera(12), RenderOptions(3, near=0.2)
    expected = evaluate(scene, camera, options).gradients["means"]
    leaves = scene.detach().clone().requires_grad_()
    result = render(leaves, camera, options, backend="native")
    generator = torch.Generator().manual_seed(5)
    grey = (result.alpha, result.depth_sum, result.depth_square_sum)
    pictures = (result.colour, *(each[..., None] for each in grey))
    total = sum((picture * torch.randn(picture.shape, generator=generator)).sum() for picture in pictures)
    for other in _native.isas():
        _native.set_isa(other)
        gradient = torch.autograd.grad(total, leaves.means, retain_graph=True)[0]
        torch.testing.assert_close(gradient, expected, rtol=0.0, atol=0.0)


def test_more_pairs_than_indices_can_hold_are_refused() -> None:
    # 4096 tiles in a row, and each of 2^19 Gaussians covers them all: one pair more than 2^31 - 1.
    one = Gaussians.empty(1, 0)
    one.log_scales[:, :2] += 8.0  # a disc that faces the camera: one that reached its plane would be skipped
    one.means += torch.tensor([0.0, 0.0, 100.0])
    scene = one.select(torch.zeros(1 << 19, dtype=torch.int64))
    camera = Camera("wide", 65_536, 16, 1000.0, 1000.0, 32_768.0, 8.0, np.eye(4))
    with pytest.raises(SplatpipeError, match="32-bit") as raised:
        render(scene, camera, RenderOptions(0, near=0.2, depth=False), backend="native")
    assert "max_gaussians" in raised.value.hint
    assert torch.isfinite(render(random_scene(1), random_camera(1), RenderOptions(3)).colour).all()  # it goes on


def test_any_number_of_threads_gives_the_same_bits() -> None:
    # Enough for several chunks of the binning, and Gaussians at one depth.
    scene = random_scene(9, 40_000, 1, size=-4.0)
    scene.means[:, 2] = (scene.means[:, 2] * 4).round() / 4
    camera = Camera("view", 230, 170, 180.0, 180.0, 115.0, 85.0, np.eye(4))
    outcomes = []
    for threads in (1, 2, 5):
        _native.set_threads(threads)
        outcomes.append(evaluate(scene, camera, RenderOptions(1, near=0.2)))
    assert outcomes[0].render.visible.sum() > 20_000
    assert same_bits(outcomes[0], outcomes[1])
    assert same_bits(outcomes[0], outcomes[2])


def test_renders_from_several_python_threads_do_not_mix() -> None:
    jobs = [(random_scene(seed), random_camera(seed), RenderOptions(3)) for seed in range(4)]
    alone = [evaluate(*job) for job in jobs]
    with ThreadPoolExecutor(4) as executor:
        together = list(executor.map(lambda job: evaluate(*job), jobs * 5))
    for i, outcome in enumerate(together):
        assert same_bits(outcome, alone[i % 4])


def test_a_render_without_depth_is_the_same_but_for_the_depth() -> None:
    scene, camera = random_scene(0).requires_grad_(), random_camera(0)
    full = render(scene, camera, RenderOptions(3), backend="native")
    expected = torch.autograd.grad(full.colour.sum() + full.alpha.sum(), scene.means)[0]
    for backend in ("native", "reference"):
        lean = render(scene, camera, RenderOptions(3, depth=False), backend=backend)  # type: ignore[arg-type]
        for depth in (lean.depth_sum, lean.depth_square_sum, lean.median_depth):
            assert depth.shape == full.alpha.shape
            assert (depth == 0).all()
        assert not lean.depth_sum.requires_grad
        if backend == "native":
            assert torch.equal(lean.colour, full.colour)
            gradient = torch.autograd.grad(lean.colour.sum() + lean.alpha.sum(), scene.means)[0]
            assert torch.equal(gradient, expected)


def test_backward_can_wait_and_be_repeated() -> None:
    scene, other = random_scene(0).requires_grad_(), random_scene(1).requires_grad_()
    first = render(scene, random_camera(0), RenderOptions(3), backend="native").colour.sum()
    second = render(other, random_camera(1), RenderOptions(3), backend="native").colour.sum()
    second.backward()
    gradients = [torch.autograd.grad(first, scene.means, retain_graph=True)[0] for _ in range(2)]
    alone = render(scene, random_camera(0), RenderOptions(3), backend="native").colour.sum()
    expected = torch.autograd.grad(alone, scene.means)[0]
    assert torch.equal(gradients[0], gradients[1])
    assert torch.equal(gradients[0], expected)


def test_strided_parameters_and_gradients_are_accepted() -> None:
    scene, camera, options = random_scene(0), random_camera(0), RenderOptions(3)
    strided = scene.clone()
    strided.sh = scene.sh.transpose(1, 2).contiguous().transpose(1, 2)
    strided.means = torch.cat([scene.means, scene.means], 1)[:, :3]
    assert torch.equal(render(strided, camera, options).colour, render(scene, camera, options).colour)
    leaf = scene.means.clone().requires_grad_()
    scene.means = leaf
    result = render(scene, camera, options).colour
    (by_view,) = torch.autograd.grad(result.sum(), leaf, retain_graph=True)  # an expanded gradient
    (by_copy,) = torch.autograd.grad(result, leaf, torch.ones_like(result))
    assert torch.equal(by_view, by_copy)


def test_other_dtypes_use_the_reference() -> None:
    scene = random_scene(0, 5).to(dtype=torch.float64)
    assert render(scene, random_camera(0, 8, 8), RenderOptions(0)).colour.dtype == torch.float64
    with pytest.raises(ValueError, match="float32"):
        render(scene, random_camera(0), RenderOptions(0), backend="native")


def test_denormals_of_the_caller_survive_a_render() -> None:
    render(random_scene(0, 5), random_camera(0), RenderOptions(0), backend="native")
    assert np.float32(1e-40) * np.float32(0.5) > 0
