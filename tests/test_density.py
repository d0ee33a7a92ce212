"""Strategies of density control: their scores against brute force, and relocation against its formulae."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.sh import rgb_to_dc
from splatpipe.pipeline.train.density import BLIND, Density, DensityStep, Look, Seen, make_density
from splatpipe.pipeline.train.density.mcmc import composite_integral, disturb, draw_parents, shared
from splatpipe.pipeline.train.density.strategy import ScoredDensity
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.schedule import resolve_schedule

WIDTH, HEIGHT = 40, 30
CAMERA = Camera("photo.png", WIDTH, HEIGHT, 35.0, 36.0, 20.5, 14.5, np.eye(4))
MCMC = TrainConfig(density="mcmc")
MCMC_SCHEDULE = resolve_schedule(MCMC).density


def scene(count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> Gaussians:
    """Overlapping Gaussians before the camera, of degree 0."""
    generator = torch.Generator().manual_seed(seed)
    gaussians = Gaussians.empty(count, 0, dtype)
    spread = torch.tensor([1.0, 0.8, 1.0], dtype=dtype)
    gaussians.means = torch.randn(count, 3, generator=generator, dtype=dtype) * spread + torch.tensor([0.0, 0.0, 5.0])
    gaussians.log_scales = -1.5 + 0.4 * torch.randn(count, 3, generator=generator, dtype=dtype)
    gaussians.quats = torch.randn(count, 4, generator=generator, dtype=dtype)
    gaussians.opacity_logits = torch.randn(count, generator=generator, dtype=dtype)
    gaussians.sh[:, 0] = rgb_to_dc(torch.rand(count, 3, generator=generator, dtype=dtype))
    return gaussians


def picture(seed: int = 1) -> Tensor:
    return torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(seed))


def rendered(gaussians: Gaussians, look: Look = BLIND, probe: Tensor | None = None) -> rasterizer.Render:
    options = rasterizer.RenderOptions(0, near=0.2, depth=False, magnitudes=look.magnitudes)
    return rasterizer.render(gaussians, CAMERA, options, means2d_probe=probe)


def observed(density: Density, gaussians: Gaussians, weights: Tensor) -> Tensor:
    """The score after one photo whose loss is Σ weights · colour."""
    probe = torch.zeros(len(gaussians), 2, requires_grad=True) if density.look.probe else None
    render = rendered(gaussians.requires_grad_(), density.look, probe)
    (render.colour * weights).sum().backward()
    with torch.no_grad():
        density.observe(Seen(render, None if probe is None else probe.grad), resolve_schedule(TrainConfig()).density)
    assert isinstance(density, ScoredDensity)
    return density.statistics.score()


def test_published_score_is_the_norm_of_the_loss_by_the_place_on_screen() -> None:
    gaussians, weights = scene(1, dtype=torch.float64), picture(2)

    def loss(right: float, down: float) -> float:
        """With the one Gaussian moved by pixels, which moving the principal point does."""
        camera = replace(CAMERA, cx=CAMERA.cx + right, cy=CAMERA.cy + down)
        colour = rasterizer.render(gaussians, camera, rasterizer.RenderOptions(0, near=0.2), backend="reference").colour
        return float((colour * weights).sum())

    step = 1e-4
    slope_x, slope_y = loss(step, 0.0) - loss(-step, 0.0), loss(0.0, step) - loss(0.0, -step)
    expected = math.hypot(slope_x * WIDTH / 2, slope_y * HEIGHT / 2) / (2.0 * step)
    score = observed(make_density(TrainConfig(density="published"), 1), gaussians.to(dtype=torch.float32), weights)
    assert float(score[0]) == pytest.approx(expected, rel=1e-3)  # float32, and pixels that cross 1/255 on the way


NONE_UNWANTED = torch.zeros(100, dtype=torch.bool)


@pytest.mark.parametrize(("name", "magnitudes"), [("published", False), ("absolute", True)])
def test_gradient_scores_are_those_of_the_reference(name: str, magnitudes: bool) -> None:
    gaussians, weights = scene(20), picture(2) - 0.5
    exact = gaussians.to(dtype=torch.float64).requires_grad_()
    probe = torch.zeros(20, 2, dtype=torch.float64, requires_grad=True)
    options = rasterizer.RenderOptions(0, near=0.2, magnitudes=magnitudes)
    colour = rasterizer.render(exact, CAMERA, options, backend="reference", means2d_probe=probe).colour
    (colour * weights).sum().backward()
    assert probe.grad is not None
    expected = torch.linalg.vector_norm(probe.grad * torch.tensor([WIDTH / 2, HEIGHT / 2]), dim=1)
    config = TrainConfig.model_validate({"density": name})
    torch.testing.assert_close(
        observed(make_density(config, 20), gaussians, weights).double(), expected, rtol=1e-3, atol=1e-3
    )


def test_mcmc_adds_the_gradient_of_its_decays_to_what_was_seen() -> None:
    gaussians = scene(20).requires_grad_()
    size = torch.exp(gaussians.log_scales).sum(dim=1) / 2.5
    definition = 0.01 * torch.sigmoid(gaussians.opacity_logits).mean() + 0.01 * size.mean()
    expected = torch.autograd.grad(definition, (gaussians.opacity_logits, gaussians.log_scales))
    visible = torch.arange(20) % 3 > 0
    gaussians.opacity_logits.grad, gaussians.log_scales.grad = torch.zeros(20), torch.zeros(20, 3)
    make_density(MCMC, 20).add_gradients(gaussians, visible, extent=2.5)
    torch.testing.assert_close(gaussians.opacity_logits.grad, expected[0] * visible)
    torch.testing.assert_close(gaussians.log_scales.grad, expected[1] * visible[:, None])


@pytest.mark.parametrize("name", ["published", "absolute", "mcmc"])
def test_every_strategy_keeps_to_the_limit_and_its_statistics_survive(name: str) -> None:
    options = TrainConfig.model_validate({"density": name})
    schedule = replace(resolve_schedule(options).density, gradient=1e-9)
    gaussians = scene(50)
    density = make_density(options, 50)
    if isinstance(density, ScoredDensity):
        density.statistics.add(torch.ones(50), torch.ones(50, dtype=torch.bool))
    again = make_density(options, 50)
    again.load({key: tensor.clone() for key, tensor in density.to_arrays().items()})
    for limit in (50, 61):
        step = DensityStep(schedule, 5.0, limit, 600, gaussians, NONE_UNWANTED[: len(gaussians)])
        growth, counts = density.control(gaussians, step)
        assert len(growth.source) == limit
        repeated, same = again.control(gaussians, step)
        assert (
            same == counts and torch.equal(repeated.means, growth.means) and torch.equal(repeated.source, growth.source)
        )
    density.restart(61)
    assert all(not tensor.any() and len(tensor) == 61 for tensor in density.to_arrays().values())


def test_statistics_of_another_model_are_refused() -> None:
    density = make_density(TrainConfig(), 3)
    with pytest.raises(RuntimeError, match="not"):
        density.load(make_density(TrainConfig(), 4).to_arrays())


def test_relocation_moves_dead_and_broken_gaussians_and_no_others() -> None:
    gaussians = scene(40)
    gaussians.opacity_logits[3:7] = -6.0  # 0.0025
    gaussians.means[20, 1] = math.nan
    growth, counts = make_density(MCMC, 40).control(
        gaussians, DensityStep(MCMC_SCHEDULE, 5.0, 45, 600, gaussians, NONE_UNWANTED[: len(gaussians)])
    )
    assert (counts["relocated"], counts["added"], counts["pruned"]) == (5, 5, 0)
    dead = [3, 4, 5, 6, 20]
    live = [row for row in range(40) if row not in dead]
    assert [int(growth.source[row]) for row in live] == live
    assert set(growth.source[dead].tolist()) <= set(live) and set(growth.source[40:].tolist()) <= set(live)
    parents = set(growth.source[dead].tolist() + growth.source[40:].tolist())
    for row in live:
        assert bool(growth.fresh[row]) == (row in parents)
        assert torch.equal(growth.means[row], gaussians.means[row])
        assert (growth.opacity_logits[row] < gaussians.opacity_logits[row]) == (row in parents)
    assert bool(growth.fresh[dead].all()) and bool(growth.fresh[40:].all())


def test_relocation_leaves_a_model_of_dead_gaussians_alone() -> None:
    gaussians = scene(4)
    gaussians.opacity_logits[:] = -9.0
    growth, counts = make_density(MCMC, 4).control(
        gaussians, DensityStep(MCMC_SCHEDULE, 5.0, 9, 600, gaussians, NONE_UNWANTED[: len(gaussians)])
    )
    assert growth.source.tolist() == [0, 1, 2, 3] and counts["relocated"] == counts["added"] == 0


def test_parents_are_drawn_in_proportion_to_opacity() -> None:
    opacity = torch.tensor([0.1, 0.7, 0.0, 0.2], dtype=torch.float64)
    rows = draw_parents(torch.tensor([2, 5, 7, 9]), opacity, 20_000, 0, 600)
    counts = torch.bincount(rows, minlength=10)
    assert set(rows.tolist()) == {2, 5, 9}
    for row, share in ((2, 0.1), (5, 0.7), (9, 0.2)):  # five sigma of a binomial count
        assert abs(int(counts[row]) - 20_000 * share) < 5.0 * math.sqrt(20_000 * share * (1.0 - share))


@pytest.mark.parametrize("opacity", [0.006, 0.3, 0.9, 0.9999])
@pytest.mark.parametrize("copies", [2, 3, 10, 40])
def test_copies_have_the_opacity_and_the_size_of_the_paper(opacity: float, copies: int) -> None:
    gaussians = Gaussians.empty(1, 0)
    gaussians.opacity_logits[:] = math.log(opacity / (1.0 - opacity))
    logits, log_scales = shared(gaussians, torch.tensor([copies]))
    alpha = 1.0 - (1.0 - opacity) ** (1.0 / copies)
    assert float(torch.sigmoid(logits.double())) == pytest.approx(alpha, rel=1e-4)
    total = sum(  # Kheradmand et al., the double sum
        math.comb(i - 1, k) * (-1) ** k * alpha ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, copies + 1)
        for k in range(i)
    )
    assert float(torch.exp(log_scales[0, 0])) == pytest.approx(opacity / total, rel=1e-4)


def test_one_copy_hides_what_it_did() -> None:
    alpha = torch.tensor([0.01, 0.5, 1.0], dtype=torch.float64)
    torch.testing.assert_close(composite_integral(alpha, torch.ones(3, dtype=torch.float64)), alpha)


@pytest.mark.parametrize("copies", [2, 5, 17])
def test_copies_render_the_opacity_of_the_one_at_its_centre(copies: int) -> None:
    one = Gaussians.empty(1, 0)
    one.means[0] = torch.tensor([0.0, 0.0, 5.0])
    one.log_scales[:] = math.log(0.6)
    one.opacity_logits[:] = 1.5
    logits, log_scales = shared(one, torch.tensor([copies]))
    many = one.select(torch.zeros(copies, dtype=torch.int64))
    many.opacity_logits, many.log_scales = logits.repeat(copies), log_scales.repeat(copies, 1)
    before, after = rendered(one).alpha, rendered(many).alpha
    centre = (int(CAMERA.cy), int(CAMERA.cx))
    assert float(after[centre]) == pytest.approx(float(before[centre]), abs=1e-4)
    # Along a line through the centre the sum is kept, too: within what is cut off below 1/255.
    assert float(after[centre[0]].sum()) == pytest.approx(float(before[centre[0]].sum()), rel=0.03)


def test_noise_is_shaped_by_the_covariance_and_spares_what_is_opaque() -> None:
    count, rate = 4000, 1e-6
    gaussians = Gaussians.empty(count + 1, 0)
    gaussians.log_scales[:] = torch.tensor([0.8, 0.4, 0.2]).log()
    half = math.radians(30.0) / 2.0
    gaussians.quats[:] = 2.0 * torch.tensor([math.cos(half), 0.0, 0.0, math.sin(half)])
    gaussians.opacity_logits[:] = math.log(0.01 / 0.99)
    gaussians.opacity_logits[count] = 0.0
    disturb(gaussians, rate, 0, 7)
    assert not gaussians.means[count].any()
    c, s = math.cos(2 * half), math.sin(2 * half)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    covariance = turn @ np.diag([0.64, 0.16, 0.04]) @ turn.T
    share = 1.0 / (1.0 + math.exp(100.0 * (0.01 - 0.005)))
    expected = (5e5 * rate * share) ** 2 * covariance @ covariance
    # 4000 draws: a covariance entry is known to 2.3 % of its scale, so 12 % is five sigma.
    np.testing.assert_allclose(np.cov(gaussians.means[:count].numpy().T), expected, atol=0.12 * expected.max())


def test_noise_depends_on_the_iteration_and_the_row_alone() -> None:
    few, many, later = scene(5), scene(9), scene(5)
    for gaussians in (few, many, later):
        gaussians.opacity_logits[:] = -5.0
        gaussians.means.zero_()
    many.log_scales[:5], many.quats[:5] = few.log_scales, few.quats
    disturb(few, 1e-6, 0, 7)
    disturb(many, 1e-6, 0, 7)
    disturb(later, 1e-6, 0, 8)
    assert torch.equal(few.means, many.means[:5]) and not torch.equal(few.means, later.means)
