"""The photos' exposures: learned where they differ, and neutral on average."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from splatpipe.pipeline import raster
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.scene.dataset import load_views
from splatpipe.pipeline.scene.ply import read_splat
from splatpipe.stages import initialize, train
from splatpipe.stages.options import InitializeConfig, TrainConfig
from splatpipe.stages.train.exposure import Exposure
from splatpipe.stages.train.exposure_grid import GridExposure, roughness_gradient

sys.path.insert(0, str(Path(__file__).parent / "scenes"))
import tiny_scene

GAINS = np.linspace(0.7, 1.0, tiny_scene.CAMERAS)  # of the photos in the arc's order: every other one is turned round
GAINS[::2] = GAINS[::2][::-1]
EVEN = 0.7  # of the light is left on average where it falls off to a side


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `dataset`, whose photos are exposed differently, and `init.ply`."""
    folder = tmp_path_factory.mktemp("scene")
    tiny_scene.write_dataset(folder / "dataset")
    for view, gain in zip(load_views(folder / "dataset"), GAINS, strict=True):
        photo = cv2.imread(str(view.image_path)).astype(np.float32)
        cv2.imwrite(str(view.image_path), np.round(photo * gain).astype(np.uint8))
    parts = {"undistort.dataset": folder / "dataset"}
    initialize.run(InitializeConfig(), Inputs(parts, folder), folder, tiny_scene.Recorder())
    return folder


def trained(scene: Path, out: Path, exposure: str) -> Path:
    out.mkdir(parents=True)
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    settings = {"evaluate.every": 0, "evaluate.views": ""}
    options: dict[str, object] = {"iterations": 400, "densify_gradient": 1e-3, "exposure": exposure}
    config = tiny_scene.plain(**options, lr_exposure=1e-2)
    train.run(config, Inputs(parts, scene, settings, Machine("cpu", 2)), out, tiny_scene.Recorder())
    return out


