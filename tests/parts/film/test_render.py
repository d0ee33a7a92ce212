"""`flythrough` and `splatpipe render`: videos and stills of a real run, against truth and a browser's decoder."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_scene
import torch
from film_commands import SECONDS, render, rendered
from PIL import Image

from splatpipe.pipeline.app.render_request import RenderRequest
from splatpipe.pipeline.app.renders import RenderTask, render_run
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.film.camera_path import cameras_along
from splatpipe.pipeline.film.filming import coloured_depth, coloured_normals, open_scene
from splatpipe.pipeline.film.keyframe_file import read_keyframes
from splatpipe.pipeline.film.options import FlythroughConfig
from splatpipe.pipeline.film.photo_route import photo_film
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.similarity import Similarity, rotation_from_vector
from splatpipe.pipeline.native import _native
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.device import cpu
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render import rendering
from splatpipe.pipeline.render.rendering import render_depth, render_normals, render_pixels
from splatpipe.pipeline.splat.containers.ply import write_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians, quat_from_rotation
from splatpipe.pipeline.splat.sky.panorama import COLUMNS, ROWS, Panorama, write_panorama
from splatpipe.pipeline.survey.crs.frames import load_frame
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.plan import make_plan
from splatpipe.stages import flythrough
from splatpipe.stages.line import EXPORT, LINE


@pytest.fixture(scope="module")
def parts(demo_run: Path) -> dict[str, Path]:
    return {name: part.path for name, part in open_run_folder(demo_run, LINE).lineage(EXPORT).items()}


def test_the_film_of_the_demo_stays_outside_the_house(parts: dict[str, Path]) -> None:
    scene = open_scene(parts, 1, cpu())
    route = photo_film(scene.capture, round(25 * SECONDS), SECONDS)
    cameras = cameras_along(route, scene.lens(None), scene.capture.up)
    centres = load_frame(parts["georef.frame"]).world_from_model.apply(np.array([c.centre() for c in cameras]))
    assert (np.linalg.norm(centres[:, :2], axis=1) > 12.0).any() and (centres[:, 2] > 3.0).all()
    inside = (np.abs(centres[:, :2]) < 8.0).all(axis=1)
    assert (centres[inside, 2] > 14.0).all()  # over the roof at most


def test_stills_of_the_photos_are_those_that_were_evaluated(
    demo_run: Path, parts: dict[str, Path], tmp_path: Path
) -> None:
    summary = rendered(demo_run, "--stills", "-o", tmp_path / "stills")
    assert summary["pictures"] == 40 and summary["file"] == str(tmp_path / "stills")
    measured = sorted(parts["evaluate.views"].glob("*.render.png"))
    assert len(measured) == 10
    for picture in measured:
        mine = tmp_path / "stills" / picture.name.replace(".render", "")
        np.testing.assert_array_equal(np.asarray(Image.open(mine)), np.asarray(Image.open(picture)))


def test_depths_are_metres_to_surveyed_points(demo_run: Path, parts: dict[str, Path], tmp_path: Path) -> None:
    summary = rendered(demo_run, "--stills", "--what", "depth", "-o", tmp_path)
    control = json.loads(parts["georef.control"].read_text())
    poses = {entry["img_name"]: entry for entry in json.loads((demo_run / "cameras.json").read_text())}
    off = []
    for point in control["points"]:
        for observation in point["observations"]:
            photo = observation["photo"]
            picture = Image.open(tmp_path / f"{Path(photo).stem}.tif")
            depth = np.asarray(picture)
            assert depth.dtype == np.float32 and depth.ndim == 2
            pose = poses[photo]
            x, y, z = np.array(pose["rotation"]).T @ (np.array(point["surveyed_m"]) - pose["position"])
            scale = depth.shape[1] / pose["width"]
            column = round(scale * (pose["fx"] * x / z + pose["width"] / 2) - 0.5)
            row = round(scale * (pose["fy"] * y / z + pose["height"] / 2) - 0.5)
            if 0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]:
                off.append(depth[row, column] / z - 1.0)
    assert len(off) > 50 and np.median(np.abs(off)) < 0.01
    with Image.open(tmp_path / "DJI_0001.png") as picture:
        assert picture.size == (summary["width"], summary["height"]) and picture.mode == "RGB"
    assert 0.0 < summary["nearest"] < summary["farthest"]  # type: ignore[operator]


def test_the_ground_of_the_demo_faces_up(demo_run: Path, tmp_path: Path) -> None:
    """The photos straight down show the lawn: x, y, z of normals are east, north, up."""
    rendered(demo_run, "--stills", "--what", "normals", "--path", "orbit", "--size", "160x90", "-o", tmp_path)
    assert len(list(tmp_path.glob("*.tif"))) == len(list(tmp_path.glob("*.png"))) == 12
    normals = np.stack([cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[60:, :, ::-1] for path in tmp_path.glob("*.tif")])
    there = np.linalg.norm(normals, axis=3) > 0.5
    np.testing.assert_allclose(np.linalg.norm(normals[there], axis=1), 1.0, atol=1e-4)
    mean = normals[there].mean(axis=0)
    length = np.linalg.norm(mean)  # 1 where all agree; a short training's lawn is rough
    assert length > 0.5 and mean[2] / length > 0.99


def test_an_orbit_is_written_below_out_even_without_an_export(demo_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(demo_run, out, ignore=shutil.ignore_patterns("export-*", "features-*", "matches-*"))
    summary = rendered(out, "--path", "orbit", "--seconds", 0.4, "--size", "64x36", "--threads", 1)
    assert summary == {"pictures": 10, "width": 64, "height": 36, "file": str(out / "renders" / "orbit-colour.webm")}
    assert (out / "renders" / "orbit-colour.webm").is_file()


WRONG = [
    (RenderRequest("nowhere.json"), 2, "There is no file"),
    (RenderRequest("{tmp}"), 2, "There is no file"),
    (RenderRequest("{tmp}/broken.json"), 1, r"broken\.json"),
    (RenderRequest(what="beauty"), 2, "beauty"),
    (RenderRequest(size="641x360"), 2, "--size"),
    (RenderRequest(size="1x1"), 2, "--size"),
    (RenderRequest(size="640"), 2, "--size"),
    (RenderRequest(size="9999x10"), 2, "--size"),
    (RenderRequest(to=Path("{tmp}/film.avi")), 2, "is not a film file"),
    (RenderRequest(to=Path("{tmp}/folder.webm")), 2, "is not a film file"),
    (RenderRequest(stills=True, to=Path("{tmp}/broken.json")), 2, "is a file"),
    (RenderRequest(stills=True, to=Path("{tmp}/stills.webm")), 2, "is a film file name"),
    (RenderRequest(to=Path("/proc/films/film.webm")), 4, "Cannot make"),
]


@pytest.mark.parametrize("name", ["renders", "renders/orbit-colour"])
def test_stills_below_out_are_not_written_through_a_link(tmp_path: Path, name: str) -> None:
    link = tmp_path / "out" / name
    link.parent.mkdir(parents=True)
    (tmp_path / "secret").mkdir()
    link.symlink_to(tmp_path / "secret")
    with pytest.raises(UsageError, match=f"{name} is a link"):
        RenderRequest("orbit", stills=True).target(tmp_path / "out")
    assert list((tmp_path / "secret").iterdir()) == []


@pytest.mark.parametrize(("wanted", "code", "message"), WRONG, ids=range(len(WRONG)))
def test_invalid_requests_are_refused_before_anything_is_rendered(
    demo_run: Path, tmp_path: Path, wanted: RenderRequest, code: int, message: str
) -> None:
    (tmp_path / "broken.json").write_text("[{}]")
    (tmp_path / "folder.webm").mkdir()
    path, to = wanted.path.format(tmp=tmp_path), wanted.to and Path(str(wanted.to).format(tmp=tmp_path))
    with pytest.raises(SplatpipeError, match=message) as raised:
        render_run(demo_run, replace(wanted, path=path, to=to), 1)
    assert raised.value.exit_code == code and raised.value.hint
    assert not (demo_run / "renders").exists()


def test_an_out_without_a_splat_is_reported(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="does not contain a run"):
        render_run(tmp_path, RenderRequest(), 1)
    (tmp_path / "stages").mkdir()
    with pytest.raises(UsageError, match="no trained splat"):
        render_run(tmp_path, RenderRequest(), 1)


@pytest.mark.parametrize(
    "arguments", [("--seconds", "0"), ("--seconds", "nan"), ("--fps", "1000"), ("--what", "beauty")]
)
def test_an_invalid_call_ends_with_its_exit_code_and_no_traceback(demo_run: Path, arguments: tuple[str, ...]) -> None:
    done = render(demo_run, *arguments)
    assert done.returncode == 2 and "Traceback" not in done.stderr and arguments[0] in done.stderr + "--what"
    assert json.loads(done.stdout)["exit_code"] == 2


def test_keyframes_in_the_world_are_transformed_to_the_models_frame(tmp_path: Path) -> None:
    """The camera is at its keyframe, its target is centred, and up in the world is up in the image."""
    world = Similarity(12.5, rotation_from_vector(np.array([1.1, 0.3, -0.7])), np.array([310.0, -85.0, 22.0]))
    path = tmp_path / "path.json"
    path.write_text(json.dumps([{"position": [300, -80, 30], "target": [312, -86, 21], "fov_deg": 70}]))
    camera = tiny_scene.cameras()[0]
    dataset = tiny_scene.write_dataset(tmp_path / "dataset")
    scene = open_scene(tiny_parts(tmp_path, dataset), 1, cpu())
    names, (found,) = RenderTask(scene, world, RenderRequest(stills=True), read_keyframes(path), (320, 180)).stills()
    assert len(names) == 1 and found.width == 320
    np.testing.assert_allclose(world.apply(found.centre()[None])[0], [300, -80, 30], atol=1e-9)
    target, above = world.inverse().apply(np.array([[312.0, -86.0, 21.0], [312.0, -86.0, 22.0]]))
    pixels = found.project(np.stack((target, above)))
    np.testing.assert_allclose(pixels[0], [160, 90], atol=1e-6)
    assert pixels[1, 0] == pytest.approx(160, abs=1e-6) and pixels[1, 1] < 90
    assert 2.0 * np.degrees(np.arctan(160 / found.fx)) == pytest.approx(70.0)
    assert camera.width != found.width


def tiny_parts(folder: Path, dataset: Path) -> dict[str, Path]:
    model = tiny_scene.true_model()
    write_splat(folder / "model.ply", model)
    (folder / "rendering.json").write_text(
        make_plan(TrainConfig(), load_views(dataset), tiny_scene.split_of(load_views(dataset), 4), len(model))
        .rendering()
        .to_json()
    )
    write_panorama(folder / "sky.npz", None)
    found = {"clean.model": folder / "model.ply", "undistort.dataset": dataset}
    return found | {"train.rendering": folder / "rendering.json", "train.sky": folder / "sky.npz"}


def tiny_film(folder: Path, views: list[Camera] | None = None, budget_s: float = 0.0, **options: object) -> tuple:
    dataset = tiny_scene.write_dataset(folder / "dataset", views=views)
    recorder = tiny_scene.Recorder()
    inputs = Inputs(tiny_parts(folder, dataset), folder, {"train.time_budget_s": budget_s})
    out = folder / "out"
    out.mkdir()
    summary = flythrough.run(FlythroughConfig.model_validate(options), inputs, out, recorder)
    return summary, recorder, sorted(path.name for path in (out / "film").iterdir())


def test_three_photos_are_enough_for_a_film(tmp_path: Path) -> None:
    summary, recorder, files = tiny_film(tmp_path, tiny_scene.cameras(3), seconds=1.0, fps=10, size="96x54")
    assert summary == {"frames": 10, "seconds": 1.0, "width": 96, "height": 54}
    assert files == ["flythrough.webm"] and recorder.warnings == []
    assert recorder.steps[-1] == (10, 10)


def test_zero_seconds_no_path_or_no_time_give_no_film(tmp_path: Path) -> None:
    back = np.diag([-1.0, 1.0, -1.0, 1.0])  # turned round: nothing is in front of them
    away = [replace(camera, cam_from_world=back @ camera.cam_from_world) for camera in tiny_scene.cameras(3)]
    for name, options, said in (
        ("none", {"seconds": 0.0}, ""),
        ("hurry", {"budget_s": 60.0}, "10 minutes"),
        ("alone", {"views": away}, "no path"),
    ):
        folder = tmp_path / name
        folder.mkdir()
        summary, recorder, files = tiny_film(folder, **options)  # type: ignore[arg-type]
        assert summary == {"frames": 0} and files == []
        assert said in " ".join([*recorder.warnings, *recorder.notes])


@pytest.mark.parametrize("size", ["641x360", "12x10", "9000x900", "big", "640x360x2"])
def test_invalid_film_sizes_are_refused(size: str) -> None:
    with pytest.raises(ValueError):
        FlythroughConfig(size=size)


def test_normals_of_a_slanted_wall_are_its_own() -> None:
    """Flat Gaussians in a plane, seen at a slant from several sides: normals face the camera, wherever it is."""
    turn = rotation_from_vector(np.array([0.35, -0.25, 0.1]))
    side = np.arange(-2.5, 2.5, 0.08)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    wall = Gaussians.empty(len(x), 0)
    wall.means = torch.from_numpy((np.stack([x, y, 0.0 * x], axis=1) @ turn.T).astype(np.float32))
    wall.log_scales = torch.log(torch.tensor([0.08, 0.08, 1e-4])).repeat(len(x), 1)
    wall.quats = quat_from_rotation(torch.from_numpy(turn)).float().repeat(len(x), 1)
    wall.opacity_logits = torch.full((len(x),), 6.0)
    normal = turn[:, 2]
    for camera in tiny_scene.cameras()[::4]:
        camera = camera.scaled(4 * camera.width, 4 * camera.height)
        normals = render_normals(wall, camera, rasterizer.RenderOptions(sh_degree=0))
        towards = normal if (camera.centre() @ normal) > 0.0 else -normal
        seen = normals[80:140, 100:190].reshape(-1, 3)
        assert np.degrees(np.arccos(np.clip(seen @ towards, -1.0, 1.0))).max() < 2.0
    empty = wall.select(torch.zeros(len(wall), dtype=torch.bool))
    assert not render_normals(empty, camera, rasterizer.RenderOptions(sh_degree=0)).any()


@pytest.mark.parametrize("pixels", [1, 3000, 1 << 21])
def test_images_made_strip_by_strip_are_those_of_one_piece(pixels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    model, options = tiny_scene.true_model(), rasterizer.RenderOptions(sh_degree=0)
    sky = Panorama(np.array([0.0, 0.6, 0.8]), torch.rand(ROWS * COLUMNS, 3, generator=torch.Generator().manual_seed(1)))
    camera = tiny_scene.cameras()[0].scaled(151, 117)

    def made() -> list[np.ndarray]:
        depths, normals = (render(model, camera, options) for render in (render_depth, render_normals))
        return [render_pixels((model, sky), camera, options), depths, normals]

    whole = made()
    monkeypatch.setattr(rendering, "STRIP_PIXELS", pixels)
    assert len(rendering.strips(camera)) == {1: 15, 3000: 8, 1 << 21: 1}[pixels]
    for one, other in zip(whole, made(), strict=True):
        step = 1.0 if one.dtype == np.uint8 else 1e-6  # a part's pixels count from another corner, and round otherwise
        np.testing.assert_allclose(one.astype(float), other.astype(float), rtol=1e-5, atol=step)


def test_colours_of_depths_and_normals() -> None:
    depth = np.array([[0.0, 2.0, 4.0, 8.0, 100.0]], np.float32)
    colours = coloured_depth(depth, (2.0, 8.0)).astype(int)
    assert colours[0, 0].tolist() == [0, 0, 0]
    assert colours[0, 1, 0] > colours[0, 1, 2] and colours[0, 3, 2] > colours[0, 3, 0]  # red near, blue far
    np.testing.assert_array_equal(colours[0, 3], colours[0, 4])
    middle = coloured_depth(np.array([[4.0]], np.float32), (1.0, 16.0))
    np.testing.assert_array_equal(middle, coloured_depth(np.array([[4.0]], np.float32), (2.0, 8.0)))  # even by ratio
    normals = np.array([[[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    assert coloured_normals(normals).tolist() == [[[128, 128, 255], [0, 128, 128], [128, 128, 128]]]


def test_threads_do_not_change_a_film(tmp_path: Path) -> None:
    films = []
    for threads in (1, 3):
        folder = tmp_path / str(threads)
        folder.mkdir()
        inputs = Inputs(
            tiny_parts(folder, tiny_scene.write_dataset(folder / "dataset")), folder, {"train.time_budget_s": 0.0}
        )
        inputs = replace(inputs, machine=replace(inputs.machine, threads=threads))
        (folder / "out").mkdir()
        with same_bits(threads):
            flythrough.run(FlythroughConfig(seconds=0.4), inputs, folder / "out", tiny_scene.Recorder())
        films.append((folder / "out" / "film" / "flythrough.webm").read_bytes())
    _native.set_threads(1)
    assert films[0] == films[1]
