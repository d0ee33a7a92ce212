"""Moving objects: what one photo shows and the others contradict is excluded from the loss, and little else is."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.raster.rasterizer import Render, RenderOptions, render
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.quality import metrics
from splatpipe.pipeline.train import loop
from splatpipe.pipeline.train.appearance.robust import (
    GRID,
    MAX_SHARE_OF_PHOTO,
    MIN_RESIDUAL,
    UNKNOWN,
    RobustMask,
    cell_residuals,
    share_at,
)
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.plan.schedule import ScheduleStep
from splatpipe.pipeline.train.sizing import shortage
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.stages import initialize, train

SCALE = 2  # times the tiny photos' sides: so that cells of four pixels average something
HELD_OUT = (1, 3, 5)  # between the others: a test of what was learnt, not of extrapolation
CARS = {2: (20, 30, 40, 60), 4: (60, 90, 85, 125)}  # top, left, bottom, right in a photo, pixels
YELLOW = (0.9, 0.86, 0.12)


def cameras() -> list[Camera]:
    return [camera.scaled(SCALE * camera.width, SCALE * camera.height) for camera in tiny_scene.cameras()]


def true_photo(camera: Camera) -> torch.Tensor:
    return torch.from_numpy(tiny_scene.photograph(tiny_scene.true_model(), camera)).float() / 255.0


def true_render(camera: Camera) -> Render:
    with torch.no_grad():
        return render(tiny_scene.true_model(), camera, RenderOptions(sh_degree=3))


def painted(colour: torch.Tensor, block: tuple[int, int, int, int]) -> torch.Tensor:
    top, left, bottom, right = block
    result = colour.clone()
    result[top:bottom, left:right] = torch.tensor(YELLOW)
    return result


def of_block(camera: Camera, block: tuple[int, int, int, int]) -> torch.Tensor:
    top, left, bottom, right = block
    result = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    result[top:bottom, left:right] = True
    return result


def looked(robust: RobustMask, camera: Camera, colour: torch.Tensor, mask: torch.Tensor | None = None) -> TrainingPhoto:
    """A visit of a model that is the truth."""
    rendered = true_render(camera)
    return robust.leave_out_contradicted(TrainingPhoto(camera, colour, mask), rendered, rendered.colour)


def an_epoch(robust: RobustMask, share: float = 0.05, cars: tuple[int, ...] = (2,)) -> dict[int, TrainingPhoto]:
    """A visit to every photo, some with a block painted into them; then the threshold of ``share``."""
    found = {}
    for number, camera in enumerate(cameras()):
        colour = true_photo(camera)
        found[number] = looked(robust, camera, painted(colour, CARS[2]) if number in cars else colour)
    robust.end_epoch(share)
    return found


@pytest.fixture
def robust() -> RobustMask:
    made = RobustMask([camera.name for camera in cameras()])
    made.watch(reversed(cameras()))  # in any order
    return made


def test_block_that_the_other_photos_contradict_is_left_out_and_little_else(robust: RobustMask) -> None:
    assert all(photo.mask is None for photo in an_epoch(robust).values())  # nothing is known before an epoch has ended
    photos = an_epoch(robust)
    assert all(photos[number].mask is None for number in photos if number != 2)
    counts, block = photos[2].mask, of_block(cameras()[2], CARS[2])
    assert counts is not None
    assert float((~counts & block).sum() / block.sum()) > 0.85
    assert float((~counts & ~block).float().mean()) < 0.015
    assert robust.share_left_out() == pytest.approx(float((~counts).float().mean()) / 9.0, rel=1e-6)


def test_a_device_that_processes_all_cells_leaves_out_the_same(
    robust: RobustMask, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = RobustMask([camera.name for camera in cameras()])
    other.watch(cameras())
    an_epoch(robust), an_epoch(other)
    photos = an_epoch(robust)
    monkeypatch.setattr(
        "splatpipe.pipeline.train.appearance.robust._cell_indices", lambda asked: torch.arange(len(asked))
    )
    for number, photo in an_epoch(other).items():
        expected = photos[number].mask
        assert (photo.mask is None) == (expected is None)
        assert photo.mask is None or expected is None or torch.equal(photo.mask, expected)
    assert torch.equal(robust.scores, other.scores)


def test_place_where_most_photos_disagree_with_the_model_is_not_contradicted(robust: RobustMask) -> None:
    """The model lacks an object that all photos show: it has to be learnt."""
    for _ in range(2):
        for camera in cameras():
            rendered, missing = true_render(camera), true_photo(camera)
            missing[20:88, 20:124] = torch.tensor(YELLOW)
            photo = robust.leave_out_contradicted(TrainingPhoto(camera, missing, None), rendered, rendered.colour)
        robust.end_epoch(0.5)
        robust.threshold.clamp_(max=MIN_RESIDUAL)  # however many are above it
    assert bool((robust.scores[3] > MIN_RESIDUAL).any())
    assert photo.mask is None or float((~photo.mask).float().mean()) < 0.02


def test_without_cameras_nothing_is_left_out() -> None:
    robust = RobustMask([camera.name for camera in cameras()])
    an_epoch(robust)
    assert all(photo.mask is None for photo in an_epoch(robust).values())


def test_masked_pixels_stay_masked_and_are_not_judged(robust: RobustMask) -> None:
    an_epoch(robust)
    camera = cameras()[2]
    mask = ~of_block(camera, (0, 70, 108, 144))
    photo = looked(robust, camera, painted(true_photo(camera), CARS[2]), mask)
    assert photo.mask is not None and not bool((photo.mask & ~mask).any())
    assert bool((mask & ~photo.mask).any())
    rendered = true_render(camera)
    nothing, judged = cell_residuals(rendered.colour, true_photo(camera), torch.zeros_like(mask), camera)
    assert judged is None
    assert bool((nothing == UNKNOWN).all())


def test_exposure_and_displaced_detail_are_not_motion_but_a_block_is() -> None:
    camera = cameras()[3]
    model, everywhere = true_photo(camera), torch.ones(camera.height, camera.width, dtype=torch.bool)
    for other in (model, model + 0.2, model.roll((1, 1), (0, 1)), model.roll(-1, 1)):
        residual = cell_residuals(model, other, everywhere, camera)[0][4:-4, 4:-4]  # rolled in at the rim
        assert float((residual > MIN_RESIDUAL).float().mean()) < 0.01
    residual, _ = cell_residuals(model, painted(model, CARS[2]), everywhere, camera)
    assert float((residual > MIN_RESIDUAL).float().mean()) > 0.02


def test_holes_of_the_model_contradict_nothing(robust: RobustMask) -> None:
    an_epoch(robust, cars=())
    camera = cameras()[2]
    rendered, hole = true_render(camera), of_block(camera, CARS[2])
    rendered.alpha[hole], rendered.colour[hole] = 0.3, 0.0
    photo = TrainingPhoto(camera, true_photo(camera), None)
    assert robust.leave_out_contradicted(photo, rendered, rendered.colour).mask is None


def test_no_more_than_a_quarter_of_a_photo_is_left_out(robust: RobustMask) -> None:
    an_epoch(robust)
    camera = cameras()[4]
    generator = torch.Generator().manual_seed(1)
    for _ in range(3):
        patches = torch.rand(9, 12, 3, generator=generator).repeat_interleave(12, 0).repeat_interleave(12, 1)
        photo = looked(robust, camera, patches)
    assert photo.mask is not None
    assert 0.02 < float((~photo.mask).float().mean()) <= MAX_SHARE_OF_PHOTO + 0.01


def test_threshold_is_the_quantile_of_all_known_cells() -> None:
    robust = RobustMask(["a", "b"])
    robust.end_epoch(0.1)
    assert torch.isinf(robust.threshold).all()  # nothing known
    robust.scores[0] = torch.linspace(0.0, 1.0, GRID * GRID).view(GRID, GRID)
    robust.end_epoch(0.1)
    assert float(robust.threshold) == pytest.approx(0.9, abs=1e-3)
    robust.end_epoch(0.99)
    assert float(robust.threshold) == pytest.approx(MIN_RESIDUAL)
    robust.end_epoch(0.0)
    assert torch.isinf(robust.threshold).all()


def test_share_rises_from_the_beginning_of_density_control() -> None:
    shares = [share_at(0.1, 200, iteration) for iteration in (1, 200, 300, 400, 1000)]
    assert shares == pytest.approx([0.0, 0.0, 0.05, 0.1, 0.1])


def test_a_repeated_visit_counts_once(robust: RobustMask) -> None:
    plain, camera = RenderOptions(sh_degree=3), cameras()[2]
    now = ScheduleStep(1, 1, 0.0, 0, 3, (0.0, 0.0, 0.0), 0.0, True)
    model = tiny_scene.true_model()
    for number, colour in enumerate((true_photo(camera), painted(true_photo(camera), CARS[2]))):
        before = {name: tensor.clone() for name, tensor in robust.to_arrays().items()}
        robust.settings(plain, model, camera, now)
        robust.roll_back()  # memory ran out before the photo was processed
        assert all(torch.equal(tensor, before[name]) for name, tensor in robust.to_arrays().items()), number
        looked(robust, camera, colour)
        assert not torch.equal(robust.scores, before["scores"]), number
        robust.roll_back()
        assert all(torch.equal(tensor, before[name]) for name, tensor in robust.to_arrays().items()), number
        looked(robust, camera, colour)


def test_state_round_trips_through_arrays_and_refuses_another_shape(robust: RobustMask) -> None:
    an_epoch(robust)
    other = RobustMask([camera.name for camera in cameras()])
    other.load({name: tensor.clone() for name, tensor in robust.to_arrays().items()})
    assert all(torch.equal(tensor, robust.to_arrays()[name]) for name, tensor in other.to_arrays().items())
    with pytest.raises(ValueError, match="scores"):
        RobustMask(["a"]).load(robust.to_arrays())


@dataclass
class TrainedRun:
    """A training on photos with blocks in two of them."""

    summary: dict[str, object]
    psnr: float  # mean over the held-out photos, against the truth
    state: TrainState
    out: Path


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cars")
    tiny_scene.write_dataset(folder / "dataset", views=cameras())
    for number, block in CARS.items():
        path = folder / "dataset/images" / cameras()[number].name
        photo = torch.from_numpy(cv2.imread(str(path))[:, :, ::-1].copy()).float() / 255.0
        cv2.imwrite(str(path), (painted(photo, block) * 255.0).to(torch.uint8).numpy()[:, :, ::-1])
    inputs = Inputs({"undistort.dataset": folder / "dataset"}, folder)
    initialize.run(InitializeConfig(dense=False), inputs, folder, tiny_scene.Recorder())
    return folder


def trained(scene: Path, out: Path, robust: float, iterations: int = 400) -> TrainedRun:
    out.mkdir(exist_ok=True)
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    held_out = ",".join(cameras()[number].name for number in HELD_OUT)
    parts |= tiny_scene.split_part(scene / "dataset", names=held_out)
    inputs = Inputs(parts, scene, machine=Machine("cpu", 1))
    kept: list[TrainState] = []
    step = shortage.iterate

    def keeping(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto) -> None:
        kept[:] = [state]
        step(state, plan, photo)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shortage, "iterate", keeping)
        config = tiny_scene.plain(iterations=iterations, robust=robust)
        summary = dict(train.run(config, inputs, out, tiny_scene.Recorder()))
    model = read_splat(out / "model.ply")
    views = [cameras()[number] for number in HELD_OUT]
    renders = [torch.from_numpy(tiny_scene.photograph(model, view)).float() / 255.0 for view in views]
    psnr = [float(metrics.psnr(one, true_photo(view))) for one, view in zip(renders, views, strict=True)]
    return TrainedRun(summary, float(np.mean(psnr)), kept[0], out)


def test_held_out_photos_are_better_without_moving_objects(scene: Path, tmp_path: Path) -> None:
    off, on = trained(scene, tmp_path / "off", 0.0), trained(scene, tmp_path / "on", 0.05)
    assert on.psnr > off.psnr + 0.3
    assert "robust_left_out" not in off.summary and 0.01 < float(str(on.summary["robust_left_out"])) < 0.03
    robust = on.state.techniques.find(RobustMask)
    assert robust is not None
    names = sorted(camera.name for number, camera in enumerate(cameras()) if number not in HELD_OUT)
    left_out = dict(zip(names, robust.left_out.tolist(), strict=True))
    for number, (top, left, bottom, right) in CARS.items():
        camera = cameras()[number]
        painted_share = (bottom - top) * (right - left) / (camera.height * camera.width)
        assert 0.8 * painted_share < left_out.pop(camera.name) < 1.7 * painted_share
    assert max(left_out.values()) < 0.02


def test_killed_training_leaves_out_the_same_and_ends_with_the_same_bits(scene: Path, tmp_path: Path) -> None:
    whole = trained(scene, tmp_path / "whole", 0.05, 120)
    assert float(str(whole.summary["robust_left_out"])) > 0.0
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(loop, "CHECKPOINT_SHARE", 1e9)
        step = shortage.iterate

        def dying(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto) -> None:
            if state.iteration == 71:
                raise KeyboardInterrupt
            step(state, plan, photo)

        patch.setattr(shortage, "iterate", dying)
        trained(scene, tmp_path / "killed", 0.05, 120)
    killed = trained(scene, tmp_path / "killed", 0.05, 120)
    for part in ("model.ply", "history.json"):
        assert (killed.out / part).read_bytes() == (whole.out / part).read_bytes()
    assert killed.summary["robust_left_out"] == whole.summary["robust_left_out"]
