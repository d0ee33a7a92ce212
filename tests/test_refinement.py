"""The cameras' refinement: what SfM left is found, nothing moves together, no one moves far, and the drift is told."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from splatpipe.pipeline.engine.stage import Inputs, Machine, Summary
from splatpipe.pipeline.scene.camera import Camera
from splatpipe.pipeline.scene.dataset import load_views
from splatpipe.stages import initialize, train
from splatpipe.stages.options import InitializeConfig, TrainConfig
from splatpipe.stages.train.plan import Plan, make_plan
from splatpipe.stages.train.refinement import LIMIT_PX, CameraRefinement, anchor_of, image_shift_px
from splatpipe.stages.train.stream import TrainingPhoto

sys.path.insert(0, str(Path(__file__).parent / "scenes"))
import tiny_scene

ERROR_PX = 0.6  # of each camera's turns about its three axes, standard deviation
DISTANCE = 4.0  # of the cameras from the scene


def perturbed(cameras: list[Camera]) -> list[Camera]:
    """Turned by chance; focal lengths and centres are right."""
    random = np.random.default_rng(8)
    found = []
    for camera in cameras:
        motion = np.zeros(7)
        motion[:3] = random.normal(scale=ERROR_PX / tiny_scene.FOCAL, size=3)
        found.append(camera.moved(motion))
    return found


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `dataset`, whose poses are wrong by a fraction of a pixel, and `init.ply`."""
    folder = tmp_path_factory.mktemp("scene")
    tiny_scene.write_dataset(folder / "true")
    folder.joinpath("dataset").mkdir()
    folder.joinpath("true/images").rename(folder / "dataset/images")
    random = np.random.default_rng(3)
    points = tiny_scene.true_model().means.numpy().astype(np.float64)
    points += random.normal(scale=tiny_scene.POINT_NOISE, size=points.shape)
    rgb = np.full((len(points), 3), 128, np.uint8)
    tiny_scene.write_model(folder / "dataset/sparse/0", perturbed(tiny_scene.cameras()), points, rgb)
    parts = {"undistort.dataset": folder / "dataset"}
    initialize.run(InitializeConfig(opacity=0.1), Inputs(parts, folder), folder, tiny_scene.Recorder())
    return folder


def trained(scene: Path, out: Path, **options: object) -> tuple[Summary, dict[str, object]]:
    out.mkdir(exist_ok=True)
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    settings = {"evaluate.every": 0, "evaluate.views": ""}
    config = tiny_scene.plain(**{"iterations": 400, "densify": False} | options)
    summary = train.run(config, Inputs(parts, scene, settings, Machine("cpu", 1)), out, tiny_scene.Recorder())
    return summary, json.loads((out / "cameras_refined.json").read_text())


def twist(after: Camera, before: Camera) -> np.ndarray:
    """The small motion that makes one camera of another, linear in its rotation."""
    change = after.cam_from_world @ np.linalg.inv(before.cam_from_world)
    skew = 0.5 * (change[:3, :3] - change[:3, :3].T)
    return np.concatenate([[skew[2, 1], skew[0, 2], skew[1, 0]], change[:3, 3]])


def together(camera: Camera) -> np.ndarray:
    """(6, 7): the camera's motion when the world with all cameras is turned, shifted and scaled about the origin."""
    step, columns = 1e-6, []
    for axis in range(7):
        change = np.zeros(7)
        change[axis] = step
        world = np.eye(4)
        world[:3, :3] = cv2.Rodrigues(change[:3])[0]
        world[:3, 3] = change[3:6]
        pose = camera.cam_from_world @ world
        centre = (1.0 + change[6]) * replace(camera, cam_from_world=pose).centre()
        pose[:3, 3] = -pose[:3, :3] @ centre
        columns.append(twist(replace(camera, cam_from_world=pose), camera) / step)
    return np.array(columns).T


def common_motion(motions: np.ndarray, cameras: list[Camera], pixels: np.ndarray) -> np.ndarray:
    """The part of the cameras' motions (n, 6) that a similarity of the world explains best, by least squares.

    Args:
        motions: Of the cameras, in their own frames.
        cameras: Before them.
        pixels: (n, 6) What a motion of 1 moves a picture by.
    """
    matrix = (np.stack([together(camera) for camera in cameras]) * pixels[:, :, None]).reshape(-1, 7)
    fit = np.linalg.lstsq(matrix, (motions * pixels).ravel(), rcond=None)[0]
    return (matrix @ fit).reshape(-1, 6) / pixels


def pixels_of_motion() -> np.ndarray:
    focal, radius = tiny_scene.FOCAL, np.hypot(tiny_scene.WIDTH, tiny_scene.HEIGHT) / np.sqrt(12.0)
    rows = [focal, focal, radius, focal / DISTANCE, focal / DISTANCE, radius / DISTANCE]
    return np.tile(rows, (tiny_scene.CAMERAS, 1))


