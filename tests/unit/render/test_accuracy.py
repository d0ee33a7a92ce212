"""The accuracy of the splat itself, on a wall at a known place; and the table of residuals."""

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.similarity import Similarity, rotation_from_vector
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.render import rendering
from splatpipe.pipeline.render.options import EvaluateConfig
from splatpipe.pipeline.render.splat_accuracy import depth_at, measure_accuracy
from splatpipe.pipeline.splat.model.gaussians import Gaussians, quat_from_rotation
from splatpipe.pipeline.survey.control.residuals import accuracy_table
from splatpipe.pipeline.survey.crs.frames import Frame, save_frame
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.stages import evaluate

TURN = rotation_from_vector(np.array([0.25, -0.2, 0.1]))  # rotation of the wall in the model's frame: seen at a slant
WORLD_FROM_MODEL = Similarity(12.5, rotation_from_vector(np.array([1.1, 0.3, -0.7])), np.array([310.0, -85.0, 22.0]))
RENDERED = 6e-3  # metres; a pixel is 0.089. The screen filter makes slanted surfaces appear a little nearer


def wall() -> Gaussians:
    """Opaque flat Gaussians, side by side in the plane z = 0, turned."""
    side = np.arange(-1.4, 1.4, 0.05)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    gaussians = Gaussians.empty(len(x), 0)
    gaussians.means = torch.from_numpy((np.stack([x, y, 0.0 * x], axis=1) @ TURN.T).astype(np.float32))
    gaussians.log_scales = torch.log(torch.tensor([0.05, 0.05, 1e-4])).repeat(len(x), 1)
    gaussians.quats = quat_from_rotation(torch.from_numpy(TURN)).float().repeat(len(x), 1)
    gaussians.opacity_logits = torch.full((len(x),), 6.0)
    return gaussians


def cameras() -> list[Camera]:
    """The tiny scene's cameras with eight times the pixels per side: the wall's Gaussians are some pixels wide."""
    return [camera.scaled(8 * camera.width, 8 * camera.height) for camera in tiny_scene.cameras()]


def points_on_the_wall() -> np.ndarray:
    """Return points on the wall, in the model's frame."""
    return np.random.default_rng(3).uniform([-0.7, -0.5, 0.0], [0.7, 0.5, 0.0], (6, 3)) @ TURN.T


