"""The sky in training: detected, learned by direction, free of Gaussians, and bit-identical however it was run."""

import hashlib
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import skies
import tiny_scene
import torch

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.device import cpu
from splatpipe.pipeline.raster.rasterizer import Render
from splatpipe.pipeline.render.options import EvaluateConfig
from splatpipe.pipeline.splat.containers.ply import read_splat, write_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.sky.panorama import COLUMNS, ROWS, read_panorama
from splatpipe.pipeline.splat.sky.sky_mask import SkyMask, directions
from splatpipe.pipeline.train import loop
from splatpipe.pipeline.train.appearance.sky import SkyModel, filled
from splatpipe.pipeline.train.appearance.sky_file import read_skies, write_skies
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan
from splatpipe.pipeline.train.sizing import shortage
from splatpipe.pipeline.train.sizing.measure import MeasuringBudget, TimedScene, measure
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.stages import evaluate, initialize, train

QUICK = TrainConfig(iterations=40, sky="model", sh_degree=1)
CELLS = ROWS * COLUMNS
BLACK = (0.0, 0.0, 0.0)


@pytest.fixture(autouse=True)
def one_torch_thread() -> Iterator[None]:
    """Use one thread as in training: on small tensors more threads cost more than they gain."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `dataset` and `init.ply`, to which white Gaussians are added that hang in the sky."""
    folder = tmp_path_factory.mktemp("skies")
    skies.write_dataset(folder / "dataset")
    parts = {"undistort.dataset": folder / "dataset"}
    initialize.run(InitializeConfig(dense=False), Inputs(parts, folder), folder, tiny_scene.Recorder())
    start = read_splat(folder / "init.ply")
    start = start.select(torch.arange(0, len(start), 3))
    balloons = start.select(torch.arange(40))
    balloons.means = torch.rand(40, 3, generator=torch.Generator().manual_seed(4))
    balloons.means = balloons.means * torch.tensor([12.0, 2.0, 3.0]) + torch.tensor([-6.0, 9.0, 4.0])
    balloons.log_scales = torch.full((40, 3), -0.7)
    balloons.opacity_logits = torch.full((40,), 0.5)
    balloons.sh = torch.full_like(balloons.sh, 1.3)
    both = {name: torch.cat([tensor, balloons.tensors()[name]]) for name, tensor in start.tensors().items()}
    write_splat(folder / "init.ply", Gaussians.from_tensors(both))
    return folder


def make_inputs(scene: Path, out: Path, threads: int = 1) -> Inputs:
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    parts |= tiny_scene.split_part(scene / "dataset", 3)
    parts |= {"clean.model": out / "model.ply", "train.rendering": out / "rendering.json", "train.sky": out / "sky.npz"}
    return Inputs(parts, scene, machine=Machine("cpu", threads))


def trained(scene: Path, out: Path, config: TrainConfig = QUICK, threads: int = 1) -> tuple[str, tiny_scene.Recorder]:
    out.mkdir(exist_ok=True)
    recorder = tiny_scene.Recorder()
    train.run(config, make_inputs(scene, out, threads), out, recorder)
    return hashlib.sha256((out / "model.ply").read_bytes() + (out / "sky.npz").read_bytes()).hexdigest(), recorder


def test_sky_begins_with_the_colours_that_the_photos_show(scene: Path) -> None:
    sky = SkyModel.begin(load_views(scene / "dataset"), scene / "dataset", 2)
    assert sky is not None and sky.photos == len(skies.HEADINGS)
    camera = skies.aimed_camera(heading_deg=3.0, pitch_deg=8.0)
    photo, truth = skies.trace(camera)
    with torch.no_grad():
        seen = sky.panorama.behind(camera, (0.0, 0.0, 0.0)).numpy()
    error = np.abs(seen - photo.pixels / 255.0)[truth]
    assert error.mean() < 0.02
    assert bool(torch.isfinite(sky.panorama.colours).all())


