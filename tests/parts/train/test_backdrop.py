"""With a boundary, Gaussians, figures and deliverables cover the inside; the outside stays a coarse backdrop."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.pixels.dataset import load_points, load_views
from splatpipe.pipeline.render.options import EvaluateConfig
from splatpipe.pipeline.render.view_measures import shows_inside
from splatpipe.pipeline.splat.containers.ply import read_splat, read_splat_header, write_splat
from splatpipe.pipeline.splat.sky import backdrop as backdrop_module
from splatpipe.pipeline.splat.sky.backdrop import backdrop_limit, coarse_start
from splatpipe.pipeline.splat.sky.panorama import write_panorama
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan import schedule as scheduled
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan
from splatpipe.pipeline.train.plan.start import read_start
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.pipeline.train.techniques.backdrop import Backdrop
from splatpipe.pipeline.train.techniques.techniques import make_techniques
from splatpipe.pipeline.web.options import ExportConfig
from splatpipe.stages import evaluate, export, initialize

HALF = np.array([[-10.0, -10.0], [0.0, -10.0], [0.0, 10.0], [-10.0, 10.0]])  # the model's x below 0
AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # the model's −y is up
WORLD_FROM_MODEL = Similarity(
    2.0, np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.array([5.0, 6.0, 7.0])
)
AREA = PlanArea(AXES, ((HALF,),))


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tiny scene's backdrop is also part of its inside."""
    monkeypatch.setattr(backdrop_module, "MIN_OUTSIDE", 5)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """A dataset, its true model as if trained, and a boundary around one half of it."""
    folder = tmp_path_factory.mktemp("bounded")
    dataset = tiny_scene.write_dataset(folder / "dataset")
    model = tiny_scene.true_model()
    model.means = model.means + 0.01
    write_splat(folder / "model.ply", model)
    plan = make_plan(TrainConfig(), load_views(dataset), tiny_scene.split_of(load_views(dataset), 4), len(model))
    (folder / "rendering.json").write_text(plan.rendering().to_json())
    write_panorama(folder / "sky.npz", None)
    frame = {
        "kind": "enu",
        "origin": {"latitude": 52.2, "longitude": 20.9, "height_m": 110.5},
        "vertical_datum": "unknown",
        "world_from_model": WORLD_FROM_MODEL.matrix().tolist(),
        "scale": WORLD_FROM_MODEL.scale,
        "rotation": WORLD_FROM_MODEL.rotation.tolist(),
        "translation": WORLD_FROM_MODEL.translation.tolist(),
        "residuals": {},
        "left_out": [],
        "note": "",
    }
    (folder / "frame.json").write_text(json.dumps(frame))
    world = PlanArea.seen_from_above([(2.0 * HALF + [5.0, 6.0],)])
    part = {"world": world.facts(), "model": world.in_source(WORLD_FROM_MODEL).facts()}
    (folder / "boundary.json").write_text(
        json.dumps(part | {"degrees": [[[[20.9, 52.2], [20.91, 52.2], [20.9, 52.21]]]]})
    )
    names = {"clean.model": "model.ply", "train.rendering": "rendering.json", "train.sky": "sky.npz"}
    names |= {"georef.frame": "frame.json", "georef.boundary": "boundary.json", "evaluate.metrics": "metrics.json"}
    parts = {part: folder / name for part, name in names.items()}
    parts |= {"undistort.dataset": dataset, "georef.model": dataset / "sparse/0"} | tiny_scene.split_part(dataset, 4)
    return Inputs(parts, folder)


def test_initial_points_include_all_of_the_inside_and_an_even_sample_of_the_rest() -> None:
    inside = np.zeros(1000, np.bool_)
    inside[100:400] = True
    rows = coarse_start(inside)
    assert set(range(100, 400)) <= set(rows.tolist())
    others = np.setdiff1d(rows, np.arange(100, 400))
    assert len(others) == backdrop_limit(300) == 150
    assert np.diff(np.searchsorted(np.flatnonzero(~inside), others)).max() <= 5  # every 4.7th of 700 is taken
    np.testing.assert_array_equal(coarse_start(np.ones(7, np.bool_)), np.arange(7))
    assert len(coarse_start(np.zeros(70, np.bool_))) == 5  # no inside, but still a backdrop


