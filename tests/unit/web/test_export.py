"""export: the splat and its cameras move together, other programs read them, and the figures are complete."""

import io
import json
from pathlib import Path

import numpy as np
import pyproj
import pytest
import tiny_scene
import torch
import trimesh
from plyfile import PlyData

from splatpipe.pipeline.delivery.delivery_frame import facts_of, in_world
from splatpipe.pipeline.delivery.sparse_scene import sparse_glb
from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import load_points, load_views
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.render.options import EvaluateConfig
from splatpipe.pipeline.splat.containers.ply import read_splat, write_splat
from splatpipe.pipeline.splat.formats.plain_ply import frame_comments
from splatpipe.pipeline.splat.quality import metrics
from splatpipe.pipeline.splat.sky.panorama import COLUMNS, ROWS, panorama_of, write_panorama
from splatpipe.pipeline.survey.crs.frames import load_frame
from splatpipe.pipeline.survey.crs.georeference import accuracy_in_words
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.plan import make_plan
from splatpipe.pipeline.web.options import ExportConfig
from splatpipe.stages import evaluate, export

SCALE = 7.5
ANGLE = 0.7
TRANSLATION = np.array([120.0, -35.0, 14.0])
ROTATION = np.array(  # the model's −y is up; then a turn about it
    [[np.cos(ANGLE), 0.0, np.sin(ANGLE)], [-np.sin(ANGLE), 0.0, np.cos(ANGLE)], [0.0, -1.0, 0.0]]
)
REQUIRED = [
    "photos",
    "registered",
    "points3d",
    "mean_reprojection_error_px",
    "gaussians",
    "iterations",
    "train_seconds",
    "train_megapixels",
    "peak_memory_bytes",
    "test_views",
    "psnr",
    "psnr_cc",
    "floaters",
    "accuracy",
    "ssim",
    "per_view",
    "versions",
    "seed",
    "device",
]


def write_frame(path: Path, kind: str = "enu") -> Path:
    matrix = np.eye(4)
    matrix[:3, :3] = SCALE * ROTATION
    matrix[:3, 3] = TRANSLATION
    fields = {
        "kind": kind,
        "origin": {"latitude": 52.2, "longitude": 20.9, "height_m": 110.5} if kind == "enu" else None,
        "vertical_datum": "unknown",
        "world_from_model": matrix.tolist(),
        "scale": SCALE,
        "rotation": ROTATION.tolist(),
        "translation": TRANSLATION.tolist(),
        "residuals": {},
        "left_out": [],
        "note": "",
    }
    path.write_text(json.dumps(fields))
    return path


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    folder = tmp_path_factory.mktemp("export")
    dataset = tiny_scene.write_dataset(folder / "dataset")
    model = tiny_scene.true_model()
    write_splat(folder / "model.ply", model)
    plan = make_plan(
        TrainConfig(),
        load_views(dataset),
        tiny_scene.split_of(load_views(dataset), 4),
        len(model),
    )
    (folder / "rendering.json").write_text(plan.rendering().to_json())
    parts = {
        "clean.model": folder / "model.ply",
        "train.rendering": folder / "rendering.json",
        "train.sky": folder / "sky.npz",
        "undistort.dataset": dataset,
        "georef.model": dataset / "sparse/0",
        "georef.frame": write_frame(folder / "frame.json"),
    }
    parts |= tiny_scene.split_part(dataset, 4)
    write_panorama(folder / "sky.npz", None)
    evaluate.run(EvaluateConfig(), Inputs(parts, folder), folder, tiny_scene.Recorder())
    train = {"train_seconds": 12.5, "peak_memory_bytes": 10**9, "device": "cpu", "iterations": 123, "plan": {"seed": 4}}
    train |= {"train_megapixels": round(tiny_scene.WIDTH * tiny_scene.HEIGHT / 1e6, 4)}
    parts |= {"evaluate.metrics": folder / "metrics.json"}
    return Inputs(parts, folder, summaries={"train": train})


