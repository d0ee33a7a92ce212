"""train: learns a known model, respects masks, and ends bit-identical however it was run."""

import hashlib
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.photos.pixels.images import load_colour
from splatpipe.pipeline.raster import device, rasterizer
from splatpipe.pipeline.render.rendering import load_rendering
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.quality import metrics
from splatpipe.pipeline.train import iteration, loop
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan import plan as planned
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.sizing import shortage
from splatpipe.pipeline.train.state.checkpoint import load_checkpoint
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.stages import initialize, train

PARTS = ["exposures.json", "history.json", "model.ply", "plan.json", "rendering.json", "sky.npz"]
TECHNIQUES: dict[str, object] = {  # all at once, most with a state of their own
    "exposure": "affine",
    "antialias": True,
    "dropout": 0.2,
    "distortion_weight": 0.05,
    "prune_free_space": 2,
    "robust": 0.1,
    "stop_when_flat": 0.5,
}
QUICK = tiny_scene.plain(iterations=60)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `dataset` and `init.ply`."""
    folder = tmp_path_factory.mktemp("scene")
    tiny_scene.write_dataset(folder / "dataset", masked="flight 1/photo_5.png")
    parts = {"undistort.dataset": folder / "dataset"}
    initialize.run(InitializeConfig(dense=False), Inputs(parts, folder), folder, tiny_scene.Recorder())
    return folder


def make_inputs(scene: Path, threads: int = 1, device: str = "cpu", every: int = 4) -> Inputs:
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    parts |= tiny_scene.split_part(scene / "dataset", every)
    return Inputs(parts, scene, machine=Machine(device, threads))


def digest(out: Path) -> str:
    return hashlib.sha256((out / "model.ply").read_bytes() + (out / "history.json").read_bytes()).hexdigest()


def trained(scene: Path, out: Path, config: TrainConfig = QUICK, threads: int = 1) -> Path:
    out.mkdir(exist_ok=True)
    train.run(config, make_inputs(scene, threads), out, tiny_scene.Recorder())
    return out


@pytest.fixture(scope="module")
def undisturbed(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(scene, tmp_path_factory.mktemp("undisturbed"))


def held_out_psnr(scene: Path, model: Path) -> float:
    view = next(view for view in load_views(scene / "dataset") if view.camera.name.endswith("photo_4.png"))
    gaussians = read_splat(model)
    with torch.no_grad():
        options = rasterizer.RenderOptions(sh_degree=gaussians.sh_degree)
        render = rasterizer.render(gaussians, view.camera, options).colour
    photo = torch.from_numpy(load_colour(view).astype(np.float32) / 255.0)
    return float(metrics.psnr(render.clamp(0.0, 1.0), photo))


def test_training_approaches_the_truth_in_a_photo_it_never_saw(scene: Path, tmp_path: Path) -> None:
    config = tiny_scene.plain(iterations=400)
    recorder = tiny_scene.Recorder()
    summary = train.run(config, make_inputs(scene), tmp_path, recorder)
    before, after = held_out_psnr(scene, scene / "init.ply"), held_out_psnr(scene, tmp_path / "model.ply")
    assert after > 24.5 and after > before + 8.0
    assert summary["gaussians"] == len(read_splat(tmp_path / "model.ply"))
    assert recorder.steps[-1] == (400, 400)
    curve = json.loads((tmp_path / "history.json").read_text())["curve"]
    assert curve[-1]["iteration"] == 400 and curve[-1]["loss"] < 0.5 * curve[0]["loss"]


def test_any_number_of_threads_gives_the_same_splat(scene: Path, tmp_path: Path) -> None:
    config = QUICK.model_copy(update={"iterations": 200, "coarse_levels": 1})
    splats = {threads: trained(scene, tmp_path / str(threads), config, threads) for threads in (1, 2, 5)}
    assert len({hashlib.sha256((out / "model.ply").read_bytes()).hexdigest() for out in splats.values()}) == 1
    assert len({digest(out) for out in splats.values()}) == 1


def test_another_folder_gives_the_same_bits_and_another_seed_does_not(
    scene: Path, undisturbed: Path, tmp_path: Path
) -> None:
    assert digest(trained(scene, tmp_path / "here")) == digest(undisturbed)
    assert (tmp_path / "here/plan.json").read_bytes() == (undisturbed / "plan.json").read_bytes()
    assert digest(trained(scene, tmp_path / "seed", QUICK.model_copy(update={"seed": 1}))) != digest(undisturbed)
    assert sorted(path.name for path in undisturbed.iterdir()) == PARTS


class Kill(BaseException):
    """Stands in for a kill: nothing of the trainer catches it."""


def die_at(monkeypatch: pytest.MonkeyPatch, iteration: int, how: Callable[[], None]) -> None:
    """Run ``how`` in the middle of an iteration, with a checkpoint after every earlier one."""
    step = shortage.iterate

    def dying(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto) -> None:
        if state.iteration + 1 == iteration:
            how()
        step(state, plan, photo)

    monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(loop, "CHECKPOINT_SHARE", 1e9)
    monkeypatch.setattr(shortage, "iterate", dying)


def killed() -> None:
    raise Kill


@pytest.mark.parametrize("when", [1, 2, 11, 26, 35, 60])
def test_killed_training_resumes_and_ends_with_the_same_bits(
    scene: Path, undisturbed: Path, tmp_path: Path, when: int
) -> None:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Kill):
        die_at(patch, when, killed)
        trained(scene, tmp_path)
    assert (tmp_path / loop.CHECKPOINT).exists() == (when > 1)
    assert load_rendering(tmp_path / "rendering.json").antialias == QUICK.antialias  # before the first iteration, too
    recorder = tiny_scene.Recorder()
    train.run(QUICK, make_inputs(scene, threads=2), tmp_path, recorder)
    assert not recorder.warnings
    assert digest(tmp_path) == digest(undisturbed)


def test_killed_training_with_every_technique_ends_with_the_same_bits(scene: Path, tmp_path: Path) -> None:
    config = QUICK.model_copy(update=TECHNIQUES)
    whole = trained(scene, tmp_path / "whole", config)
    for name, value in TECHNIQUES.items():
        assert getattr(tiny_scene.plain(), name) != value
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Kill):
        die_at(patch, 34, killed)
        trained(scene, tmp_path / "killed", config)
    assert digest(trained(scene, tmp_path / "killed", config, threads=2)) == digest(whole)
    for part in PARTS:
        assert (tmp_path / "killed" / part).read_bytes() == (whole / part).read_bytes()


def test_killed_training_by_the_published_method_ends_with_the_same_bits(
    scene: Path, undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = {"first": 10, "last": 60, "every": 10, "reset_every": 25, "gradient": 1e-6}
    monkeypatch.setattr(planned, "resolve_schedule", tiny_scene.resolver(**limits))
    config = QUICK.model_copy(update={"density": "published"})
    whole = trained(scene, tmp_path / "whole", config)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Kill):
        die_at(patch, 38, killed)
        trained(scene, tmp_path / "killed", config)
    assert digest(trained(scene, tmp_path / "killed", config, threads=2)) == digest(whole) != digest(undisturbed)
    history = json.loads((whole / "history.json").read_text())
    assert history["resets"] == [25, 50]
    assert sum(event["cloned"] + event["split"] for event in history["density"]) > 0


def test_interrupt_saves_a_checkpoint_and_is_passed_on(scene: Path, undisturbed: Path, tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        die_at(patch, 20, lambda: os.kill(os.getpid(), signal.SIGTERM))
        patch.setattr(loop, "CHECKPOINT_SECONDS", 1e9)
        trained(scene, tmp_path)
    assert signal.getsignal(signal.SIGTERM) == before
    plan = TrainingPlan.from_json((tmp_path / "plan.json").read_text())
    assert load_checkpoint(tmp_path / loop.CHECKPOINT, plan.digest()).facts["iteration"] == 20
    assert digest(trained(scene, tmp_path)) == digest(undisturbed)


def test_resuming_with_another_instruction_set_is_reported(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Kill):
        die_at(patch, 20, killed)
        trained(scene, tmp_path)
    monkeypatch.setattr(device, "isa_name", lambda: "other")
    recorder = tiny_scene.Recorder()
    train.run(QUICK, make_inputs(scene), tmp_path, recorder)
    assert len(recorder.warnings) == 1 and "resumes on other" in recorder.warnings[0]


def test_broken_checkpoint_is_reported_and_ignored(scene: Path, undisturbed: Path, tmp_path: Path) -> None:
    (tmp_path / loop.CHECKPOINT).write_bytes(b"half a checkpoint")
    recorder = tiny_scene.Recorder()
    train.run(QUICK, make_inputs(scene), tmp_path, recorder)
    assert len(recorder.warnings) == 1 and "checkpoint" in recorder.warnings[0]
    assert digest(tmp_path) == digest(undisturbed)


def test_masked_pixels_are_not_learnt(scene: Path, tmp_path: Path) -> None:
    config = tiny_scene.plain(iterations=200, densify=False)
    gaussians = read_splat(trained(scene, tmp_path, config) / "model.ply")
    view = next(view for view in load_views(scene / "dataset") if view.mask_path is not None)
    render = tiny_scene.photograph(gaussians, view.camera)[:, : tiny_scene.WIDTH // 2].astype(float)
    truth = tiny_scene.photograph(tiny_scene.true_model(), view.camera)[:, : tiny_scene.WIDTH // 2].astype(float)
    assert np.abs(render - truth).mean() < 20.0  # the magenta under the mask is 100 away
    assert np.abs(render - [255.0, 0.0, 255.0]).mean() > 60.0


def test_cap_holds_and_is_reported(scene: Path, tmp_path: Path) -> None:
    config = QUICK.model_copy(update={"max_gaussians": 160})
    assert len(read_splat(trained(scene, tmp_path, config) / "model.ply")) <= 160
    events = json.loads((tmp_path / "history.json").read_text())["density"]
    assert max(event["gaussians"] for event in events) <= 160
    assert sum(event["held_back"] for event in events) > 0


def test_fewer_gaussians_than_points_may_be_requested(scene: Path, tmp_path: Path) -> None:
    config = QUICK.model_copy(update={"max_gaussians": 20, "sh_degree": 1})
    gaussians = read_splat(trained(scene, tmp_path, config) / "model.ply")
    assert 0 < len(gaussians) <= 20 and gaussians.sh_degree == 1


@pytest.mark.parametrize(
    "options",
    [
        {"coarse_levels": 2},
        {"background": "random"},
        {"background": "white"},
        {"antialias": True},
        {"loss": "kornia", "iterations": 20},
    ],
)
def test_options_train_to_a_finite_model_and_repeat(
    scene: Path, undisturbed: Path, tmp_path: Path, options: dict[str, object]
) -> None:
    config = QUICK.model_copy(update=options)
    first = trained(scene, tmp_path / "a", config)
    assert bool(read_splat(first / "model.ply").finite().all())
    assert digest(first) == digest(trained(scene, tmp_path / "b", config))
    assert digest(first) != digest(undisturbed)


def test_gradients_that_are_not_finite_skip_that_gaussian_and_are_counted(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loss = iteration.photo_loss

    def poisoned(render: torch.Tensor, *rest: object) -> torch.Tensor:
        return loss(render, *rest) + 0.0 * torch.sqrt(render[0, 0, 0] - render[0, 0, 0].detach())

    monkeypatch.setattr(iteration, "photo_loss", poisoned)
    gaussians = read_splat(trained(scene, tmp_path) / "model.ply")
    assert bool(gaussians.finite().all())
    assert json.loads((tmp_path / "history.json").read_text())["skipped_gradients"] > 0


def test_missing_device_is_reported(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(MachineError, match="CUDA"):
        train.run(QUICK, make_inputs(scene, device="cuda"), tmp_path, tiny_scene.Recorder())


def test_photos_of_the_wrong_size_or_broken_are_named(scene: Path, tmp_path: Path) -> None:
    dataset = tmp_path / "dataset"
    tiny_scene.write_dataset(dataset)
    victim = dataset / "images/flight 1/photo_1.png"
    for content in (b"", b"not a picture"):
        victim.write_bytes(content)
        parts = {"undistort.dataset": dataset, "initialize.splat": scene / "init.ply"} | tiny_scene.split_part(
            dataset, 4
        )
        with pytest.raises(SplatpipeError, match=r"photo_1\.png"):
            train.run(QUICK, Inputs(parts, tmp_path), tmp_path, tiny_scene.Recorder())