def errors_px(cameras: list[Camera]) -> np.ndarray:
    """How far each picture is from the true one, once the cameras together have been fitted to the true ones."""
    motions = np.array([twist(true, camera) for camera, true in zip(cameras, tiny_scene.cameras(), strict=True)])
    left = motions - common_motion(motions, cameras, pixels_of_motion())
    return np.array([image_shift_px(c, np.append(m, 0.0), DISTANCE) for c, m in zip(cameras, left, strict=True)])


def placed(cameras: list[Camera], facts: dict[str, object]) -> list[Camera]:
    """The cameras as a training found them."""
    found = []
    for camera in cameras:
        pose = np.eye(4)
        pose[:3] = facts["photos"][camera.name]["cam_from_world"]  # type: ignore[index]
        found.append(replace(camera, cam_from_world=pose))
    return found


def test_poses_go_back_to_the_truth_and_the_drift_is_told(scene: Path, tmp_path: Path) -> None:
    wrong = perturbed(tiny_scene.cameras())
    plain, off = trained(scene, tmp_path / "off")
    summary, found = trained(scene, tmp_path / "on", refine_cameras="pose")
    better = placed(wrong, found)
    assert errors_px(better).mean() < 0.4 * errors_px(wrong).mean()
    assert summary["loss"] < 0.8 * plain["loss"]
    assert off == {"model": "off", "photos": {}} and "camera_shift_max_px" not in plain
    assert found["model"] == "pose"
    shifts = []
    for before, after in zip(wrong, better, strict=True):
        photo = found["photos"][before.name]
        motion = twist(after, before)
        assert photo["rotation_deg"] == pytest.approx(np.degrees(np.linalg.norm(motion[:3])), rel=1e-3)
        assert photo["translation"] == pytest.approx(np.linalg.norm(after.centre() - before.centre()), rel=1e-6)
        assert photo["focal_factor"] == 1.0
        points = tiny_scene.true_model().means.double().numpy()
        mean = np.linalg.norm(after.project(points) - before.project(points), axis=1).mean()
        assert photo["shift_px"] == pytest.approx(mean, rel=0.2)  # at other depths than the median
        shifts.append(photo["shift_px"])
    assert summary["camera_shift_median_px"] == found["camera_shift_median_px"] == round(np.median(shifts), 3)
    assert summary["camera_shift_max_px"] == found["camera_shift_max_px"] == round(max(shifts), 3)


def test_cameras_do_not_move_together(scene: Path, tmp_path: Path) -> None:
    before = perturbed(tiny_scene.cameras())
    after = placed(before, trained(scene, tmp_path, refine_cameras="pose", iterations=200)[1])
    motions = np.array([twist(a, b) for a, b in zip(after, before, strict=True)])
    common = common_motion(motions, before, anchored(scene)[1][:, :6])
    assert np.abs(motions).max() > 1e-3
    assert np.abs(common).max() < 0.01 * np.abs(motions).max()  # what is left is of second order


def anchored(scene: Path) -> tuple[CameraRefinement, np.ndarray]:
    """A refinement of the scene's cameras that has not begun, and pixels of each one's motion of 1."""
    views = load_views(scene / "dataset")
    plan = plan_of(scene)
    refinement = CameraRefinement(plan.train_views)
    refinement.anchor = anchor_of(plan, views, scene / "dataset")
    return refinement, 1.0 / refinement.anchor.units


def plan_of(scene: Path) -> Plan:
    return make_plan(TrainConfig(iterations=100), load_views(scene / "dataset"), 0, "", 100)