def test_sky_masks_are_the_sky(scene: Path, tmp_path: Path) -> None:
    shutil.copytree(scene / "dataset", tmp_path / "dataset")
    name = load_views(scene / "dataset")[2].camera.name
    drawn = np.zeros((skies.HEIGHT, skies.WIDTH), np.uint8)
    drawn[:100, :200] = 255
    (tmp_path / "dataset/sky_masks").mkdir()
    cv2.imwrite(str(tmp_path / f"dataset/sky_masks/{name}.png"), drawn)
    view = load_views(tmp_path / "dataset")[2]
    sky = SkyModel.begin([view], tmp_path / "dataset", 1)
    assert sky is not None
    seen = sky.seen(view.camera)
    assert seen is not None
    np.testing.assert_array_equal(seen.mask.numpy(), drawn > 0)


def test_cells_that_no_photo_shows_are_interpolated() -> None:
    total = np.zeros((CELLS, 4))
    total[20 * COLUMNS : 21 * COLUMNS] = [8.0, 4.0, 2.0, 10.0]
    total[30 * COLUMNS : 31 * COLUMNS] = [2.0, 4.0, 8.0, 10.0]
    grid = filled(total).reshape(ROWS, COLUMNS, 3)
    np.testing.assert_allclose(grid[25], np.full((COLUMNS, 3), [0.5, 0.4, 0.5]), atol=0.01)
    np.testing.assert_allclose(grid[31], np.full((COLUMNS, 3), [0.2, 0.4, 0.8]), atol=1e-6)
    np.testing.assert_allclose(grid[17], np.full((COLUMNS, 3), [0.8, 0.4, 0.2]), atol=0.05)


def empty_render(camera: Camera) -> Render:
    blank = torch.zeros(camera.height, camera.width)
    none = torch.zeros(0)
    return Render(torch.zeros(camera.height, camera.width, 3), blank, blank, blank, blank, none.bool(), none)


def test_constant_sky_is_learnt_in_a_few_steps_and_only_from_pixels_of_the_sky() -> None:
    camera = skies.aimed_camera(pitch_deg=30.0).scaled(80, 60)
    mask = np.zeros((60, 80), bool)
    mask[:30] = True
    sky = SkyModel(skies.UP, np.full((CELLS, 3), 0.5, np.float32), {camera.name: SkyMask.packed(mask)})
    photo = torch.full((60, 80, 3), 0.1)
    photo[:30] = torch.tensor([0.3, 0.5, 0.7])
    seen = sky.seen(camera)
    for number in range(120):
        composite = sky.composite(empty_render(camera), camera, seen, BLACK, (0.1, 0.1, 0.1))
        ((composite - photo).abs().mean() + sky.loss(torch.zeros(photo.shape[:2]), seen)).backward()
        sky.step(number / 120)
    with torch.no_grad():
        learnt = sky.panorama.behind(camera, (0.0, 0.0, 0.0))
    assert float((learnt - photo)[:24].abs().mean()) < 0.02
    assert float(learnt[-10:].mean()) > 0.4  # the dark wall below did not affect it


def test_a_sky_trained_elsewhere_is_rendered_and_unchanged() -> None:
    camera = skies.aimed_camera(pitch_deg=30.0).scaled(80, 60)
    mask = np.zeros((60, 80), bool)
    mask[:30] = True
    colours = np.random.default_rng(1).random((CELLS, 3), np.float32)
    trained = SkyModel(skies.UP, colours, {camera.name: SkyMask.packed(mask)})
    given = SkyModel.given(trained.panorama, trained.masks).copied()
    alpha = torch.full((60, 80), 0.5).requires_grad_()
    for sky in (trained, given):
        composited = sky.composite(replace(empty_render(camera), alpha=alpha), camera, sky.seen(camera), BLACK, BLACK)
        (composited.mean() + sky.loss(alpha, sky.seen(camera))).backward()
    assert alpha.grad is not None and trained.panorama.colours.grad is not None
    assert given.is_given and given.panorama.colours.grad is None
    np.testing.assert_array_equal(given.panorama.colours.numpy(), colours)