def control(
    views: list[Camera], points: np.ndarray, off_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> dict[str, Any]:
    """A control.json: the points seen in every photo, two of them check points, surveyed ``off_m`` from the wall."""
    surveyed = WORLD_FROM_MODEL.apply(points) + off_m
    entries = []
    for number, (point, place) in enumerate(zip(points, surveyed, strict=True)):
        in_cameras = [camera.cam_from_world[:3, :3] @ point + camera.cam_from_world[:3, 3] for camera in views]
        observations = [
            {"photo": camera.name, "pixel": [0, 0], "ray": (x[:2] / x[2]).tolist(), "residual_px": None}
            for camera, x in zip(views, in_cameras, strict=True)
        ]
        role = "check" if number < 2 else "control"
        entries.append({"name": f"P{number}", "role": role, "surveyed_m": place.tolist(), "observations": observations})
    return {"crs": "EPSG:32633", "points": entries}


@pytest.fixture
def parts(tmp_path: Path) -> dict[str, Path]:
    """Return georef's parts for the wall."""
    save_frame(Frame("enu", WORLD_FROM_MODEL, Origin(47.8, 13.5, 500.0)), tmp_path / "frame.json")
    (tmp_path / "accuracy.json").write_text('{"gsd_m": 0.7, "tables": {"gps": null}}')
    rewrite(tmp_path / "control.json", control(cameras(), points_on_the_wall()))
    return {f"georef.{name}": tmp_path / f"{name}.json" for name in ("frame", "control", "accuracy")}


def rewrite(path: Path, value: dict[str, Any]) -> None:
    path.write_text(json.dumps(value))


def measured(parts: dict[str, Path], held_out: tuple[str, ...] = (), gaussians: Gaussians | None = None) -> Any:
    options = rasterizer.RenderOptions(sh_degree=0)
    depth_of = partial(rendering.render_depth, gaussians or wall(), options=options)
    return measure_accuracy(parts, cameras(), held_out, depth_of)


def test_a_true_splat_has_no_residuals(parts: dict[str, Path]) -> None:
    result = measured(parts)
    assert result["gsd_m"] == 0.7
    tables = result["splat"]["tables"]
    assert (tables["control"]["count"], tables["check"]["count"], tables["all"]["count"]) == (4, 2, 6)
    assert tables["all"]["rmse_3d_m"] < RENDERED
    for entry, point in zip(result["splat"]["points"], WORLD_FROM_MODEL.apply(points_on_the_wall()), strict=True):
        np.testing.assert_allclose(entry["estimated_m"], point, atol=2.0 * RENDERED)
        assert len(entry["observations"]) == tiny_scene.CAMERAS and not entry["held_out"]


def test_georefs_findings_on_each_point_are_kept(parts: dict[str, Path]) -> None:
    stored = json.loads(parts["georef.control"].read_text())
    stored["points"][1] |= {"why": "", "residual_m": [0.01, 0.02, None], "surveyed_crs": [388_710.5, 5_299_705.2, None]}
    stored["points"][1]["observations"][0]["residual_px"] = [0.3, -0.4]
    stored["points"][1]["observations"][1]["residual_px"] = [0.0, 1.2]
    rewrite(parts["georef.control"], stored)
    point = measured(parts)["points"][1]
    assert (point["name"], point["role"], point["photos"]) == ("P1", "check", 9)
    assert point["residual_m"] == [0.01, 0.02, None] and point["surveyed_crs"][0] == 388_710.5
    assert point["rms_px"] == pytest.approx(math.sqrt((0.25 + 1.44) / 2), abs=1e-3)


def test_the_offset_of_a_misplaced_splat_is_reported(parts: dict[str, Path]) -> None:
    """Surveyed points beside the wall: the residuals are the negative offset."""
    off = (0.3, -0.2, 0.5)
    rewrite(parts["georef.control"], control(cameras(), points_on_the_wall(), off))
    table = measured(parts)["splat"]["tables"]["all"]
    np.testing.assert_allclose(table["mean_m"], -np.array(off), atol=RENDERED)
    assert table["rmse_horizontal_m"] == pytest.approx(math.hypot(0.3, 0.2), abs=RENDERED)
    assert table["rmse_3d_m"] == pytest.approx(np.linalg.norm(off), abs=RENDERED)


def test_only_held_out_photos_count_if_three_of_them_see_the_point(parts: dict[str, Path]) -> None:
    names = [camera.name for camera in cameras()]
    stored = json.loads(parts["georef.control"].read_text())
    stored["points"][0]["observations"] = stored["points"][0]["observations"][2:]  # in two of the held-out ones
    rewrite(parts["georef.control"], stored)
    points = measured(parts, (names[0], names[3], names[5]))["splat"]["points"]
    assert [seen["photo"] for seen in points[1]["observations"]] == [names[0], names[3], names[5]]
    assert points[1]["held_out"] and not points[0]["held_out"]
    assert [seen["photo"] for seen in points[0]["observations"]] == names[2:]


def test_median_over_photos_tolerates_one_floater(parts: dict[str, Path]) -> None:
    gaussians = wall()
    camera = cameras()[4]
    floater = wall().select(torch.arange(1))
    floater.means[0] = torch.from_numpy(0.6 * camera.centre() + 0.4 * points_on_the_wall()[2])
    floater.log_scales[:] = math.log(0.02)
    result = measured(parts, gaussians=Gaussians.concat([gaussians, floater]))
    point = result["splat"]["points"][2]
    there = [abs(seen["residual_m"][0]) for seen in point["observations"] if seen["photo"] == camera.name]
    assert there[0] > 1.0 and np.abs(point["residual_m"]).max() < 2.0 * RENDERED


def test_a_mark_that_georef_rejected_is_not_used(parts: dict[str, Path]) -> None:
    stored = json.loads(parts["georef.control"].read_text())
    wrong = stored["points"][0]["observations"][0]
    wrong |= {"ray": [0.4, 0.4], "residual_px": [900.0, 0.0], "used": False}
    rewrite(parts["georef.control"], stored)
    result = measured(parts)
    assert wrong["photo"] not in [seen["photo"] for seen in result["splat"]["points"][0]["observations"]]
    assert (result["points"][0]["photos"], result["points"][0]["rms_px"]) == (tiny_scene.CAMERAS - 1, None)


def test_points_without_a_height_photo_or_surface_are_reported_as_far_as_possible(parts: dict[str, Path]) -> None:
    stored = json.loads(parts["georef.control"].read_text())
    stored["points"][2]["surveyed_m"][2] = None
    for seen in stored["points"][3]["observations"]:
        seen["photo"] = "elsewhere.jpg"
    for seen in stored["points"][4]["observations"]:
        seen["ray"] = [0.45, 0.3]  # past the wall
    stored["points"][5]["role"] = "left_out"
    rewrite(parts["georef.control"], stored)
    splat = measured(parts)["splat"]
    assert splat["points"][2]["residual_m"][2] is None and splat["points"][2]["estimated_m"][2] is not None
    assert splat["points"][3]["estimated_m"] is None and splat["points"][4]["estimated_m"] is None
    assert splat["points"][5]["residual_m"] is not None
    assert splat["tables"]["control"]["count"] == 1 and splat["tables"]["control"]["rmse_up_m"] is None


def test_without_points_or_georeference_there_are_only_georefs_tables(parts: dict[str, Path]) -> None:
    rewrite(parts["georef.control"], {"points": []})
    assert measured(parts) == {"gsd_m": 0.7, "tables": {"gps": None}, "points": [], "splat": None}
    rewrite(parts["georef.control"], control(cameras(), points_on_the_wall()))
    save_frame(Frame("arbitrary", WORLD_FROM_MODEL), parts["georef.frame"])
    assert measured(parts)["splat"] is None
    assert measured({})["splat"] is None


@pytest.mark.parametrize("text", ["{", "[]", '{"points": 3}', '{"points": [{"name": "A"}]}', '{"points": [7]}'])
def test_a_broken_control_json_says_what_to_do(parts: dict[str, Path], text: str) -> None:
    parts["georef.control"].write_text(text)
    with pytest.raises(StageError, match=r"control\.json") as raised:
        measured(parts)
    assert "georef" in raised.value.hint


def test_evaluate_writes_it_to_its_metrics(parts: dict[str, Path], tmp_path: Path) -> None:
    from splatpipe.pipeline.photos.pixels.dataset import load_views
    from splatpipe.pipeline.splat.containers.ply import write_splat
    from splatpipe.pipeline.splat.sky.panorama import write_panorama
    from splatpipe.pipeline.train.options import TrainConfig
    from splatpipe.pipeline.train.plan.plan import make_plan

    dataset = tiny_scene.write_dataset(tmp_path / "dataset")
    write_splat(tmp_path / "model.ply", wall())
    plan = make_plan(TrainConfig(antialias=False), load_views(dataset), tiny_scene.split_of(load_views(dataset), 4), 1)
    (tmp_path / "rendering.json").write_text(plan.rendering().to_json())
    write_panorama(tmp_path / "sky.npz", None)
    files = {"clean.model": "model.ply", "train.rendering": "rendering.json", "train.sky": "sky.npz"}
    inputs = Inputs(
        {name: tmp_path / file for name, file in files.items()}
        | parts
        | {"undistort.dataset": dataset}
        | tiny_scene.split_part(dataset, 4),
        tmp_path,
    )
    (tmp_path / "out").mkdir()
    evaluate.run(EvaluateConfig(), inputs, tmp_path / "out", tiny_scene.Recorder())
    accuracy = json.loads((tmp_path / "out/metrics.json").read_text())["accuracy"]
    pixel_m = 4.0 * WORLD_FROM_MODEL.scale / tiny_scene.FOCAL
    assert accuracy["splat"]["tables"]["all"]["rmse_3d_m"] < pixel_m / 4.0  # no Gaussian is wider than a pixel here
    assert all(point["held_out"] and len(point["observations"]) == 3 for point in accuracy["splat"]["points"])


def test_depth_between_pixels_is_exact_on_a_plane() -> None:
    camera = Camera("c", 40, 30, 350.0, 360.0, 19.0, 15.5, np.eye(4))
    normal, distance = np.array([0.3, -0.5, 1.0]), 7.0

    def true_depth(pixels: np.ndarray) -> np.ndarray:
        rays = np.stack(
            [(pixels[..., 0] - 19.0) / 350.0, (pixels[..., 1] - 15.5) / 360.0, np.ones(pixels.shape[:-1])], -1
        )
        return distance / (rays @ normal)

    centres = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), axis=-1)
    depth = true_depth(centres)
    for pixel in np.random.default_rng(0).uniform([0.5, 0.5], [39.5, 29.5], (50, 2)):
        assert depth_at(depth, pixel) == pytest.approx(float(true_depth(pixel)), rel=1e-9)