def test_a_backdrop_leaves_the_inside_two_thirds_of_the_cap() -> None:
    assert backdrop_limit(10_000, 1_000_000) == 5_000
    assert backdrop_limit(10_000, 3_000) == 1_000


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_initialize_prefers_points_inside_and_counts_the_sparse_ones(
    inputs: Inputs, tmp_path: Path, sign: float
) -> None:
    boundary = json.loads(inputs["georef.boundary"].read_text())
    boundary["model"]["polygons"][0][0] = (HALF * [sign, 1.0]).tolist()
    (tmp_path / "boundary.json").write_text(json.dumps(boundary))
    bounded = replace(inputs, parts={**inputs.parts, "georef.boundary": tmp_path / "boundary.json"})
    summary = initialize.run(InitializeConfig(dense=False), bounded, tmp_path, tiny_scene.Recorder())
    xyz = load_points(inputs["undistort.dataset"]).xyz
    inside = sign * xyz[:, 0] < 0.0
    start = read_start(tmp_path / "init.ply")
    means = start.gaussians.means.numpy()
    wanted = xyz[inside].astype(np.float32)
    np.testing.assert_array_equal(means[sign * means[:, 0] < 0.0], wanted)
    assert summary["inside"] == inside.sum() and start.sparse == len(means) == summary["gaussians"]
    assert (sign * means[:, 0] > 0.0).sum() == min(inside.sum() // 2, (~inside).sum())


def test_density_control_outside_keeps_to_the_backdrops_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """If all Gaussians qualify for cloning, the outside grows to its share and the inside to the rest of the cap."""
    monkeypatch.setattr(scheduled, "GRADIENT", 1e-12)
    config = tiny_scene.plain(iterations=40, max_gaussians=400)
    views = tiny_scene.cameras()
    schedule = scheduled.resolve_schedule(config)
    start = tiny_scene.true_model()
    plan = TrainingPlan(config, schedule, 4.0, 0.04, tuple(view.name for view in views), (), 0.004, len(start), 40)
    state = TrainState.begin(start, plan, make_techniques(plan, area=AREA))
    assert state.techniques.find(Backdrop) is not None
    for iteration in range(schedule.density.first, schedule.density.last + 1):
        if schedule.density.is_step(iteration):
            state.density.score_sum += 1.0
            state.density.seen += 1.0
            state.control_density(plan, iteration)
            inside = AREA.contains(state.gaussians.means.detach().double().numpy())
            outside = int((~inside).sum())
            # Clones and halves of the inside that fall outside are removed at the next step.
            assert outside <= backdrop_limit(int(inside.sum()), 400) + 0.05 * len(inside)
    before = int(AREA.contains(start.means.double().numpy()).sum())
    assert int(inside.sum()) > 2.5 * before and len(state.gaussians) <= 400


def test_without_a_boundary_nothing_is_ranked_or_removed() -> None:
    config = tiny_scene.plain(iterations=40)
    views = tiny_scene.cameras()
    schedule = scheduled.resolve_schedule(config)
    plan = TrainingPlan(config, schedule, 4.0, 0.04, tuple(view.name for view in views), (), 0.004, 150, 40)
    techniques, score = make_techniques(plan), torch.rand(150)
    assert techniques.find(Backdrop) is None
    assert techniques.adjust_scores(score, tiny_scene.true_model(), schedule.density) is score


def test_pixels_are_inside_or_outside_by_their_surface() -> None:
    camera = tiny_scene.cameras()[4]
    depth = np.full((camera.height, camera.width), 4.0, np.float32)
    depth[:5] = 0.0
    visible = shows_inside(AREA, camera, depth)
    pixels = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), axis=-1)
    left = camera.unproject(pixels.reshape(-1, 2), np.full(depth.size, 4.0))[:, 0].reshape(depth.shape) < 0.0
    np.testing.assert_array_equal(visible[5:], left[5:])
    assert not visible[:5].any() and 0.3 < visible.mean() < 0.6


