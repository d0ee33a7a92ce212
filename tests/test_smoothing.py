"""The 3D smoothing filter: against its formula, through its gradient, and in what a training leaves."""

import hashlib
import math
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.dataset import View, load_views
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.reference import rotation_from_quats
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.ply import MIP_COMMENT, read_splat, read_splat_header
from splatpipe.pipeline.train import loop
from splatpipe.pipeline.train import state as state_module
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan import Plan, make_plan
from splatpipe.pipeline.train.smoothing import Sampling, raw_opacity_limits, sampling_of, smoothed
from splatpipe.pipeline.train.state import TrainState
from splatpipe.pipeline.train.stream import TrainingPhoto
from splatpipe.stages import initialize, train

sys.path.insert(0, str(Path(__file__).parent / "scenes"))
import tiny_scene

QUICK = TrainConfig(iterations=60, filter_3d=True)
SUBPIXELS = 8  # a side, of the ideal photos
THINNER = 1.2  # natural logarithm: the tiny scene's Gaussians become a fraction of a pixel to a pixel wide


def random_gaussians(count: int, dtype: torch.dtype = torch.float64) -> Gaussians:
    generator = torch.Generator().manual_seed(11)
    gaussians = Gaussians.empty(count, 0, dtype)
    for name, scale in (("means", 1.0), ("log_scales", 1.5), ("quats", 1.0), ("opacity_logits", 3.0)):
        values = getattr(gaussians, name)
        setattr(gaussians, name, scale * torch.randn(values.shape, generator=generator, dtype=dtype))
    return gaussians


def covariances(gaussians: Gaussians) -> torch.Tensor:
    axes = rotation_from_quats(gaussians.quats) * torch.exp(gaussians.log_scales)[:, None, :]
    return axes @ axes.transpose(1, 2)


def test_covariance_grows_by_the_filter_and_opacity_falls_by_the_root_of_the_determinants() -> None:
    gaussians = random_gaussians(200)
    sigmas = torch.rand(200, dtype=torch.float64) * 2.0
    result = smoothed(gaussians, sigmas)
    before = covariances(gaussians)
    after = before + sigmas[:, None, None] ** 2 * torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(covariances(result), after, rtol=1e-9, atol=1e-9)
    factor = torch.sqrt(torch.linalg.det(before) / torch.linalg.det(after))
    opacities = torch.sigmoid(gaussians.opacity_logits) * factor
    torch.testing.assert_close(torch.sigmoid(result.opacity_logits), opacities, rtol=1e-7, atol=1e-12)
    assert result.means is gaussians.means and result.quats is gaussians.quats and result.sh is gaussians.sh