def test_depth_at_an_edge_is_the_nearest_pixels_and_outside_there_is_none() -> None:
    depth = np.array([[2.0, 9.0, 0.0], [2.0, 9.0, 9.0]])
    assert depth_at(depth, np.array([0.9, 0.9])) == 2.0 and depth_at(depth, np.array([1.1, 0.9])) == 9.0
    assert depth_at(depth, np.array([2.6, 0.4])) is None  # no surface there
    for outside in ([-0.01, 0.5], [3.0, 0.5], [0.5, 2.0], [np.inf, 0.0], [np.nan, 0.0]):
        assert depth_at(depth, np.array(outside)) is None
    assert depth_at(np.full((1, 1), 3.0), np.array([0.7, 0.2])) == 3.0


def test_the_tables_figures_match_their_definitions() -> None:
    residuals = np.array([[0.03, -0.04, 0.05], [0.01, 0.0, np.nan], [-0.01, 0.02, -0.01]])
    table = accuracy_table(residuals)
    assert table is not None and table["count"] == 3
    assert table["rmse_east_m"] == pytest.approx(math.sqrt((9 + 1 + 1) / 3) / 100, abs=1e-5)
    assert table["rmse_north_m"] == pytest.approx(math.sqrt((16 + 0 + 4) / 3) / 100, abs=1e-5)
    assert table["rmse_up_m"] == pytest.approx(math.sqrt((25 + 1) / 2) / 100, abs=1e-5)
    assert table["rmse_horizontal_m"] == pytest.approx(math.sqrt((25 + 1 + 5) / 3) / 100, abs=1e-5)
    assert table["rmse_3d_m"] == pytest.approx(math.sqrt((50 + 6) / 2) / 100, abs=1e-5)
    assert table["mean_m"] == pytest.approx([0.01, -0.02 / 3, 0.02], abs=1e-5)
    assert accuracy_table(np.zeros((0, 3))) is None
    flat = accuracy_table(np.array([[0.1, 0.0, np.nan]]))
    assert flat is not None and flat["rmse_up_m"] is flat["rmse_3d_m"] is flat["interval_95_vertical_m"] is None
    # chi-squared with 6 degrees of freedom: 1.2373 and 14.4494 at 2.5 and 97.5 % (tables)
    low, high = table["interval_95_horizontal_m"]
    assert low == pytest.approx(table["rmse_horizontal_m"] * math.sqrt(6 / 14.4494), abs=2e-5)
    assert high == pytest.approx(table["rmse_horizontal_m"] * math.sqrt(6 / 1.2373), abs=2e-5)


