"""The demo capture against its truth: camera positions, sparse points, and the splat's depths."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from demo_truth import ATTACHED_M, depth_errors
from finished_run import linked_copy
from jaxtyping import Float64
from opened_run import OpenedRun, open_run
from path_frames import measure_path, summary
from rays import first_hits
from repository import benchmark

from splatpipe.demo import CAPTURE, capture_path
from splatpipe.demo.site.scene import building_corners
from splatpipe.demo.truth.truth import Poses, centre, depth_map, true_poses, true_surface, truth_from_model
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.photos.pixels.dataset import load_points_and_tracks, load_views
from splatpipe.pipeline.raster.rasterizer import RenderOptions, render
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.quality.free_space import free_space, near_or_free


@pytest.fixture(scope="module")
def out(demo_run: Path, demo_options: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's run, placed by the photos' positions alone, up to its short training."""
    folder = linked_copy(demo_run, tmp_path_factory.mktemp("truth") / "out")
    options = [*demo_options, "--set", "georef.control=none", "--until", "train"]
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "run", capture_path(), folder, *options]
    subprocess.run(command, check=True)
    return folder


@pytest.fixture(scope="module")
def poses() -> Poses:
    return true_poses()


@pytest.fixture(scope="module")
def surface() -> Float64[np.ndarray, "m 3 3"]:
    return true_surface()


@pytest.fixture(scope="module")
def model(out: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(next((out / "stages").glob("georef-*")) / "sparse" / "0")


@pytest.fixture(scope="module")
def aligned(model: pycolmap.Reconstruction, poses: Poses) -> Similarity:
    """Truth from model."""
    images = [image for image in model.images.values() if image.has_pose]
    assert len(images) == len(poses)
    return truth_from_model(
        {image.name: np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]]) for image in images}
    )


@pytest.fixture(scope="module")
def opened(out: Path) -> OpenedRun:
    return open_run(out)


def test_camera_centres_are_within_a_thousandth_of_the_site(
    model: pycolmap.Reconstruction, poses: Poses, aligned: Similarity
) -> None:
    true = {name: centre(pose) for name, pose in poses.items()}
    errors = [aligned.apply(image.projection_center()[None])[0] - true[image.name] for image in model.images.values()]
    diagonal = np.linalg.norm(np.ptp(np.array(list(true.values())), axis=0))
    assert np.sqrt(np.square(errors).sum(axis=1).mean()) < 0.001 * diagonal


def test_the_frame_is_as_good_as_the_positions_allow(out: Path, model: pycolmap.Reconstruction, poses: Poses) -> None:
    """40 positions of 1.5 m (an axis) and 3 m (up) have a mean within 0.24 m and 0.47 m; here twice that."""
    frame = json.loads((next((out / "stages").glob("georef-*")) / "frame.json").read_text())
    assert frame["kind"] == "enu"
    origin = json.loads((CAPTURE / "truth.json").read_text())["frame"]["origin"]
    ours, theirs = (
        [place[key] for key in ("latitude", "longitude", "height_m")] for place in (frame["origin"], origin)
    )
    shift = np.asarray(pycolmap.GPSTransform().ellipsoid_to_enu([ours], *theirs))
    world_from_model = np.array(frame["world_from_model"])
    offsets = np.array(
        [
            (world_from_model @ np.append(image.projection_center(), 1.0))[:3] + shift[0] - centre(poses[image.name])
            for image in model.images.values()
        ]
    ).mean(axis=0)
    assert np.hypot(*offsets[:2]) < 0.7
    assert abs(offsets[2]) < 1.0


def test_sparse_points_lie_on_the_surface(
    model: pycolmap.Reconstruction,
    poses: Poses,
    aligned: Similarity,
    surface: Float64[np.ndarray, "m 3 3"],
) -> None:
    gaps = []
    for image in list(model.images.values())[::8]:
        origin = centre(poses[image.name])
        ids = [point.point3D_id for point in image.points2D if point.has_point3D()][::20]
        points = aligned.apply(np.array([model.points3D[i].xyz for i in ids]))
        ahead = points - origin
        distance = np.linalg.norm(ahead, axis=1)
        hits = first_hits(origin, ahead / distance[:, None], surface)
        gaps.append(np.abs(distance - hits) / hits)
    assert np.median(np.concatenate(gaps)) < 0.002
    assert np.mean(np.concatenate(gaps) < 0.01) > 0.8