def test_skies_are_returned_for_the_requested_photos(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    sizes = {"flight 1/é": (5, 7), "b": (3, 3), "none": (1, 9)}
    masks = {name: SkyMask.packed(rng.random(size) > 0.5) for name, size in sizes.items()}
    write_skies(tmp_path / "skies.npz", masks)
    found = read_skies(tmp_path / "skies.npz", {"b", "flight 1/é", "another"})
    assert sorted(found) == ["b", "flight 1/é"]
    for name, mask in found.items():
        np.testing.assert_array_equal(mask.unpacked(), masks[name].unpacked())
    write_skies(tmp_path / "skies.npz", {})
    assert read_skies(tmp_path / "skies.npz", {"b"}) == {}
    (tmp_path / "skies.npz").write_bytes(b"PK")
    with pytest.raises(StageError, match="skies of the coarse pass"):
        read_skies(tmp_path / "skies.npz", {"b"})


def test_away_from_the_sky_only_the_given_colour_shines_through() -> None:
    camera = skies.aimed_camera(pitch_deg=30.0)
    mask = np.zeros((skies.HEIGHT, skies.WIDTH), bool)
    mask[:60] = True
    sky = SkyModel(skies.UP, np.full((CELLS, 3), 0.5, np.float32), {camera.name: SkyMask.packed(mask)})
    rendered = replace(empty_render(camera), alpha=torch.full(mask.shape, 0.75))
    with torch.no_grad():
        composited = sky.composite(rendered, camera, sky.seen(camera), BLACK, (1.0, 0.0, 0.2))
        unknown = sky.composite(rendered, camera, None, BLACK, (1.0, 0.0, 0.2))
    torch.testing.assert_close(composited[:63], torch.full((63, skies.WIDTH, 3), 0.125))
    torch.testing.assert_close(composited[64:120], torch.tensor([0.25, 0.0, 0.05]).expand_as(composited[64:120]))
    torch.testing.assert_close(unknown[:120], torch.full((120, skies.WIDTH, 3), 0.125))  # nothing is known of it


def test_penalty_is_the_mean_opacity_in_front_of_the_sky() -> None:
    camera = skies.aimed_camera()
    mask = np.zeros((skies.HEIGHT, skies.WIDTH), bool)
    mask[:60] = True
    sky = SkyModel(skies.UP, np.full((CELLS, 3), 0.5, np.float32), {camera.name: SkyMask.packed(mask)})
    alpha = torch.rand(mask.shape, generator=torch.Generator().manual_seed(1)).requires_grad_()
    loss = sky.loss(alpha, sky.seen(camera))
    assert float(loss.detach()) == pytest.approx(0.1 * float(alpha.detach()[:60].sum()) / mask.size, rel=1e-5)
    loss.backward()
    assert alpha.grad is not None and torch.equal(alpha.grad != 0.0, torch.from_numpy(mask))
    small = sky.seen(camera.scaled(80, 60))
    assert small is not None and small.mask[:15].all() and not small.mask[15:].any()
    assert sky.seen(skies.aimed_camera(heading_deg=77.0)) is None


def opacity_in_sky(scene: Path, model: Path) -> float:
    gaussians, found = read_splat(model), []
    for view in load_views(scene / "dataset"):
        _, truth = skies.trace(view.camera)
        inner = cv2.erode(truth.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        with torch.no_grad():
            alpha = rasterizer.render(gaussians, view.camera, rasterizer.RenderOptions(gaussians.sh_degree)).alpha
        found.append(float(alpha[torch.from_numpy(inner)].mean()))
    return float(np.mean(found))


def test_training_clears_the_sky_of_gaussians_and_held_out_photos_gain(scene: Path, tmp_path: Path) -> None:
    config = QUICK.model_copy(update={"iterations": 100, "densify": False})
    quality = {}
    for sky in ("off", "model"):
        out = tmp_path / sky
        trained(scene, out, config.model_copy(update={"sky": sky}))
        summary = evaluate.run(EvaluateConfig(), make_inputs(scene, out), out, tiny_scene.Recorder())
        quality[sky] = (opacity_in_sky(scene, out / "model.ply"), float(str(summary["psnr"])))
    assert opacity_in_sky(scene, scene / "init.ply") > 0.15
    assert quality["model"][0] < 0.05 < quality["off"][0]
    assert quality["model"][1] > quality["off"][1] + 3.0


class Kill(BaseException):
    """Stands in for a kill."""


@pytest.fixture(scope="module")
def undisturbed(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The digest of a training that nothing disturbed."""
    return trained(scene, tmp_path_factory.mktemp("undisturbed"))[0]


@pytest.mark.parametrize("when", [2, 25])
def test_killed_training_resumes_with_the_same_bits(scene: Path, undisturbed: str, tmp_path: Path, when: int) -> None:
    step = shortage.iterate

    def dying(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto) -> None:
        if state.iteration + 1 == when:
            raise Kill
        step(state, plan, photo)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Kill):
        patch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(loop, "CHECKPOINT_SHARE", 1e9)
        patch.setattr(shortage, "iterate", dying)
        trained(scene, tmp_path / "killed")
    digest, recorder = trained(scene, tmp_path / "killed", threads=2)
    assert not recorder.warnings
    assert digest == undisturbed


def test_checkpoint_without_its_sky_is_reported_and_the_training_starts_again(scene: Path, tmp_path: Path) -> None:
    sky = SkyModel.begin(load_views(scene / "dataset"), scene / "dataset", 1)
    assert sky is not None
    before = sky.panorama.colours.detach().clone()
    with pytest.raises((KeyError, ValueError)):
        sky.load({})
    with pytest.raises((KeyError, ValueError)):
        sky.load({"colours": torch.zeros(CELLS, 3)})
    assert torch.equal(sky.panorama.colours.detach(), before)


def test_capture_without_sky_trains_as_if_it_were_off(tmp_path: Path) -> None:
    skies.write_dataset(tmp_path / "dataset", pitch_deg=-60.0)
    parts = {"undistort.dataset": tmp_path / "dataset"}
    initialize.run(InitializeConfig(dense=False), Inputs(parts, tmp_path), tmp_path, tiny_scene.Recorder())
    out, off = tmp_path / "model", tmp_path / "off"
    _, recorder = trained(tmp_path, out, QUICK.model_copy(update={"iterations": 5}))
    assert not recorder.notes
    trained(tmp_path, off, QUICK.model_copy(update={"iterations": 5, "sky": "off"}))
    assert read_panorama(out / "sky.npz") is None
    assert (out / "model.ply").read_bytes() == (off / "model.ply").read_bytes()


def test_held_out_views_are_rendered_with_the_sky(scene: Path, tmp_path: Path) -> None:
    trained(scene, tmp_path, QUICK.model_copy(update={"iterations": 2}))
    model = read_splat(tmp_path / "model.ply")
    model.opacity_logits = torch.full_like(model.opacity_logits, -20.0)
    write_splat(tmp_path / "model.ply", model)
    evaluate.run(EvaluateConfig(), make_inputs(scene, tmp_path), tmp_path, tiny_scene.Recorder())
    sky = read_panorama(tmp_path / "sky.npz")
    assert sky is not None
    camera = load_views(scene / "dataset")[0].camera
    render = cv2.imread(str(tmp_path / "views/0.render.png"))[:, :, ::-1] / 255.0
    expected = sky.at(directions(camera)).numpy()
    assert np.abs(render - expected)[:60].max() < 0.02
    assert render[-20:].max() == 0.0


def test_a_budget_measures_iterations_with_the_sky_and_does_not_change_it(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    views, start = load_views(scene / "dataset"), read_splat(scene / "init.ply")
    sky = SkyModel.begin(views, scene / "dataset", 1)
    assert sky is not None
    plan, before = (
        make_plan(QUICK, views, tiny_scene.split_of(views), len(start)),
        sky.panorama.colours.detach().clone(),
    )
    moved, iterate = [], shortage.iterate

    def watched(state: TrainState, trial: TrainingPlan, photo: TrainingPhoto) -> None:
        iterate(state, trial, photo)
        trained = state.techniques.find(SkyModel)
        assert trained is not None
        moved.append(not torch.equal(trained.panorama.colours, before))

    monkeypatch.setattr(shortage, "iterate", watched)
    measure(plan, TimedScene(start, views, cpu(), sky), MeasuringBudget(0.0, 1e-3), tiny_scene.Recorder())
    assert any(moved) and torch.equal(sky.panorama.colours, before)