def test_the_terminal_shows_the_tables_and_each_point(capsys: pytest.CaptureFixture[str]) -> None:
    from splatpipe.pipeline.app.terminal.console import show_accuracy

    check = accuracy_table(np.array([[0.012, -0.034, 0.056], [0.01, 0.02, np.nan]]))
    report = {"gsd_m": 0.0312, "tables": {"gps": None, "control": None, "check": check}, "splat": None}
    seen = {"photo": "a.jpg", "residual_px": [3.0, 4.0]}
    wrong = {"photo": "b.jpg", "residual_px": [3000.0, 4000.0], "used": False}
    point = {"name": "P[1]", "role": "check", "residual_m": [0.012, -0.034, 0.056], "observations": [seen, wrong]}
    left = {"name": "P2", "role": "left_out", "why": "one mark", "residual_m": None, "observations": []}
    show_accuracy(report, [point, left])
    output = capsys.readouterr().err
    assert "GSD 0.0312 m" in output and "photo positions" not in output and "P2: one mark." in output
    row = next(line for line in output.splitlines() if line.startswith("check points"))
    assert row.split()[2:6] == ["2", "0.011", "0.028", "0.056"]
    row = next(line for line in output.splitlines() if line.startswith("P[1]"))
    assert row.split() == ["P[1]", "check", "1", "0.012", "-0.034", "0.056", "5.00", "–", "–", "–"]
    assert max(len(line.rstrip()) for line in output.splitlines()) <= 80
    assert "Positions of" not in output
    flights = [{"flight": 0, "offset_m": [0.001, 0.0, -47.002]}, {"flight": 1, "offset_m": [0.001, 0.0, 0.002]}]
    show_accuracy({"tables": {"gps": {**check, "flights": flights}}}, [])
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("Positions of")]
    assert lines == ["Positions of flight 1: common offset east +0.001, north +0.000, up -47.002 m."]
    show_accuracy({}, [])
    assert capsys.readouterr().err == ""