def test_rendered_depth_is_the_true_depth(
    out: Path,
    poses: Poses,
    aligned: Similarity,
    surface: Float64[np.ndarray, "m 3 3"],
) -> None:
    """The median depth of held-out views, after a short training, against rays into the true surface."""
    stages = out / "stages"
    views = load_views(next(stages.glob("undistort-*")) / "dataset")
    splat = read_splat(next(stages.glob("train-*")) / "model.ply")
    extent = np.linalg.norm(np.ptp([view.camera.centre() for view in views], axis=0))
    options = RenderOptions(sh_degree=splat.sh_degree, near=0.01 * float(extent))
    errors = []
    for view in views[::16]:
        camera = view.camera
        depth = render(splat, camera, options).median_depth.numpy() * aligned.scale
        top, left = camera.height // 4, camera.width // 4
        rows, columns = np.mgrid[top : camera.height - top : 9, left : camera.width - left : 9]
        seen = depth[rows, columns].ravel()
        x, y = (columns.ravel() + 0.5 - camera.cx) / camera.fx, (rows.ravel() + 0.5 - camera.cy) / camera.fy
        rays = np.stack([x, y, np.ones(rows.size)], axis=1)
        pose = poses[camera.name]
        directions = rays @ pose[:3, :3]  # x_world = Rᵀ x_cam; a unit along z, so that hits are depths
        true = first_hits(centre(pose), directions, surface)
        errors.append(np.abs(seen - true)[seen > 0] / true[seen > 0])
    assert np.median(np.concatenate(errors)) < 0.02


def test_no_true_surface_is_called_free_and_most_of_the_air_is(
    out: Path, poses: Poses, aligned: Similarity, surface: Float64[np.ndarray, "m 3 3"]
) -> None:
    """Tiny Gaussians on what the photos' rays hit, and at 0.2 to 0.8 of the way there."""
    dataset = next((out / "stages").glob("undistort-*")) / "dataset"
    cameras = [view.camera for view in load_views(dataset)]
    points, tracks = load_points_and_tracks(dataset)
    space = free_space(cameras, points.xyz, [tracks[camera.name] for camera in cameras])
    generator = np.random.default_rng(2)
    called: dict[str, list[np.ndarray]] = {"surface": [], "air": []}
    for camera in cameras[::5]:
        rows, columns = np.mgrid[4 : camera.height : 9, 4 : camera.width : 9]
        x, y = (columns.ravel() + 0.5 - camera.cx) / camera.fx, (rows.ravel() + 0.5 - camera.cy) / camera.fy
        rays = np.stack([x, y, np.ones(rows.size)], axis=1)
        pose = poses[camera.name]
        depth = first_hits(centre(pose), rays @ pose[:3, :3], surface) / aligned.scale
        rays, depth = rays[np.isfinite(depth)], depth[np.isfinite(depth)]
        for name, share in (("surface", np.ones(len(depth))), ("air", generator.uniform(0.2, 0.8, len(depth)))):
            in_camera = (share * depth)[:, None] * rays
            places = (in_camera - camera.cam_from_world[:3, 3]) @ camera.cam_from_world[:3, :3]
            model = Gaussians.empty(len(places), 0)
            model.means = torch.from_numpy(places.astype(np.float32))
            model.log_scales[:] = -20.0
            called[name].append(near_or_free(model, space).numpy())
    assert np.concatenate(called["surface"]).mean() < 0.003
    assert np.concatenate(called["air"]).mean() > 0.5