@pytest.fixture(scope="module")
def exported(inputs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("exported")
    export.run(ExportConfig(), inputs, out, tiny_scene.Recorder())
    return out


def render(gaussians_path: Path, camera: Camera, near: float) -> torch.Tensor:
    gaussians = read_splat(gaussians_path)
    with torch.no_grad():
        return rasterizer.render(gaussians, camera, rasterizer.RenderOptions(sh_degree=3, near=near)).colour


def test_splat_looks_the_same_from_the_exported_cameras(inputs: Inputs, exported: Path) -> None:
    listed = json.loads((exported / "cameras.json").read_text())
    views = load_views(inputs["undistort.dataset"])
    assert [entry["img_name"] for entry in listed] == [view.camera.name for view in views]
    for entry, view in list(zip(listed, views, strict=True))[::4]:
        camera = view.camera
        pose = np.eye(4)
        pose[:3, :3] = np.array(entry["rotation"]).T
        pose[:3, 3] = -pose[:3, :3] @ np.array(entry["position"])
        shape = (entry["width"], entry["height"], entry["fx"], entry["fy"])
        moved = Camera(entry["img_name"], *shape, camera.cx, camera.cy, pose)
        before = render(inputs["clean.model"], camera, 0.01)
        after = render(exported / "splat.ply", moved, 0.01 * SCALE)
        assert before.std() > 0.1
        assert metrics.psnr(after, before) >= 50.0


def test_positions_and_sizes_are_in_the_world_frame(inputs: Inputs, exported: Path) -> None:
    before = read_splat(inputs["clean.model"])
    vertex = PlyData.read(str(exported / "splat.ply"))["vertex"]
    means = np.stack([vertex[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(means, SCALE * before.means.numpy() @ ROTATION.T + TRANSLATION, atol=1e-4)
    scales = np.stack([vertex[f"scale_{i}"] for i in range(3)], axis=1)
    np.testing.assert_allclose(scales, before.log_scales.numpy() + np.log(SCALE), atol=1e-5)
    quats = np.stack([vertex[f"rot_{i}"] for i in range(4)], axis=1)
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(vertex["opacity"], before.opacity_logits.numpy())


def test_header_states_the_origin(exported: Path, tmp_path: Path) -> None:
    comments = PlyData.read(str(exported / "splat.ply")).comments
    assert any("east north up, metres" in comment for comment in comments)
    assert any("52.2" in comment and "20.9" in comment and "110.5" in comment for comment in comments)
    arbitrary = frame_comments(facts_of(load_frame(write_frame(tmp_path / "frame.json", "arbitrary")), antialias=True))
    assert arbitrary[0] == "SplatRenderMode: mip"
    assert "arbitrary scale" in arbitrary[1]


def test_georef_json_places_the_exported_cameras(exported: Path) -> None:
    """A camera's position by georef.json agrees with its exact path through PROJ; a shrunken scene in a known CRS."""
    data = json.loads((exported / "georef.json").read_text())
    assert data["crs"]["id"] == "EPSG:32634" and data["ecef_from_local"]["approximate"]
    positions = np.array([entry["position"] for entry in json.loads((exported / "cameras.json").read_text())])
    earth = positions @ np.array(data["exact_path"]["matrix"])[:3, :3].T + np.array(data["exact_path"]["matrix"])[:3, 3]
    to_utm = pyproj.Transformer.from_crs(4978, "EPSG:32634", always_xy=True)
    easting, northing = to_utm.transform(*earth.T)[:2]
    tangent = data["crs_from_local_tangent"]
    by_matrix = positions @ np.array(tangent["matrix"])[:3, :3].T + np.array(tangent["matrix"])[:3, 3]
    off = np.hypot(by_matrix[:, 0] - easting, by_matrix[:, 1] - northing)
    assert off.max() <= tangent["largest_error_m"] + 1e-5  # as rounded
    low, high = np.array(tangent["over_box_m"])
    assert (positions >= low - 1e-3).all() and (positions <= high + 1e-3).all()


def test_the_crs_and_its_operation_are_reported(inputs: Inputs, tmp_path: Path) -> None:
    recorder = tiny_scene.Recorder()
    export.run(ExportConfig(), inputs, tmp_path, recorder)
    note = recorder.notes[0]
    assert "EPSG:32634" in note and "an exact conversion" in note and "unknown" in note


@pytest.mark.parametrize(
    ("accuracy_m", "words"),
    [
        (None, "of unknown accuracy"),
        (0.0, "an exact conversion"),
        (0.004, "accurate to 4 mm"),
        (0.05, "accurate to 0.05 m"),
        (1.26, "accurate to 1.3 m"),
        (120.0, "accurate to 120 m"),
    ],
)
def test_an_accuracy_is_never_rounded_to_nothing(accuracy_m: float | None, words: str) -> None:
    assert accuracy_in_words(accuracy_m) == words


def test_broken_gaussians_are_left_out_of_the_file(inputs: Inputs, tmp_path: Path) -> None:
    model = read_splat(inputs["clean.model"])
    model.quats[0] = 0.0
    model.log_scales[1, 0] = float("nan")
    moved = in_world(model, load_frame(inputs["georef.frame"]))
    assert len(moved) == len(model) - 2 and bool(moved.finite().all())


def test_metrics_have_every_promised_key(inputs: Inputs, exported: Path) -> None:
    figures = json.loads((exported / "metrics.json").read_text())
    assert not set(REQUIRED) - set(figures)
    assert (figures["registered"], figures["points3d"], figures["gaussians"]) == (9, 150, 150)
    assert (figures["photos"], figures["iterations"], figures["seed"]) == (9, 123, 4)
    assert (figures["train_seconds"], figures["peak_memory_bytes"], figures["device"]) == (12.5, 10**9, "cpu")
    assert figures["train_megapixels"] == pytest.approx(72 * 54 / 1e6, abs=1e-4)
    assert figures["psnr"] > 40.0 and figures["test_views"] == len(figures["per_view"]) == 3
    assert figures["mean_reprojection_error_px"] > 0.0  # the scene's keypoints are half a pixel off
    assert figures["versions"]["torch"]


def test_photos_left_out_are_counted_too(inputs: Inputs, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/photos.json").write_text(json.dumps({"photos": [{}] * 9}))
    (tmp_path / "left_out.json").write_text(json.dumps({"left_out": [{}] * 2}))
    parts = {"ingest.photos": tmp_path / "photos", "ingest.left_out": tmp_path / "left_out.json"}
    assert export.count_photos(Inputs(parts, tmp_path), 8) == 11
    assert export.count_photos(Inputs({}, tmp_path), 8) == 8


def test_sparse_scene_has_the_points_and_a_frustum_per_camera_y_up(inputs: Inputs, exported: Path) -> None:
    scene = trimesh.load(io.BytesIO((exported / "sparse.glb").read_bytes()), file_type="glb")
    parts = {type(geometry).__name__: geometry for geometry in scene.geometry.values()}
    points = load_points(inputs["undistort.dataset"])
    world = SCALE * points.xyz @ ROTATION.T + TRANSLATION
    np.testing.assert_allclose(
        np.asarray(parts["PointCloud"].vertices), world[:, [0, 2, 1]] * [1.0, 1.0, -1.0], atol=1e-3
    )
    np.testing.assert_array_equal(np.asarray(parts["PointCloud"].colors)[:, :3], points.rgb)
    lines = np.asarray(parts["Path3D"].vertices)
    for entry in json.loads((exported / "cameras.json").read_text()):
        east, north, up = entry["position"]
        assert np.linalg.norm(lines - [east, up, -north], axis=1).min() < 1e-3


def test_scene_of_one_camera_and_no_points_is_still_written(inputs: Inputs) -> None:
    points = load_points(inputs["undistort.dataset"])
    none = type(points)(points.xyz[:0], points.rgb[:0], points.track_lengths[:0], points.errors_px[:0])
    camera = load_views(inputs["undistort.dataset"])[0].camera
    glb = sparse_glb(none, [camera], load_frame(inputs["georef.frame"]))
    assert glb[:4] == b"glTF"


def test_sky_is_a_file_of_its_own_in_the_same_frame(inputs: Inputs, exported: Path, tmp_path: Path) -> None:
    up = ROTATION[2]  # the world's +z in the model's frame
    colours = np.tile(np.float32([0.2, 0.5, 0.9]), (ROWS * COLUMNS, 1))
    write_panorama(tmp_path / "sky.npz", panorama_of(up, colours))
    (tmp_path / "out").mkdir()
    parts = {**inputs.parts, "train.sky": tmp_path / "sky.npz"}
    again = Inputs(parts, tmp_path, summaries=inputs.summaries)
    summary = export.run(ExportConfig(sky=True), again, tmp_path / "out", tiny_scene.Recorder())
    vertex = PlyData.read(str(tmp_path / "out/sky/sky.ply"))["vertex"]
    assert summary["sky_gaussians"] == len(vertex) > 1000
    positions = [entry["position"] for entry in json.loads((exported / "cameras.json").read_text())]
    rays = np.stack([vertex[axis] for axis in "xyz"], axis=1) - np.mean(positions, axis=0)
    elevations = np.degrees(np.arcsin(rays[:, 2] / np.linalg.norm(rays, axis=1)))
    assert -2.01 < elevations.min() < -1.5 and elevations.max() > 88.0
    assert (tmp_path / "out/splat.ply").read_bytes() == (exported / "splat.ply").read_bytes()
    assert not (exported / "sky/sky.ply").exists()


def test_requesting_a_sky_that_was_not_trained_is_reported(inputs: Inputs, tmp_path: Path) -> None:
    recorder = tiny_scene.Recorder()
    summary = export.run(ExportConfig(sky=True), inputs, tmp_path, recorder)
    assert len(recorder.warnings) == 1 and "no sky" in recorder.warnings[0]
    assert "sky_gaussians" not in summary and not (tmp_path / "sky/sky.ply").exists()


def test_same_bits_for_the_same_inputs(inputs: Inputs, exported: Path, tmp_path: Path) -> None:
    export.run(ExportConfig(), inputs, tmp_path, tiny_scene.Recorder())
    for name in ("splat.ply", "georef.json", "cameras.json", "metrics.json", "sparse.glb"):
        assert (tmp_path / name).read_bytes() == (exported / name).read_bytes(), name


def test_the_viewer_is_a_page_of_its_own_and_can_be_left_out(inputs: Inputs, exported: Path, tmp_path: Path) -> None:
    page = (exported / "viewer/viewer.html").read_text(encoding="utf-8")
    assert "<title>3D model</title>" in page
    assert [path.name for path in (exported / "viewer").iterdir()] == ["viewer.html"]
    config = ExportConfig(title="Barn & byre", viewer_megabytes=0.001)
    export.run(config, inputs, tmp_path, tiny_scene.Recorder())
    assert sorted(path.name for path in (tmp_path / "viewer").iterdir()) == ["splat.spz", "viewer.html"]
    assert "<title>Barn &amp; byre</title>" in (tmp_path / "viewer/viewer.html").read_text(encoding="utf-8")
    (tmp_path / "none").mkdir()
    export.run(ExportConfig(viewer_megabytes=0.0), inputs, tmp_path / "none", tiny_scene.Recorder())
    assert not list((tmp_path / "none/viewer").iterdir())
