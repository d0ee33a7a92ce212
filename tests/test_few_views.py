"""Few views: depths of sparse points, degrees by coverage, decay and needles, dropout."""

import hashlib
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpipe.pipeline import raster
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.scene.camera import Camera
from splatpipe.pipeline.scene.dataset import PointDepths, View, load_views
from splatpipe.pipeline.scene.gaussians import Gaussians
from splatpipe.pipeline.scene.ply import read_splat
from splatpipe.pipeline.scene.sh import coefficient_count
from splatpipe.stages import initialize, train
from splatpipe.stages.options import InitializeConfig, TrainConfig
from splatpipe.stages.train import loop
from splatpipe.stages.train.depth import depth_weight_at, point_weights, supervised, with_depth
from splatpipe.stages.train.dropout import dropped, share_at
from splatpipe.stages.train.plan import Plan, make_plan
from splatpipe.stages.train.regularise import add_decay, limit_needles
from splatpipe.stages.train.sh_limit import Coverage, allowed_degree, fan_rad
from splatpipe.stages.train.state import TrainState
from splatpipe.stages.train.stream import TrainingPhoto

sys.path.insert(0, str(Path(__file__).parent / "scenes"))
import tiny_scene

QUICK = tiny_scene.plain(iterations=60, densify_from=10, densify_every=10, densify_until=40, reset_every=25, sh_every=5)
TECHNIQUES: dict[str, dict[str, object]] = {
    "depth": {"depth_weight": 0.2},
    "sh_limit": {"sh_limit": True},
    "decay": {"opacity_decay": 0.01, "scale_decay": 0.01, "max_anisotropy": 3.0},
    "dropout": {"dropout": 0.3},
}
FRONT = Camera("front", 32, 24, 30.0, 30.0, 16.0, 12.0, np.eye(4))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `dataset` and `init.ply`."""
    folder = tmp_path_factory.mktemp("scene")
    tiny_scene.write_dataset(folder / "dataset", masked="flight 1/photo_5.png")
    initialize.run(
        InitializeConfig(), Inputs({"undistort.dataset": folder / "dataset"}, folder), folder, tiny_scene.Recorder()
    )
    return folder


def trained(scene: Path, out: Path, config: TrainConfig) -> str:
    """The digest of what a training leaves."""
    out.mkdir(exist_ok=True)
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    settings = {"evaluate.every": 4, "evaluate.views": ""}
    train.run(config, Inputs(parts, scene, settings, Machine("cpu", 2)), out, tiny_scene.Recorder())
    return hashlib.sha256((out / "model.ply").read_bytes() + (out / "history.json").read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def plain(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The digest of a training without any of the techniques."""
    return trained(scene, tmp_path_factory.mktemp("plain"), QUICK)


class Killed(BaseException):
    """Stands for a kill: nothing of the trainer catches it."""


@pytest.mark.parametrize("technique", list(TECHNIQUES))
def test_killed_training_with_a_technique_ends_with_the_same_bits(
    scene: Path, plain: str, tmp_path: Path, technique: str
) -> None:
    config = QUICK.model_copy(update=TECHNIQUES[technique])
    whole = trained(scene, tmp_path / "whole", config)
    assert whole != plain
    step: Callable[[TrainState, Plan, TrainingPhoto], None] = loop.train_step

    def dying(state: TrainState, plan: Plan, photo: TrainingPhoto) -> None:
        if state.iteration == 34:
            raise Killed
        step(state, plan, photo)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        patch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(loop, "CHECKPOINT_SHARE", 1e9)
        patch.setattr(loop, "train_step", dying)
        trained(scene, tmp_path / "killed", config)
    assert trained(scene, tmp_path / "killed", config) == whole
    assert bool(read_splat(tmp_path / "whole/model.ply").finite().all())


