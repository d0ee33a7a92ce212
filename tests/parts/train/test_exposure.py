"""The photos' exposures: learned where they differ, and neutral on average."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.train.appearance import brightness
from splatpipe.pipeline.train.appearance.brightness import DIFFERING, decided_exposure, exposure_spread, log_gains
from splatpipe.pipeline.train.appearance.exposure import Exposure
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.techniques import techniques
from splatpipe.stages import initialize, train

GAINS = np.linspace(0.7, 1.0, tiny_scene.CAMERAS)  # by photo, in the arc's order: every other one is turned round
GAINS[::2] = GAINS[::2][::-1]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `dataset`, whose photos are exposed differently, and `init.ply`."""
    folder = tmp_path_factory.mktemp("scene")
    tiny_scene.write_dataset(folder / "dataset")
    for view, gain in zip(load_views(folder / "dataset"), GAINS, strict=True):
        photo = cv2.imread(str(view.image_path)).astype(np.float32)
        cv2.imwrite(str(view.image_path), np.round(photo * gain).astype(np.uint8))
    parts = {"undistort.dataset": folder / "dataset"}
    initialize.run(InitializeConfig(dense=False), Inputs(parts, folder), folder, tiny_scene.Recorder())
    return folder


def test_gains_are_the_photos_true_ones_despite_texture_and_a_few_highlights() -> None:
    random = np.random.default_rng(3)
    true = random.normal(scale=0.1, size=(7, 3))
    photo, point = (grid.ravel() for grid in np.meshgrid(np.arange(7), np.arange(80), indexing="ij"))
    seen = random.random(photo.size) < 0.6
    photo, point = photo[seen], point[seen]
    logs = random.normal(scale=0.5, size=(80, 3))[point] + true[photo] + random.normal(scale=0.02, size=(len(point), 3))
    logs[random.random(len(logs)) < 0.05] += 0.7
    found = log_gains(photo, point, logs, 7)
    np.testing.assert_allclose(found, true - true.mean(axis=0), atol=0.025)


def test_photos_without_common_points_give_no_gains() -> None:
    photo, point = np.repeat([0, 1], 30), np.arange(60)
    assert log_gains(photo, point, np.random.default_rng(4).normal(size=(60, 3)), 3).shape == (0, 3)


def test_exposures_are_modelled_if_they_differ_unless_set_otherwise(scene: Path, tmp_path: Path) -> None:
    differing, alike = scene / "dataset", tiny_scene.write_dataset(tmp_path / "dataset")
    for asked, dataset, expected in (("auto", differing, "affine"), ("auto", alike, "off"), ("off", differing, "off")):
        recorder = tiny_scene.Recorder()
        found = decided_exposure(TrainConfig(exposure=asked), load_views(dataset), dataset, 1, recorder)
        assert found.exposure == expected
        assert [note[:9] for note in recorder.notes] == (["exposures"] if expected == "affine" else [])


def test_a_written_plan_is_final_and_no_photo_is_measured_again(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    inputs = Inputs(parts | tiny_scene.split_part(scene / "dataset"), scene, machine=Machine("cpu", 1))
    config = tiny_scene.plain(iterations=5, exposure="auto")
    train.run(config, inputs, tmp_path, tiny_scene.Recorder())
    before = (tmp_path / "model.ply").read_bytes()
    monkeypatch.setattr(brightness, "exposure_spread", None)  # measuring again would fail the test
    train.run(config, inputs, tmp_path, tiny_scene.Recorder())
    assert (tmp_path / "model.ply").read_bytes() == before
    assert json.loads((tmp_path / "exposures.json").read_text())["model"] == "affine"


def test_spread_of_photos_that_were_exposed_differently_is_measured(scene: Path, tmp_path: Path) -> None:
    dataset = scene / "dataset"
    spread = exposure_spread(load_views(dataset), dataset, 2)
    assert abs(spread - float(np.std(np.log(GAINS)))) < 0.02 and spread > DIFFERING
    alike = tiny_scene.write_dataset(tmp_path / "dataset")
    assert exposure_spread(load_views(alike), alike, 1) < DIFFERING


def trained(scene: Path, out: Path, exposure: str) -> Path:
    out.mkdir(parents=True)
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    parts |= tiny_scene.split_part(scene / "dataset")
    config = tiny_scene.plain(iterations=400, exposure=exposure)
    with pytest.MonkeyPatch.context() as patch:  # too few visits for the exposures to be learnt at their rate
        patch.setattr(techniques, "Exposure", partial(Exposure, first_rate=1e-2))
        train.run(config, Inputs(parts, scene, machine=Machine("cpu", 2)), out, tiny_scene.Recorder())
    return out


def neutral_error(scene: Path, model: Path) -> float:
    """RMS difference of the model's renders, as they are, from the true ones at the photos' mean brightness."""
    gaussians, truth = read_splat(model), tiny_scene.true_model()
    options = rasterizer.RenderOptions(sh_degree=3)
    errors = []
    for view in load_views(scene / "dataset"):
        with torch.no_grad():
            ours = rasterizer.render(gaussians, view.camera, options).colour
            true = rasterizer.render(truth, view.camera, options).colour * float(GAINS.mean())
        errors.append(float((ours - true).square().mean()))
    return float(np.sqrt(np.mean(errors)))


def test_maps_are_the_photos_gains_and_the_splat_is_neutral(scene: Path, tmp_path: Path) -> None:
    modelled, plain = trained(scene, tmp_path / "on", "affine"), trained(scene, tmp_path / "off", "off")
    found = json.loads((modelled / "exposures.json").read_text())
    assert found["model"] == "affine"
    assert sorted(found["views"]) == [view.camera.name for view in load_views(scene / "dataset")]
    maps = np.array([found["views"][name] for name in sorted(found["views"])])
    assert np.abs(maps.mean(axis=0) - np.eye(3, 4)).max() < 1e-6
    grey = maps[:, :, :3].sum(axis=2).mean(axis=1) + 2.0 * maps[:, :, 3].mean(axis=1)  # relative to a grey of 0.5
    assert np.corrcoef(grey, GAINS)[0, 1] > 0.95
    assert neutral_error(scene, modelled / "model.ply") < 0.8 * neutral_error(scene, plain / "model.ply")
    assert json.loads((plain / "exposures.json").read_text()) == {"model": "off", "views": {}}


def test_a_step_changes_one_photo_and_keeps_the_mean() -> None:
    exposure = Exposure(["b", "a", "c"])
    picture = torch.full((8, 8, 3), 0.5)
    exposure.applied(picture, "b").sum().backward()
    exposure.step("b", 0.1)
    maps = {name: torch.tensor(rows) for name, rows in exposure.maps().items()}
    assert torch.allclose(sum(maps.values()) / 3.0, torch.eye(3, 4), atol=1e-6)
    assert torch.equal(maps["a"], maps["c"])
    assert bool((maps["b"] < maps["a"]).all())


def test_maps_are_pulled_towards_the_identity() -> None:
    exposure = Exposure(["a", "b"], first_rate=0.01, decay=1.0)
    with torch.no_grad():
        exposure.tensors["deviations"][0] += 0.2
        exposure.tensors["deviations"][1] -= 0.2
    for iteration in range(1, 201):
        name = "ab"[iteration % 2]
        (exposure.applied(torch.zeros(8, 8, 3), name).sum() * 0.0).backward()
        exposure.step(name, iteration / 1000)
    assert float(exposure.tensors["deviations"].detach().abs().max()) < 0.02
