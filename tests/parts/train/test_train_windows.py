"""Training on windows: it learns what whole photos teach, and ends bit-identical however it was run."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.photos.pixels.images import load_colour
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.quality import metrics
from splatpipe.pipeline.train import loop
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.plan.schedule import Schedule
from splatpipe.pipeline.train.plan.windows import TrainingSize, windows_of
from splatpipe.pipeline.train.sizing import shortage
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.stages import initialize, train

WINDOW_PIXELS = 1200
COARSE = 20  # iterations
PARTS = ["exposures.json", "history.json", "model.ply", "sky.npz"]
TECHNIQUES: dict[str, object] = {
    "exposure": "affine",
    "dropout": 0.2,
    "distortion_weight": 0.05,
    "prune_free_space": 2,
    "robust": 0.1,
}


def training_size_at(schedule: Schedule, iteration: int) -> TrainingSize:
    """Half the size in whole photos, then windows of the full size."""
    return TrainingSize(1) if iteration <= COARSE else TrainingSize(0, WINDOW_PIXELS)


@pytest.fixture(autouse=True)
def in_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Schedule, "training_size_at", training_size_at)
    assert len(windows_of(tiny_scene.WIDTH, tiny_scene.HEIGHT, WINDOW_PIXELS)) == 4


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    tiny_scene.write_dataset(folder / "dataset", masked="flight 1/photo_5.png")
    parts = {"undistort.dataset": folder / "dataset"}
    initialize.run(InitializeConfig(dense=False), Inputs(parts, folder), folder, tiny_scene.Recorder())
    return folder


def trained(scene: Path, out: Path, config: TrainConfig, threads: int = 1) -> Path:
    out.mkdir(exist_ok=True)
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    parts |= tiny_scene.split_part(scene / "dataset", 4)
    train.run(config, Inputs(parts, scene, machine=Machine("cpu", threads)), out, tiny_scene.Recorder())
    return out


def digests(out: Path) -> list[str]:
    return [hashlib.sha256((out / part).read_bytes()).hexdigest() for part in PARTS]


def held_out_psnr(scene: Path, model: Path) -> float:
    view = next(view for view in load_views(scene / "dataset") if view.camera.name.endswith("photo_4.png"))
    gaussians = read_splat(model)
    with torch.no_grad():
        options = rasterizer.RenderOptions(sh_degree=gaussians.sh_degree)
        render = rasterizer.render(gaussians, view.camera, options).colour
    photo = torch.from_numpy(load_colour(view).astype(np.float32) / 255.0)
    return float(metrics.psnr(render.clamp(0.0, 1.0), photo))


def test_training_on_windows_approaches_the_truth_in_a_photo_it_never_saw(scene: Path, tmp_path: Path) -> None:
    out = trained(scene, tmp_path, tiny_scene.plain(iterations=400))
    before, after = held_out_psnr(scene, scene / "init.ply"), held_out_psnr(scene, out / "model.ply")
    assert after > 23.5 and after > before + 7.0


class Kill(BaseException):
    """Stands in for a kill: nothing of the trainer catches it."""


def test_killed_training_on_windows_ends_with_the_same_bits_on_any_number_of_threads(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tiny_scene.plain(iterations=60, **TECHNIQUES)
    whole = trained(scene, tmp_path / "whole", config)
    step = shortage.iterate

    def dying(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto) -> None:
        if state.iteration + 1 == 37:
            raise Kill
        step(state, plan, photo)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Kill):
        patch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(loop, "CHECKPOINT_SHARE", 1e9)
        patch.setattr(shortage, "iterate", dying)
        trained(scene, tmp_path / "killed", config)
    assert (tmp_path / "killed" / loop.CHECKPOINT).exists()
    assert digests(trained(scene, tmp_path / "killed", config, threads=3)) == digests(whole)
    assert digests(trained(scene, tmp_path / "seed", config.model_copy(update={"seed": 1}))) != digests(whole)
    monkeypatch.setattr(
        Schedule, "training_size_at", lambda schedule, iteration: TrainingSize(int(iteration <= COARSE))
    )
    assert digests(trained(scene, tmp_path / "in whole photos", config)) != digests(whole)