def wall(depth: float, count: int = 30) -> Gaussians:
    """An opaque wall of Gaussians across the view of ``FRONT``, some of them nearer by up to a tenth."""
    generator = torch.Generator().manual_seed(2)
    gaussians = Gaussians.empty(count, 1)
    gaussians.means = (torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([3.0, 2.4, 0.2])
    # Evenly apart: where two change places in the order, a sum of slanted depths jumps.
    gaussians.means[:, 2] = depth + 0.2 * (torch.argsort(gaussians.means[:, 2]).argsort() / count - 0.5)
    gaussians.log_scales = torch.full((count, 3), math.log(0.35)) + 0.2 * torch.rand(count, 3, generator=generator)
    gaussians.quats = torch.randn(count, 4, generator=generator)
    gaussians.opacity_logits = 1.0 + torch.rand(count, generator=generator)
    return gaussians


def photo_of(share: list[tuple[float, float]], z: list[float], weights: list[float]) -> TrainingPhoto:
    depths = PointDepths(np.array(share), np.array(z), np.array(weights))
    return TrainingPhoto(FRONT, torch.zeros(FRONT.height, FRONT.width, 3), None, depths)


def depth_loss(gaussians: Gaussians, photo: TrainingPhoto, options: TrainConfig, iteration: int) -> torch.Tensor:
    rendered = raster.render(gaussians, photo.camera, raster.RenderOptions(sh_degree=0, depth=True))
    return with_depth(torch.zeros(()), rendered, photo, options, iteration)


def test_depth_term_is_the_weighted_mean_of_relative_inverse_depths() -> None:
    gaussians = wall(4.0)
    photo = photo_of([(0.3, 0.4), (0.52, 0.51), (0.7, 0.6)], [3.0, 4.0, 6.0], [0.5, 1.0, 0.25])
    options = TrainConfig(iterations=100, depth_weight=0.3)
    with torch.no_grad():
        depth = raster.render(gaussians, FRONT, raster.RenderOptions(sh_degree=0)).expected_depth
        found = float(depth_loss(gaussians, photo, options, 50))
    pixels = [depth[int(0.4 * 24), int(0.3 * 32)], depth[int(0.51 * 24), int(0.52 * 32)], depth[14, 22]]
    each = [abs(1.0 / float(d) - 1.0 / z) for d, z in zip(pixels, (3.0, 4.0, 6.0), strict=True)]
    mean = (0.5 * each[0] + each[1] + 0.25 * each[2]) / 1.75
    assert found == pytest.approx(0.3 * 10**-0.5 * 4.0 * mean, rel=1e-5)


def test_depth_term_is_the_same_in_any_unit_of_the_world() -> None:
    options = TrainConfig(iterations=100, depth_weight=0.3)
    places = [(0.3, 0.4), (0.6, 0.7)]
    small = depth_loss(wall(4.0), photo_of(places, [3.5, 5.0], [1.0, 1.0]), options, 1)
    grown = wall(4.0).transformed(10.0, torch.eye(3), torch.zeros(3))
    large = depth_loss(grown, photo_of(places, [35.0, 50.0], [1.0, 1.0]), options, 1)
    assert float(large) == pytest.approx(float(small), rel=1e-3)


@pytest.mark.parametrize("name", ["means", "opacity_logits", "log_scales"])
def test_gradient_of_the_depth_term_is_the_finite_difference(name: str) -> None:
    gaussians = wall(4.0).requires_grad_()
    photo = photo_of([(0.3, 0.4), (0.52, 0.51), (0.7, 0.6)], [3.0, 5.0, 6.0], [0.5, 1.0, 0.25])
    options = TrainConfig(iterations=100, depth_weight=1.0)
    depth_loss(gaussians, photo, options, 1).backward()  # type: ignore[no-untyped-call]
    gradient = getattr(gaussians, name).grad
    assert gradient is not None
    direction = gradient / gradient.norm()
    step, values = 2e-3, []
    for sign in (1.0, -1.0):
        moved = gaussians.detach().clone()
        setattr(moved, name, getattr(moved, name) + sign * step * direction)
        values.append(float(depth_loss(moved, photo, options, 1)))
    # 2 %: float32 renders, and pixels that cross the cut-off at alpha 1/255 within the step.
    assert (values[0] - values[1]) / (2.0 * step) == pytest.approx(float(gradient.norm()), rel=0.02)


@pytest.mark.parametrize("start", [3.0, 5.0])
def test_splat_at_a_wrong_depth_moves_to_the_points(start: float) -> None:
    gaussians = wall(start).requires_grad_()
    places = [(x, y) for x in (0.2, 0.4, 0.6, 0.8) for y in (0.2, 0.5, 0.8)]
    photo = photo_of(places, [4.0] * len(places), [1.0] * len(places))
    options = TrainConfig(iterations=1000, depth_weight=1.0)
    optimiser = torch.optim.Adam([gaussians.means], lr=0.02)
    for iteration in range(1, 121):
        optimiser.zero_grad()
        depth_loss(gaussians, photo, options, iteration).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    with torch.no_grad():
        depth = raster.render(gaussians, FRONT, raster.RenderOptions(sh_degree=0)).expected_depth
    found = [float(depth[int(y * 24), int(x * 32)]) for x, y in places]
    assert np.median(np.abs(np.array(found) - 4.0)) < 0.1


def test_masked_and_transparent_pixels_have_no_depth() -> None:
    options = TrainConfig(iterations=100, depth_weight=1.0)
    both = photo_of([(0.3, 0.4), (0.6, 0.7)], [2.0, 5.0], [1.0, 1.0])
    mask = torch.ones(24, 32, dtype=torch.bool)
    mask[: 24 // 2] = False
    alone = photo_of([(0.6, 0.7)], [5.0], [1.0])
    masked = float(depth_loss(wall(4.0), replace(both, mask=mask), options, 1))
    assert masked == pytest.approx(float(depth_loss(wall(4.0), alone, options, 1)) * 3.5 / 5.0)  # the median depth is
    faint = wall(4.0)  # of all points
    faint.opacity_logits -= 8.0
    assert float(depth_loss(faint, both, options, 1)) == 0.0


def test_weights_rise_with_the_track_and_fall_with_the_error() -> None:
    weights = point_weights(np.array([2, 3, 10, 3, 3]), np.array([1.0, 1.0, 1.0, 3.0, -1.0]))
    assert weights[0] < weights[1] < weights[2] < 1.0
    assert weights[3] < 0.2 * weights[1]
    np.testing.assert_allclose(weights[4], 0.5 * math.exp(-1.0))  # as the mean error's
    np.testing.assert_allclose(point_weights(np.array([2, 4]), np.array([-1.0, -1.0])) * math.e, [0.25, 0.625])


def test_depths_of_the_model_are_those_of_its_points_in_each_photo(scene: Path) -> None:
    views = load_views(scene / "dataset")
    assert supervised(views, scene / "dataset", TrainConfig(depth_weight=0.0)) == views
    truth = tiny_scene.true_model().means.numpy().astype(np.float64)
    found = supervised(views, scene / "dataset", TrainConfig(depth_weight=0.1))
    for view, camera in zip(found, tiny_scene.cameras(), strict=True):
        assert view.depths is not None and len(view.depths) > 100
        depth = (truth @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3])[:, 2]
        places = camera.project(truth) / [camera.width, camera.height]
        apart = np.linalg.norm(view.depths.share[:, None] - places[None], axis=2)
        near = np.abs(view.depths.z[:, None] - depth[None]) < 5.0 * tiny_scene.POINT_NOISE
        assert (near & (apart < 0.1)).any(axis=1).all()


def test_weight_of_depth_falls_to_a_tenth() -> None:
    options = TrainConfig(iterations=200, depth_weight=0.4)
    assert depth_weight_at(options, 0) == 0.4
    assert depth_weight_at(options, 100) == pytest.approx(0.4 * 10**-0.5)
    assert depth_weight_at(options, 200) == depth_weight_at(options, 900) == pytest.approx(0.04)


def test_decay_adds_the_gradient_of_its_definition_to_what_was_seen() -> None:
    gaussians, options = wall(4.0).requires_grad_(), TrainConfig(opacity_decay=0.3, scale_decay=0.7)
    size = torch.exp(gaussians.log_scales).sum(dim=1) / 2.5
    definition = 0.3 * torch.sigmoid(gaussians.opacity_logits).mean() + 0.7 * size.mean()
    expected = torch.autograd.grad(definition, (gaussians.opacity_logits, gaussians.log_scales))
    visible = torch.arange(len(gaussians)) % 3 > 0
    gaussians.opacity_logits.grad, gaussians.log_scales.grad = torch.ones(len(gaussians)), torch.ones(len(gaussians), 3)
    add_decay(gaussians, visible, options, extent=2.5)
    torch.testing.assert_close(gaussians.opacity_logits.grad, 1.0 + expected[0] * visible)
    torch.testing.assert_close(gaussians.log_scales.grad, 1.0 + expected[1] * visible[:, None])


def test_needles_are_cut_and_discs_are_not() -> None:
    scales = torch.tensor([[9.0, 1.0, 1.0], [1.0, 0.5, 8.0], [9.0, 9.0, 0.01], [1.0, 2.0, 3.0]])
    logs = torch.log(scales)
    limit_needles(logs, TrainConfig(max_anisotropy=4.0))
    expected = torch.tensor([[4.0, 1.0, 1.0], [1.0, 0.5, 4.0], [9.0, 9.0, 0.01], [1.0, 2.0, 3.0]])
    torch.testing.assert_close(torch.exp(logs), expected)
    before = logs.clone()
    limit_needles(logs, TrainConfig())
    assert torch.equal(logs, before)


def test_share_of_dropped_gaussians_rises_to_the_option_and_they_are_not_projected() -> None:
    options = TrainConfig(iterations=100, dropout=0.4)
    gaussians = Gaussians.concat([wall(4.0)] * 100).requires_grad_()
    for iteration in (25, 100, 300):
        share = share_at(options, iteration)
        assert share == pytest.approx(0.4 * min(1.0, iteration / 100))
        model = dropped(gaussians, options, iteration)
        left_out = model.opacity_logits.detach() < -20.0
        assert float(left_out.float().mean()) == pytest.approx(share, abs=4.0 * math.sqrt(0.25 / len(gaussians)))
        rendered = raster.render(model, FRONT, raster.RenderOptions(sh_degree=0))
        assert not bool(rendered.visible[left_out].any())
        gaussians.opacity_logits.grad = None
        rendered.colour.sum().backward()
        assert not bool(gaussians.opacity_logits.grad[left_out].any())
    assert not torch.equal(dropped(gaussians, options, 98).opacity_logits, model.opacity_logits)
    again = dropped(gaussians, options, 300).opacity_logits
    assert torch.equal(again, model.opacity_logits)
    assert dropped(gaussians, TrainConfig(dropout=0.0), 50) is gaussians


def test_dropping_keeps_what_a_pixel_shows_on_average() -> None:
    options = TrainConfig(iterations=1, dropout=0.25)
    gaussians = wall(4.0)
    gaussians.opacity_logits -= 1.5  # below 0.75, so that no scaled opacity reaches 1
    settings = raster.RenderOptions(sh_degree=0)
    with torch.no_grad():
        whole = raster.render(gaussians, FRONT, settings).alpha
        draws = [raster.render(dropped(gaussians, options, draw), FRONT, settings).alpha for draw in range(1, 401)]
    stacked = torch.stack(draws)
    error = (stacked.mean(dim=0) - whole).abs()
    # Five standard errors, and the flanks of up to three Gaussians that only scaled opacities lift above 1/255.
    assert bool((error < 5.0 * stacked.std(dim=0) / math.sqrt(len(draws)) + 3.0 / 255.0).all())
    assert float(error.mean()) < 0.01 < 0.05 * float(whole.mean())


def test_gradient_through_dropping_is_that_of_the_scaled_opacity() -> None:
    options = TrainConfig(iterations=1, dropout=0.25)
    logits = torch.linspace(-6.0, 0.9, 40).requires_grad_()
    gaussians = replace(wall(4.0, 40), opacity_logits=logits)
    torch.sigmoid(dropped(gaussians, options, 7).opacity_logits).sum().backward()
    kept = dropped(gaussians, options, 7).opacity_logits.detach() > -20.0
    opacity = torch.sigmoid(logits.detach())
    torch.testing.assert_close(logits.grad, kept * opacity * (1.0 - opacity) / 0.75, rtol=1e-4, atol=1e-7)


def ring(width_deg: float, photos: int) -> list[Camera]:
    """Cameras on an arc of that width about the origin at a distance of 5."""
    found = []
    for angle in np.radians(np.linspace(-0.5, 0.5, photos) * width_deg):
        pose = np.eye(4)
        pose[:3, 3] = -np.array([5.0 * math.sin(angle), 0.0, -5.0 * math.cos(angle)])  # only the centre counts
        found.append(Camera("ring", 32, 24, 30.0, 30.0, 16.0, 12.0, pose))
    return found


def covered(cameras: list[Camera], count: int = 3) -> Coverage:
    coverage = Coverage(count)
    seen = torch.ones(count, dtype=torch.bool)
    seen[-1] = False
    for camera in cameras:
        coverage.observe(torch.zeros(count, 3), camera, seen)
    return coverage


@pytest.mark.parametrize(
    ("width_deg", "photos", "degree"),
    [
        (0.0, 20, 0),
        (10.0, 20, 0),
        (25.0, 20, 1),
        (50.0, 20, 2),
        (90.0, 20, 3),
        (342.0, 20, 3),
        (90.0, 8, 1),
        (90.0, 3, 0),
    ],
)
def test_degree_follows_from_the_angles_and_the_number_of_photos(width_deg: float, photos: int, degree: int) -> None:
    coverage = covered(ring(width_deg, photos))
    coverage.end_epoch()
    assert coverage.degree.tolist() == [degree, degree, 0]
    assert not coverage.seen.any() and not coverage.directions.any()


@pytest.mark.parametrize("width_deg", [10.0, 40.0, 80.0])
def test_width_of_an_even_fan_is_found_from_its_sum(width_deg: float) -> None:
    coverage = covered(ring(width_deg, 200))
    found = math.degrees(float(fan_rad(coverage.directions, coverage.seen)[0]))
    assert found == pytest.approx(width_deg, rel=0.03)  # the fourth order of the series, and 1/200 for the fan's ends


def test_children_inherit_and_unseen_gaussians_keep_their_degree() -> None:
    coverage = covered(ring(90.0, 20))
    coverage.end_epoch()
    coverage.select(torch.tensor([1, 2, 0, 0]))
    assert coverage.degree.tolist() == [3.0, 0.0, 3.0, 3.0]
    coverage.end_epoch()
    assert coverage.degree.tolist() == [3.0, 0.0, 3.0, 3.0]
    assert allowed_degree(torch.zeros(1, 3), torch.zeros(1)).tolist() == [0.0]


def test_coefficients_beyond_the_degree_stay_zero_in_training(scene: Path, tmp_path: Path) -> None:
    trained(scene, tmp_path, QUICK.model_copy(update={"sh_limit": True}))  # six photos: four coefficients at most
    sh = read_splat(tmp_path / "model.ply").sh
    assert not sh[:, coefficient_count(1) :].any()
    assert sh[:, 1 : coefficient_count(1)].any()


def test_only_what_a_photo_really_shows_is_counted_as_seen() -> None:
    """A Gaussian behind an opaque wall is within the frustum, but has no gradient."""
    hidden = wall(8.0, 1)
    layers = [wall(4.0), wall(4.5), wall(5.0), wall(5.5)]
    for layer in layers:
        layer.opacity_logits += 8.0
    hidden.log_scales -= 1.0
    views = [View(camera, Path(), None) for camera in tiny_scene.cameras()]
    plan = make_plan(TrainConfig(sh_limit=True, sh_degree=1), views, 0, "", 1)
    state = TrainState.begin(Gaussians.concat([*layers, hidden]), plan)
    rendered = raster.render(state.gaussians, FRONT, raster.RenderOptions(sh_degree=1))
    assert bool(rendered.visible[-1])
    rendered.colour.square().sum().backward()
    state.observe_directions(FRONT)
    assert state.coverage is not None
    assert float(state.coverage.seen[-1]) == 0.0 and float(state.coverage.seen.sum()) > 20.0


def test_coverage_of_another_number_of_gaussians_is_refused() -> None:
    with pytest.raises(RuntimeError, match="directions"):
        Coverage(5).load(Coverage(1).to_arrays())