def pushed(refinement: CameraRefinement, name: str, gradient: torch.Tensor, options: TrainConfig) -> None:
    """A step of a photo's camera against a gradient."""
    assert refinement.anchor is not None
    camera = next(camera for camera in refinement.anchor.cameras if camera.name == name)
    photo = TrainingPhoto(camera, torch.zeros(camera.height, camera.width, 3), None)
    photo = refinement.refined(photo, options.iterations, options)
    assert photo.camera_probe is not None
    photo.camera_probe.grad = gradient
    refinement.step(photo, options.iterations // 2, options)


@pytest.mark.parametrize("model", ["pose", "pose_focal"])
def test_no_camera_goes_beyond_the_limit_however_long_it_is_pushed(scene: Path, model: str) -> None:
    refinement, pixels = anchored(scene)
    options = TrainConfig(iterations=100, refine_cameras=model, lr_cameras=0.5)
    names = [camera.name for camera in refinement.anchor.cameras]  # type: ignore[union-attr]
    generator = torch.Generator().manual_seed(2)
    directions = torch.randn(len(names), 7, generator=generator)
    for _ in range(40):
        for name, direction in zip(names, directions, strict=True):
            pushed(refinement, name, direction, options)
    motions = np.stack([refinement.motion_of(name) for name in names])
    lengths = np.linalg.norm(motions * pixels, axis=1)
    assert 0.9 * LIMIT_PX < lengths.max() < LIMIT_PX * (1.0 + 1e-5)
    common = common_motion(motions[:, :6], list(refinement.anchor.cameras), pixels[:, :6])  # type: ignore[union-attr]
    assert np.abs(common * pixels[:, :6]).max() < 1e-4
    assert np.ptp(motions[:, 6]) < 1e-6  # they share their intrinsics
    assert (np.abs(motions[:, 6]).max() > 1e-4) == (model == "pose_focal")


def test_nothing_moves_at_first_and_what_moved_is_drawn_back(scene: Path) -> None:
    refinement, pixels = anchored(scene)
    options = TrainConfig(iterations=100, refine_cameras="pose")
    camera = refinement.anchor.cameras[4]  # type: ignore[union-attr]
    photo = TrainingPhoto(camera, torch.zeros(camera.height, camera.width, 3), None)
    assert refinement.refined(photo, 20, options) is photo
    with torch.no_grad():
        refinement.tensors["shifts"][4, 2] = 1.0
    for _ in range(200):
        pushed(refinement, camera.name, torch.zeros(7), options)
    assert np.linalg.norm(refinement.motion_of(camera.name) * pixels[4]) < 0.1


def test_a_gradient_that_is_not_finite_moves_no_camera(scene: Path) -> None:
    refinement, _ = anchored(scene)
    options = TrainConfig(iterations=100, refine_cameras="pose")
    name = refinement.anchor.cameras[0].name  # type: ignore[union-attr]
    pushed(refinement, name, torch.full((7,), float("nan")), options)
    assert not any(refinement.motion_of(camera.name).any() for camera in refinement.anchor.cameras)  # type: ignore[union-attr]


def test_a_wrong_focal_length_moves_towards_the_true_one(scene: Path, tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    shutil.copytree(scene / "dataset/images", folder / "dataset/images")
    shutil.copy(scene / "init.ply", folder)
    points = tiny_scene.true_model().means.numpy().astype(np.float64)
    wrong = [camera.moved(np.array([0, 0, 0, 0, 0, 0, np.log(1.02)])) for camera in tiny_scene.cameras()]
    tiny_scene.write_model(folder / "dataset/sparse/0", wrong, points, np.full((len(points), 3), 128, np.uint8))
    found = trained(folder, tmp_path / "on", refine_cameras="pose_focal", lr_cameras=0.2)[1]
    factors = {photo["focal_factor"] for photo in found["photos"].values()}
    assert len(factors) == 1
    assert abs(np.log(1.02 * factors.pop())) < 0.7 * np.log(1.02)  # the scene's depth can take up the rest


def test_the_training_has_the_same_bits_for_any_number_of_threads(scene: Path, tmp_path: Path) -> None:
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    config = TrainConfig(iterations=50, refine_cameras="pose_focal")
    left = set()
    for threads in (1, 2):
        out = tmp_path / str(threads)
        out.mkdir()
        inputs = Inputs(parts, scene, {"evaluate.every": 4, "evaluate.views": ""}, Machine("cpu", threads))
        train.run(config, inputs, out, tiny_scene.Recorder())
        left.add((out / "model.ply").read_bytes() + (out / "cameras_refined.json").read_bytes())
    assert len(left) == 1


def test_two_photos_keep_what_their_relative_orientation_is(tmp_path: Path) -> None:
    dataset = tiny_scene.write_dataset(tmp_path / "dataset", views=tiny_scene.cameras()[::8])
    views = load_views(dataset)
    plan = make_plan(TrainConfig(iterations=100), views, 0, "", 100)
    refinement = CameraRefinement(plan.train_views)
    refinement.anchor = anchor_of(plan, views, dataset)
    assert len(refinement.anchor.gauge) == 7  # of 12
    options = TrainConfig(iterations=100, refine_cameras="pose")
    pushed(refinement, views[0].camera.name, torch.tensor([1.0, -2.0, 0.5, 0.3, -0.4, 0.2, 0.0]), options)
    motions = np.array([refinement.motion_of(view.camera.name) for view in views])
    assert np.abs(motions).max() > 1e-4
    common = common_motion(motions[:, :6], [view.camera for view in views], 1.0 / refinement.anchor.units[:, :6])
    assert np.abs(common).max() < 1e-3 * np.abs(motions).max()