def test_the_depth_map_is_what_rays_hit(opened: OpenedRun, poses: Poses, surface: Float64[np.ndarray, "m 3 3"]) -> None:
    """From near the ground, which extends behind the camera, and from straight above."""
    generator = np.random.default_rng(0)
    for view in (opened.views[0], opened.views[-1]):
        camera = replace(opened.camera(view), cam_from_world=poses[view.camera.name])
        depth = depth_map(camera, surface)
        row, column = (generator.integers(0, size, 60) for size in depth.shape)
        x, y = (column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy
        rays = np.stack([x, y, np.ones(60)], axis=1) @ camera.cam_from_world[:3, :3]
        np.testing.assert_allclose(depth[row, column], first_hits(camera.centre(), rays, surface), rtol=1e-9)


def test_depth_errors_are_those_of_rays_that_hit_the_house(
    opened: OpenedRun, aligned: Similarity, surface: Float64[np.ndarray, "m 3 3"]
) -> None:
    """The house with annex, steps and eaves fits a rotated box: all of it counts, and no tree."""
    camera = opened.camera(opened.views[0])
    house = building_corners()
    errors, seen, gsd = depth_errors(opened, camera, aligned, (surface, house))
    row, column = (part[::97] for part in np.nonzero(seen))
    assert 0.1 < seen.mean() < 0.7
    x, y = (column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy
    there = aligned.camera_pose(camera.cam_from_world)
    rays = np.stack([x, y, np.ones(len(x))], axis=1) @ there[:3, :3]
    true = first_hits(centre(there), rays, surface)
    found = aligned.scale * opened.median_depth(camera)[row, column].astype(np.float64)
    np.testing.assert_allclose(gsd[row, column], true / camera.fx, rtol=1e-3)
    expected = np.where(found > 0.0, (found - true) / gsd[row, column], np.inf)
    np.testing.assert_allclose(errors[row, column], expected, atol=1e-6)
    places = centre(there) + true[:, None] * rays
    angle = np.deg2rad(json.loads((CAPTURE / "truth.json").read_text())["house_yaw_deg"])
    east, north = places[:, 0], places[:, 1]
    along, across = np.cos(angle) * east + np.sin(angle) * north, np.cos(angle) * north - np.sin(angle) * east
    assert along.min() > -6.6 - ATTACHED_M and along.max() < 11.1 + ATTACHED_M
    assert np.abs(across).max() < 6.8 and places[:, 2].max() < 11.1


def test_demo_truth_measures_a_model_beside_the_one_trained_for_the_size(out: Path, tmp_path: Path) -> None:
    """The same model is as good as itself; the capture's photos are large enough for double the size of this run."""
    command = benchmark("demo_truth", out, "--half", out, "--double", out, "--save", tmp_path)
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert "median depth on the house" in done.stdout and "scales" in done.stdout
    found = json.loads((tmp_path / "demo_truth.json").read_text())
    *views, every = found["depth"]
    assert [row["view"] for row in views] == [f"DJI_{number:04d}.JPG" for number in range(1, 41, 4)]
    assert sum(row["pixels"] for row in views) == every["pixels"] > 0
    assert 0.2 < every["within"] < 1.0
    assert [row["pixels"] for row in found["scales"]] == ["183x136", "367x272", "734x544"]
    assert [row.get("below") for row in found["scales"]] == [0.0, None, 0.0]
    assert len(list(tmp_path.glob("*.depth.png"))) == 10


def test_path_frames_finds_what_hangs_before_the_camera(opened: OpenedRun, tmp_path: Path) -> None:
    cameras = [opened.camera(view) for view in opened.views[:3]]
    rows = measure_path(opened, cameras, 5, tmp_path)
    assert len(list(tmp_path.glob("frame_*.png"))) == 5 and (tmp_path / "sheet.png").is_file()
    assert all(row["places"] > 100 for row in rows[1:])
    gaussians, sky = opened.model
    place = cameras[1].centre() + 0.1 * opened.median_depth(cameras[1]).mean() * cameras[1].cam_from_world[2, :3]
    blob = Gaussians.empty(1, gaussians.sh_degree)
    blob.means = torch.from_numpy(place[None].astype(np.float32))
    blob.log_scales[:] = float(np.log(0.02 * opened.median_depth(cameras[1]).mean()))
    blob.opacity_logits[:] = 6.0
    both = {name: torch.cat([tensor, blob.tensors()[name]]) for name, tensor in gaussians.tensors().items()}
    haunted = replace(opened, model=(Gaussians(**both), sky))
    worse = measure_path(haunted, cameras, 5, tmp_path)
    assert 2 in summary(worse)["crossing"]
    assert 2 not in summary(rows)["crossing"]