def test_figures_are_of_the_inside_and_those_of_the_whole_image_are_given_too(inputs: Inputs, tmp_path: Path) -> None:
    evaluate.run(EvaluateConfig(), inputs, tmp_path, tiny_scene.Recorder())
    result = json.loads((tmp_path / "metrics.json").read_text())
    without = {part: path for part, path in inputs.parts.items() if part != "georef.boundary"}
    (tmp_path / "without").mkdir()
    evaluate.run(EvaluateConfig(), replace(inputs, parts=without), tmp_path / "without", tiny_scene.Recorder())
    plain = json.loads((tmp_path / "without/metrics.json").read_text())
    assert "whole" not in plain and result["whole"] == plain["mean"] != result["mean"]
    for view in result["per_view"]:
        photo, render, mask = (
            cv2.imread(str(tmp_path / "views" / f"{view['file']}.{kind}.png"), cv2.IMREAD_UNCHANGED)
            for kind in ("photo", "render", "mask")
        )
        assert photo is not None and render is not None and mask is not None
        error = (photo.astype(float) - render)[mask > 0] / 255.0
        assert view["psnr"] == pytest.approx(-10.0 * np.log10((error**2).mean()), abs=1e-4)
        assert view["counted"] == pytest.approx((mask > 0).mean(), abs=1e-6) and 0.1 < view["counted"] < 0.9


def test_a_photo_that_hardly_shows_the_inside_is_not_counted(inputs: Inputs, tmp_path: Path) -> None:
    boundary = json.loads(inputs["georef.boundary"].read_text())
    boundary["model"]["polygons"][0][0] = (HALF - [1.9, 0.0]).tolist()  # a strip of the wall that two photos show
    (tmp_path / "boundary.json").write_text(json.dumps(boundary))
    bounded = replace(inputs, parts={**inputs.parts, "georef.boundary": tmp_path / "boundary.json"})
    evaluate.run(EvaluateConfig(), bounded, tmp_path, tiny_scene.Recorder())
    result = json.loads((tmp_path / "metrics.json").read_text())
    psnrs = [view["psnr"] for view in result["per_view"] if view["psnr"] is not None]
    for view in result["per_view"]:
        assert (view["psnr"] is None) == (view["counted"] < 0.01) and view["whole"]["psnr"] is not None
    assert 0 < len(psnrs) < len(result["per_view"])
    assert result["mean"]["psnr"] == pytest.approx(sum(psnrs) / len(psnrs), abs=2e-6)


def test_the_inside_comes_first_and_the_page_begins_there(inputs: Inputs, tmp_path: Path) -> None:
    evaluate.run(EvaluateConfig(), inputs, inputs.photos_dir, tiny_scene.Recorder())
    export.run(ExportConfig(), inputs, tmp_path, tiny_scene.Recorder())
    splat = read_splat(tmp_path / "splat.ply")
    in_model = WORLD_FROM_MODEL.inverse().apply(splat.means.double().numpy())
    inside = AREA.contains(in_model)
    count = int(inside.sum())
    assert inside[:count].all() and 0 < count < len(inside)
    comment = f"boundary: the first {count} Gaussians lie inside, the other {len(inside) - count} are a backdrop"
    assert comment in read_splat_header(tmp_path / "splat.ply").comments
    figures = json.loads((tmp_path / "metrics.json").read_text())
    assert figures["gaussians_inside"] == count and figures["whole"]["psnr"] != figures["psnr"]
    psnrs = json.loads((tmp_path / "georef.json").read_text())["boundary"]
    assert psnrs["area_m2"] == pytest.approx(4.0 * 200.0)
    assert psnrs["wgs84"]["coordinates"][0][0][0] == psnrs["wgs84"]["coordinates"][0][0][-1]
    page = (tmp_path / "viewer/viewer.html").read_text()
    facts = json.loads(page.split('id="scene"', 1)[1].split(">", 1)[1].split("</script>", 1)[0])
    assert facts["centre"][0] < 5.0 - 0.5  # the world's east of the model's x = 0 is 5
