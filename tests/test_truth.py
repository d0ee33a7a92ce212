"""The demo capture against its truth: where the cameras stood, where the points lie, how deep the splat is."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
import trimesh
from jaxtyping import Float64

from splatpipe.demo import CAPTURE, capture_path
from splatpipe.pipeline.raster import RenderOptions, render
from splatpipe.pipeline.scene.dataset import load_points_and_tracks, load_views
from splatpipe.pipeline.scene.free_space import free_space, near_or_free
from splatpipe.pipeline.scene.gaussians import Gaussians
from splatpipe.pipeline.scene.ply import read_splat

sys.path.insert(0, str(Path(__file__).parent / "scenes"))
from rays import first_hits

Points = Float64[np.ndarray, "n 3"]
Poses = dict[str, Float64[np.ndarray, "4 4"]]
Aligned = tuple[float, object, object]  # scale, rotation, translation: truth from model

SETTINGS = (
    "features.extractor=opencv-sift",
    "features.max_image_size=1000",
    "matches.neighbours=12",
    "undistort.max_megapixels=0.06",
    "train.iterations=600",
    "train.max_gaussians=30000",
)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole demo capture, up to a short training."""
    folder = tmp_path_factory.mktemp("truth") / "out"
    chosen = [part for text in SETTINGS for part in ("--set", text)]
    command = [
        sys.executable,
        "-m",
        "splatpipe.pipeline.cli",
        "run",
        capture_path(),
        folder,
        *chosen,
        "--until",
        "train",
    ]
    subprocess.run(command, check=True)
    return folder


@pytest.fixture(scope="module")
def poses() -> Poses:
    photos = json.loads((CAPTURE / "truth.json").read_text())["photos"]
    return {photo["name"]: np.array(photo["cam_from_world"]) for photo in photos}


@pytest.fixture(scope="module")
def surface() -> Float64[np.ndarray, "m 3 3"]:
    return np.asarray(trimesh.load_mesh(CAPTURE / "surface.ply").triangles, dtype=np.float64)


@pytest.fixture(scope="module")
def model(out: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(next((out / "stages").glob("georef-*")) / "sparse" / "0")


def centre(pose: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, " 3"]:
    return np.asarray(-pose[:3, :3].T @ pose[:3, 3])


def similarity(source: Points, target: Points) -> tuple[float, Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]:
    """Least squares target = s R source + t: Umeyama 1991, equations 40 to 42."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, d, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ np.diag(sign) @ vt
    scale = float((d * sign).sum() / np.square(a).sum())
    return scale, rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0)


@pytest.fixture(scope="module")
def aligned(model: pycolmap.Reconstruction, poses: Poses) -> Aligned:
    images = [image for image in model.images.values() if image.has_pose]
    assert len(images) == len(poses)
    estimated = np.array([image.projection_center() for image in images])
    return similarity(estimated, np.array([centre(poses[image.name]) for image in images]))


def test_camera_centres_are_within_a_thousandth_of_the_site(
    model: pycolmap.Reconstruction, poses: Poses, aligned: Aligned
) -> None:
    scale, rotation, translation = aligned
    true = {name: centre(pose) for name, pose in poses.items()}
    errors = [
        scale * rotation @ image.projection_center() + translation - true[image.name]  # type: ignore[operator]
        for image in model.images.values()
    ]
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
    aligned: Aligned,
    surface: Float64[np.ndarray, "m 3 3"],
) -> None:
    scale, rotation, translation = aligned
    gaps = []
    for image in list(model.images.values())[::8]:
        origin = centre(poses[image.name])
        ids = [point.point3D_id for point in image.points2D if point.has_point3D()][::20]
        points = np.array([scale * rotation @ model.points3D[i].xyz + translation for i in ids])  # type: ignore[operator]
        ahead = points - origin
        distance = np.linalg.norm(ahead, axis=1)
        hits = first_hits(origin, ahead / distance[:, None], surface)
        gaps.append(np.abs(distance - hits) / hits)
    assert np.median(np.concatenate(gaps)) < 0.002
    assert np.mean(np.concatenate(gaps) < 0.01) > 0.8


def test_rendered_depth_is_the_true_depth(
    out: Path,
    poses: Poses,
    aligned: Aligned,
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
        depth = render(splat, camera, options).median_depth.numpy() * aligned[0]
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
    out: Path, poses: Poses, aligned: Aligned, surface: Float64[np.ndarray, "m 3 3"]
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
        depth = first_hits(centre(pose), rays @ pose[:3, :3], surface) / aligned[0]
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
