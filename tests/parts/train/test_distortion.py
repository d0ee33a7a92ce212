"""Distortion loss: what it measures, its gradient, and that training with it leaves a single surface."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.pixels.dataset import View, load_views
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.plan import make_plan
from splatpipe.pipeline.train.plan.schedule import Schedule, resolve_schedule
from splatpipe.pipeline.train.techniques.distortion_loss import (
    CENTRE_EVERY,
    FREE_PX,
    HALF_PX,
    DistortionLoss,
    depth_origin,
    spread_loss,
)
from splatpipe.pipeline.train.techniques.techniques import make_techniques
from splatpipe.stages import initialize, train

FRONT = Camera("front", 24, 16, 30.0, 30.0, 12.0, 8.0, np.eye(4))


def layers(depths: tuple[float, ...], opacity: float) -> Gaussians:
    """Return flat sheets that fill the image, each with a given uniform opacity."""
    gaussians = Gaussians.empty(len(depths), 0)
    gaussians.means = torch.tensor([[0.0, 0.0, depth] for depth in depths])
    gaussians.log_scales = torch.log(torch.tensor([[30.0 * depth, 30.0 * depth, 1e-6] for depth in depths]))
    gaussians.quats[:, 0] = 1.0
    gaussians.opacity_logits = torch.full((len(depths),), float(torch.logit(torch.tensor(opacity))))
    return gaussians


def spread(gaussians: Gaussians, origin: float = 0.0, backend: str = "native") -> torch.Tensor:
    options = rasterizer.RenderOptions(0, depth_origin=origin)
    rendered = rasterizer.render(gaussians, FRONT, options, backend=backend)  # type: ignore[arg-type]
    return spread_loss(rendered, origin, FRONT)


def test_one_surface_has_no_distortion_and_two_translucent_ones_have_their_variance() -> None:
    assert float(spread(layers((9.0,), 0.9), 9.0)) == pytest.approx(0.0, abs=1e-4)
    two = layers((8.0, 12.0), 0.6)
    first, second = 0.6, 0.4 * 0.6
    mean = (8.0 * first + 12.0 * second) / (first + second)
    variance = (64.0 * first + 144.0 * second) / (first + second) - mean**2
    excess = variance / (mean / FRONT.fx) ** 2 - FREE_PX**2
    assert float(spread(two, 10.0)) == pytest.approx(excess / (excess + HALF_PX**2), rel=1e-3)


def test_small_distortion_is_free_and_large_distortion_is_capped() -> None:
    pixel = 100.0 / FRONT.fx
    assert float(spread(layers((100.0, 100.0 + pixel), 0.6), 100.0)) == 0.0
    assert 0.95 < float(spread(layers((2.0, 900.0), 0.6), 100.0)) <= 1.0


def test_an_origin_keeps_precision_far_away() -> None:
    far = layers((3000.0, 3000.0 + 1000.0), 0.6)  # ten pixels apart
    origin = depth_origin(far.means, FRONT)
    assert origin == pytest.approx(3500.0)
    exact = float(spread(far.to(dtype=torch.float64), origin, "reference"))
    assert 0.05 < exact < 0.95 and float(spread(far, origin)) == pytest.approx(exact, rel=1e-3)


def test_gradient_agrees_with_finite_differences() -> None:
    base = tiny_scene.true_model(12).to(dtype=torch.float64)
    camera = tiny_scene.cameras()[0].scaled(18, 14)

    def value(means: torch.Tensor, logits: torch.Tensor) -> torch.Tensor:
        gaussians = replace(base, means=means, opacity_logits=logits)
        options = rasterizer.RenderOptions(0, depth_origin=3.0)
        rendered = rasterizer.render(gaussians, camera, options, backend="reference")
        seen = rendered.alpha.detach() >= 0.2
        alpha = torch.where(seen, rendered.alpha, 1.0)
        mean = torch.where(seen, rendered.depth_sum, 0.0) / alpha - 3.0
        variance = torch.where(seen, rendered.depth_square_sum, 0.0) / alpha - mean.square()
        return torch.where(seen, variance, 0.0).mean()

    leaves = (base.means.clone().requires_grad_(), (base.opacity_logits + 2.0).clone().requires_grad_())
    assert torch.autograd.gradcheck(value, leaves, eps=1e-6, atol=1e-5, rtol=1e-3)


def test_it_counts_only_in_the_later_part_of_a_run_and_if_enabled() -> None:
    distortion = DistortionLoss(0.1, after=20)
    assert not distortion.is_counted(20) and distortion.is_counted(21)
    views = [View(camera, Path(), None) for camera in tiny_scene.cameras()]
    for weight in (0.0, 0.1):
        plan = make_plan(tiny_scene.plain(distortion_weight=weight), views, tiny_scene.split_of(views), 9)
        assert (make_techniques(plan).find(DistortionLoss) is not None) == (weight > 0.0)


def test_on_a_device_the_centre_is_updated_rarely_and_kept_in_checkpoints() -> None:
    model, camera, options = layers((4.0, 6.0), 0.6), FRONT, rasterizer.RenderOptions(0)
    for device, moves in (("cpu", True), ("meta", False)):
        distortion = DistortionLoss(0.1, after=0)
        moment = make_schedule().at(CENTRE_EVERY, 0)
        distortion.settings(options, model, camera, moment)
        moved = replace(model, means=model.means + 1.0)
        elsewhere = replace(moved, means=moved.means.to(device))
        later = make_schedule().at(CENTRE_EVERY + 1, 0)
        found = distortion.settings(options, elsewhere, camera, later).depth_origin
        assert found == pytest.approx(6.0 if moves else 5.0)
        other = DistortionLoss(0.1, after=0)
        other.load(distortion.to_arrays())
        assert other.settings(options, elsewhere, camera, later).depth_origin == found


def make_schedule() -> Schedule:
    return resolve_schedule(TrainConfig(iterations=2 * CENTRE_EVERY))


def test_training_with_it_reduces_the_spread_of_depths(tmp_path: Path) -> None:
    tiny_scene.write_dataset(tmp_path / "dataset")
    parts = {"undistort.dataset": tmp_path / "dataset"}
    initialize.run(InitializeConfig(dense=False), Inputs(parts, tmp_path), tmp_path, tiny_scene.Recorder())
    parts |= {"initialize.splat": tmp_path / "init.ply"} | tiny_scene.split_part(tmp_path / "dataset", 4)
    found = []
    for weight in (0.0, 0.05):
        out = tmp_path / f"{weight}"
        out.mkdir()
        config = tiny_scene.plain(iterations=300, distortion_weight=weight)
        train.run(config, Inputs(parts, tmp_path, machine=Machine("cpu", 1)), out, tiny_scene.Recorder())
        model, shares = read_splat(out / "model.ply"), []
        for view in load_views(tmp_path / "dataset")[::4]:
            origin = depth_origin(model.means, view.camera)
            with torch.no_grad():
                rendered = rasterizer.render(model, view.camera, rasterizer.RenderOptions(3, depth_origin=origin))
            shares.append(float(spread_loss(rendered, origin, view.camera)))
        found.append(sum(shares))
    assert found[1] < 0.8 * found[0]