def test_gradient_agrees_with_finite_differences() -> None:
    gaussians = random_gaussians(20)
    sigmas = torch.rand(20, dtype=torch.float64)
    sigmas[:3] = 0.0

    def both(log_scales: torch.Tensor, logits: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        changed = Gaussians(gaussians.means, log_scales, gaussians.quats, logits, gaussians.sh)
        result = smoothed(changed, sigmas)
        return result.log_scales, result.opacity_logits

    inputs = (gaussians.log_scales.requires_grad_(), gaussians.opacity_logits.requires_grad_())
    assert torch.autograd.gradcheck(both, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


def test_a_filter_of_zero_changes_no_bit() -> None:
    gaussians = random_gaussians(50, torch.float32)
    result = smoothed(gaussians, torch.zeros(50))
    assert torch.equal(result.log_scales, gaussians.log_scales)
    assert torch.equal(result.opacity_logits, gaussians.opacity_logits)


@pytest.mark.parametrize("sigma", [0.0, 1e-12, 0.01, 1e3])
def test_extreme_gaussians_stay_finite_in_single_precision(sigma: float) -> None:
    logits = torch.tensor([-100.0, -20.0, 0.0, 12.0, 20.0, 100.0])
    sizes = torch.tensor([-40.0, -14.0, 0.0, 5.0])
    gaussians = Gaussians.empty(24, 0)
    gaussians.opacity_logits = logits.repeat(4)
    gaussians.log_scales = sizes.repeat_interleave(6)[:, None].repeat(1, 3)
    leaves = gaussians.requires_grad_()
    result = smoothed(leaves, torch.full((24,), sigma))
    assert bool(result.finite().all())
    (torch.sigmoid(result.opacity_logits).sum() + result.log_scales.sum()).backward()
    assert bool(torch.isfinite(leaves.log_scales.grad).all() and torch.isfinite(leaves.opacity_logits.grad).all())
    exact = smoothed(gaussians.detach().to(dtype=torch.float64), torch.full((24,), sigma, dtype=torch.float64))
    expected = torch.sigmoid(exact.opacity_logits)
    # Relative, for the tiny ones: a hundred steps of a float32 logit of up to 200.
    torch.testing.assert_close(torch.sigmoid(result.opacity_logits).double(), expected, rtol=2e-3, atol=1e-30)


def camera_at(x: float, focal: float, width: int = 100, near_side: float = 50.0) -> Camera:
    """Looks along +z from (x, 0, 0)."""
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera("one", width, 80, focal, 0.9 * focal, near_side, 40.0, pose)


def test_filter_is_that_of_the_finest_camera_that_sees_the_centre() -> None:
    views = [camera_at(0.0, 100.0), camera_at(0.0, 300.0), camera_at(40.0, 1e4)]
    means = torch.tensor(
        [
            [0.0, 0.0, 5.0],  # before the first two: 300 px at depth 5
            [2.0, 0.0, 5.0],  # 20 + 50 px right in the first one, beyond the second's margin
            [2.9, 0.0, 5.0],  # 8 px beyond the first's side, within its margin
            [3.1, 0.0, 5.0],  # 12 px beyond
            [0.0, 0.0, 0.05],  # before the near plane
            [0.0, 0.0, -5.0],  # behind
            [math.nan, 0.0, 5.0],
        ]
    )
    sigmas = Sampling(tuple(views), near=0.1).filter_sigmas(means)
    root = math.sqrt(0.2)
    expected = torch.tensor([root * 5 / 300, root * 5 / 100, root * 5 / 100, 0.0, 0.0, 0.0, 0.0])
    torch.testing.assert_close(sigmas, expected)


def test_filters_agree_with_projected_pixels() -> None:
    views = [camera.scaled(70, 40) for camera in tiny_scene.cameras()]
    means = 3.0 * random_gaussians(400, torch.float32).means
    expected = np.zeros(400)
    for row, mean in enumerate(means.double().numpy()):
        rates = [0.0]
        for view in views:
            depth = float(view.cam_from_world[2, :3] @ mean + view.cam_from_world[2, 3])
            (u, v) = view.project(mean[None])[0]
            if depth > 0.5 and -7.0 <= u <= 77.0 and -4.0 <= v <= 44.0:
                rates.append(max(view.fx, view.fy) / depth)
        expected[row] = math.sqrt(0.2) / max(rates) if max(rates) else 0.0
    assert 50 < np.count_nonzero(expected) < 350
    np.testing.assert_allclose(Sampling(tuple(views), 0.5).filter_sigmas(means).numpy(), expected, rtol=1e-5)


def test_opacity_reset_limits_what_is_rendered() -> None:
    gaussians = random_gaussians(300, torch.float32)
    sigmas = torch.rand(300)
    limits = raw_opacity_limits(gaussians, sigmas, 0.01)
    before = torch.sigmoid(smoothed(gaussians, sigmas).opacity_logits)
    lowered = torch.minimum(gaussians.opacity_logits, limits)
    result = Gaussians(gaussians.means, gaussians.log_scales, gaussians.quats, lowered, gaussians.sh)
    after = torch.sigmoid(smoothed(result, sigmas).opacity_logits)
    torch.testing.assert_close(after, before.clamp(max=0.01), rtol=1e-4, atol=1e-7)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `dataset`, whose photos are ideal ones of Gaussians thinner than a pixel, and `init.ply`."""
    folder = tmp_path_factory.mktemp("thin")
    tiny_scene.write_dataset(folder / "dataset")
    for camera in tiny_scene.cameras():
        pixels = (ideal(camera) * 255.0 + 0.5).astype(np.uint8)
        cv2.imwrite(str(folder / "dataset/images" / camera.name), pixels[:, :, ::-1])
    parts = {"undistort.dataset": folder / "dataset"}
    initialize.run(InitializeConfig(), Inputs(parts, folder), folder, tiny_scene.Recorder())
    return folder


def ideal(camera: Camera) -> np.ndarray:
    """(h, w, 3) what a sensor of square pixels sees: the mean over each pixel's area."""
    truth = tiny_scene.true_model()
    truth.log_scales -= THINNER
    fine = camera.scaled(SUBPIXELS * camera.width, SUBPIXELS * camera.height)
    options = rasterizer.RenderOptions(3, antialias=True, depth=False)  # a pixel's blur is an eighth of one here
    with torch.no_grad():
        colour = rasterizer.render(truth, fine, options).colour.clamp(0.0, 1.0).numpy()
    parts = colour.reshape(camera.height, SUBPIXELS, camera.width, SUBPIXELS, 3)
    return np.asarray(parts.mean(axis=(1, 3)))


def trained(scene: Path, out: Path, config: TrainConfig, threads: int = 1) -> Path:
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    parts |= tiny_scene.split_part(scene / "dataset", 4)
    out.mkdir(exist_ok=True)
    train.run(config, Inputs(parts, scene, machine=Machine("cpu", threads)), out, tiny_scene.Recorder())
    return out


def digest(out: Path) -> str:
    return hashlib.sha256((out / "model.ply").read_bytes() + (out / "history.json").read_bytes()).hexdigest()


def test_without_the_option_the_raw_tensors_are_rendered() -> None:
    views = [View(camera, Path(), None) for camera in tiny_scene.cameras()]
    plan = make_plan(TrainConfig(), views, tiny_scene.split_of(views), 1)
    state = TrainState.begin(tiny_scene.true_model(), plan)
    assert state.rendered_model(plan.options) is state.gaussians
    assert "filter_sigmas" not in state.checkpoint("any").arrays


@pytest.mark.parametrize("when", [2, 11, 20, 26, 50])
def test_killed_training_goes_on_and_ends_with_the_same_bits(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: int
) -> None:
    monkeypatch.setattr(state_module, "REFRESH_EVERY", 15)
    whole = trained(scene, tmp_path / "whole", QUICK)
    step = loop.train_step

    def dying(state: TrainState, plan: Plan, photo: TrainingPhoto) -> None:
        if state.iteration + 1 == when:
            raise InterruptedError
        step(state, plan, photo)

    with monkeypatch.context() as patch, pytest.raises(InterruptedError):
        patch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(loop, "CHECKPOINT_SHARE", 1e9)
        patch.setattr(loop, "train_step", dying)
        trained(scene, tmp_path / "killed", QUICK)
    assert (tmp_path / "killed" / loop.CHECKPOINT).exists()
    assert digest(trained(scene, tmp_path / "killed", QUICK, threads=2)) == digest(whole)


def test_the_file_renders_as_training_did(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    states: list[TrainState] = []
    finish = TrainState.finished

    def keeping(state: TrainState) -> Gaussians:
        states.append(state)
        return finish(state)

    monkeypatch.setattr(TrainState, "finished", keeping)
    config = QUICK.model_copy(update={"iterations": 70, "antialias": True})
    out = trained(scene, tmp_path / "out", config)
    assert MIP_COMMENT in read_splat_header(out / "model.ply").comments
    state, baked = states[-1], read_splat(out / "model.ply")
    plan = Plan.from_json((out / "plan.json").read_text())
    view = load_views(scene / "dataset")[2].camera
    options = rasterizer.RenderOptions(3, antialias=True, near=plan.near, depth=False)
    with torch.no_grad():
        as_trained = rasterizer.render(state.rendered_model(plan.options), view, options).colour
        as_viewed = rasterizer.render(baked, view, options).colour
        raw = rasterizer.render(state.gaussians, view, options).colour
    assert float((as_viewed - as_trained).abs().max()) < 1e-5  # quaternions were normalised
    assert float((raw - as_trained).abs().max()) > 1e-3


def test_a_time_budget_is_planned_with_the_filter(scene: Path, tmp_path: Path) -> None:
    out = trained(scene, tmp_path / "out", TrainConfig(time_budget_s=3.0, filter_3d=True))
    plan = Plan.from_json((out / "plan.json").read_text())
    assert plan.options.filter_3d and plan.train_seconds > 0.0
    assert bool(read_splat(out / "model.ply").finite().all())


@pytest.fixture(scope="module")
def models(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Gaussians]:
    """Trained long enough that Gaussians become finer than the pixels: plain, with the 3D filter, with both filters."""
    folder, long = tmp_path_factory.mktemp("models"), tiny_scene.plain(iterations=200)
    options: dict[str, dict[str, bool]] = {
        "plain": {},
        "filtered": {"filter_3d": True},
        "both": {"filter_3d": True, "antialias": True},
    }
    return {
        name: read_splat(trained(scene, folder / name, long.model_copy(update=changed)) / "model.ply")
        for name, changed in options.items()
    }


def test_no_gaussian_of_the_file_is_finer_than_its_filter(scene: Path, models: dict[str, Gaussians]) -> None:
    views = load_views(scene / "dataset")
    plan = make_plan(QUICK, views, tiny_scene.split_of(views, 4), 1)
    sampling = sampling_of(plan, [view for view in views if view.camera.name in set(plan.train_views)])
    assert sampling is not None
    finest = {}
    for name, gaussians in models.items():
        sigmas = sampling.filter_sigmas(gaussians.means)
        finest[name] = float((torch.exp(gaussians.log_scales).amin(dim=1) / sigmas).min())
    assert finest["plain"] < 0.8
    assert min(finest["filtered"], finest["both"]) > 0.95  # positions have moved since the last refresh


def test_renders_at_half_and_double_resolution_are_as_bright_as_they_should(models: dict[str, Gaussians]) -> None:
    def brightness(name: str) -> tuple[float, float]:
        settings = rasterizer.RenderOptions(3, antialias=name == "both", depth=False)
        shares = []
        for factor in (0.5, 2.0):
            camera = tiny_scene.cameras()[4]  # held out
            camera = camera.scaled(int(factor * camera.width), int(factor * camera.height))
            with torch.no_grad():
                rendered = rasterizer.render(models[name], camera, settings).colour.clamp(0.0, 1.0)
            shares.append(float(rendered.mean()) / float(ideal(camera).mean()))
        return shares[0], shares[1]

    plain, filtered = brightness("plain"), brightness("filtered")
    assert plain[0] > 1.25 and plain[1] < 0.93  # 1.50 and 0.87 were measured: the screen's blur in wrong proportion
    assert filtered[0] < plain[0] - 0.03 and filtered[1] > plain[1] + 0.01  # 1.42 and 0.91
    assert brightness("both") == pytest.approx((1.0, 1.0), abs=0.05)  # 0.99 and 1.00