@pytest.fixture(scope="module")
def uneven(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, with photos that fall off to the left and to the right in turn."""
    folder = tmp_path_factory.mktemp("uneven")
    shutil.copytree(scene, folder, dirs_exist_ok=True)
    for number, view in enumerate(load_views(folder / "dataset")):
        photo = cv2.imread(str(view.image_path)).astype(np.float32)
        slope = np.linspace(-0.3, 0.3, photo.shape[1]) * (-1.0) ** number
        cv2.imwrite(str(view.image_path), np.round(photo * (EVEN + slope)[:, None]).astype(np.uint8))
    return folder


def neutral_error(scene: Path, model: Path, brightness: float = float(GAINS.mean())) -> float:
    """RMS difference of the model's renders, as they are, from the true ones at the photos' mean brightness."""
    gaussians, truth = read_splat(model), tiny_scene.true_model()
    options = raster.RenderOptions(sh_degree=3)
    errors = []
    for view in load_views(scene / "dataset"):
        with torch.no_grad():
            ours = raster.render(gaussians, view.camera, options).colour
            true = raster.render(truth, view.camera, options).colour * brightness
        errors.append(float((ours - true).square().mean()))
    return float(np.sqrt(np.mean(errors)))


def test_maps_are_the_photos_gains_and_the_splat_is_neutral(scene: Path, tmp_path: Path) -> None:
    modelled, plain = trained(scene, tmp_path / "on", "affine"), trained(scene, tmp_path / "off", "off")
    found = json.loads((modelled / "exposures.json").read_text())
    assert found["model"] == "affine"
    assert sorted(found["views"]) == [view.camera.name for view in load_views(scene / "dataset")]
    maps = np.array([found["views"][name] for name in sorted(found["views"])])
    assert np.abs(maps.mean(axis=0) - np.eye(3, 4)).max() < 1e-6
    grey = maps[:, :, :3].sum(axis=2).mean(axis=1) + 2.0 * maps[:, :, 3].mean(axis=1)  # of a grey of 0.5, relative
    assert np.corrcoef(grey, GAINS)[0, 1] > 0.95
    assert neutral_error(scene, modelled / "model.ply") < 0.8 * neutral_error(scene, plain / "model.ply")
    assert json.loads((plain / "exposures.json").read_text()) == {"model": "off", "views": {}}


def test_a_step_changes_one_photo_and_keeps_the_mean() -> None:
    exposure = Exposure(["b", "a", "c"])
    options = TrainConfig(iterations=10)
    picture = torch.full((8, 8, 3), 0.5)
    exposure.shown(picture, "b").sum().backward()
    exposure.step("b", 1, options)
    maps = {name: torch.tensor(rows) for name, rows in exposure.maps().items()}
    assert torch.allclose(sum(maps.values()) / 3.0, torch.eye(3, 4), atol=1e-6)
    assert torch.equal(maps["a"], maps["c"])
    assert bool((maps["b"] < maps["a"]).all())


def test_maps_are_drawn_to_the_identity() -> None:
    exposure = Exposure(["a", "b"])
    options = TrainConfig(iterations=1000, exposure_decay=1.0, lr_exposure=0.01)
    with torch.no_grad():
        exposure.tensors["deviations"][0] += 0.2
        exposure.tensors["deviations"][1] -= 0.2
    for iteration in range(1, 201):
        name = "ab"[iteration % 2]
        (exposure.shown(torch.zeros(8, 8, 3), name).sum() * 0.0).backward()
        exposure.step(name, iteration, options)
    assert float(exposure.tensors["deviations"].detach().abs().max()) < 0.02


def test_what_differs_by_place_is_the_grids_and_not_the_splats(uneven: Path, tmp_path: Path) -> None:
    names = [view.camera.name for view in load_views(uneven / "dataset")]
    brightness = EVEN * float(GAINS.mean())
    errors, archives = {}, {}
    for exposure in ("bilateral", "affine"):
        out = trained(uneven, tmp_path / exposure, exposure)
        errors[exposure] = neutral_error(uneven, out / "model.ply", brightness)
        with np.load(out / "exposures.npz") as archive:
            archives[exposure] = archive["grids"]
    assert errors["bilateral"] < 0.8 * errors["affine"]
    assert len(archives["affine"]) == 0
    grids = archives["bilateral"].reshape(len(names), 4, 8, 8, 3, 4)
    assert np.abs(grids.mean(axis=(0, 2, 3)) - np.eye(3, 4)).max() < 3e-6  # at each brightness
    found = json.loads((tmp_path / "bilateral/exposures.json").read_text())
    assert found["model"] == "bilateral" and list(found["views"]) == sorted(names)
    assert np.allclose(list(found["views"].values()), grids.mean(axis=(1, 2, 3)), atol=1e-6)
    grey = (grids[:, 1:3] @ [0.5, 0.5, 0.5, 1.0]).mean(axis=(1, 2, 4))  # of a grey of 0.5, (photos, places)
    rising = grey[:, 4:].mean(axis=1) > grey[:, :4].mean(axis=1)
    assert rising.tolist() == [number % 2 == 0 for number in range(len(names))]


def test_a_step_of_a_grid_changes_one_photo_and_keeps_the_mean_of_a_round() -> None:
    exposure = GridExposure(["b", "a"], side=3, levels=2)
    options = TrainConfig(iterations=10)
    before = exposure.grids()
    assert np.array_equal(before, np.broadcast_to(np.eye(3, 4, dtype=np.float32).ravel(), (2, 2, 3, 3, 12)))
    picture = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(1))
    for iteration in (1, 2):
        (exposure.shown(picture, "b") * torch.linspace(-1.0, 1.0, 8)[:, None]).sum().backward()
        exposure.step("b", iteration, options)
    deviations = exposure.tensors["deviations"].detach().view(2, 2, 9, 12)
    assert float(deviations.mean(dim=(0, 2)).abs().max()) < 1e-7
    assert float(deviations[0].var(dim=1).abs().max()) < 1e-14 < float(deviations[1].var(dim=1).max())


def test_nodes_that_no_pixel_is_near_follow_their_neighbours() -> None:
    exposure = GridExposure(["a", "b"], side=4, levels=4)
    options = TrainConfig(iterations=600, exposure_smoothness=10.0, lr_exposure=5e-3)
    dark = torch.full((16, 16, 3), 0.1)  # luminance lies between the first two levels
    for iteration in range(1, 601):
        name, gain = (("a", 0.8), ("b", 1.2))[iteration % 2]
        (exposure.shown(dark, name) - gain * dark).square().mean().backward()
        exposure.step(name, iteration, options)
    for name, gain in (("a", 0.8), ("b", 1.2)):
        assert torch.allclose(exposure.shown(dark, name), gain * dark, atol=0.01)
    white = exposure.grids()[:, 3].reshape(2, 16, 3, 4).sum(axis=(2, 3)).mean(axis=1)  # what white becomes, added up
    assert white[0] < 2.95 and white[1] > 3.05


def test_the_gradient_of_roughness_is_a_finite_difference() -> None:
    generator = torch.Generator().manual_seed(2)
    grid = torch.randn(3, 4, 2, 12, generator=generator, dtype=torch.float64)
    direction = torch.randn(3, 4, 2, 12, generator=generator, dtype=torch.float64)

    def roughness(step: float) -> float:
        moved = grid + step * direction
        return sum(float((moved.diff(dim=axis) ** 2).mean()) for axis in range(3))

    expected = (roughness(1e-3) - roughness(-1e-3)) / 2e-3
    assert float((roughness_gradient(grid) * direction).sum()) == pytest.approx(expected, rel=1e-6)
