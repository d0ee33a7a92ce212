"""The initial Gaussians, if the cap is too small for all of them."""

import json
from pathlib import Path

import pytest
import tiny_scene
import torch

from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.splat.containers.ply import write_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sparse_count import sparse_comment
from splatpipe.pipeline.train.densify import room_at
from splatpipe.pipeline.train.plan import plan as planned
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.plan.start import InitialGaussians, read_start, started
from splatpipe.stages import train

SPARSE, SWEPT = 40, 100


def numbered() -> InitialGaussians:
    """Initial Gaussians whose means identify their rows."""
    gaussians = tiny_scene.true_model(SPARSE + SWEPT)
    gaussians.means = torch.arange(3.0 * len(gaussians)).view(-1, 3)
    return InitialGaussians(gaussians, SPARSE)


def rows_of(gaussians: Gaussians) -> list[int]:
    return (gaussians.means[:, 0].to(torch.int64) // 3).tolist()


def test_dense_points_fill_half_of_the_cap_evenly_and_the_sparse_ones_are_kept() -> None:
    start = numbered()
    assert start.within(2 * len(start.gaussians)) is start.gaussians
    half = rows_of(start.within(2 * SPARSE + 100))
    assert half == [*range(SPARSE), *range(SPARSE, SPARSE + SWEPT, 2)]
    assert rows_of(start.within(SPARSE + 3)) == rows_of(start.within(SPARSE)) == list(range(SPARSE))


def test_sparse_points_beyond_the_cap_are_thinned_evenly() -> None:
    assert rows_of(numbered().within(SPARSE // 2)) == list(range(0, SPARSE, 2))


def test_the_count_is_known_without_the_gaussians() -> None:
    start = numbered()
    for cap in range(1, 300):
        assert len(start.within(cap)) == started(SPARSE, SWEPT, cap) <= cap


def test_a_file_without_the_count_has_sparse_points_only(tmp_path: Path) -> None:
    gaussians = numbered().gaussians
    for comments, sparse in (([], 140), ([sparse_comment(40)], 40), ([sparse_comment(900)], 140), (["40"], 140)):
        write_splat(tmp_path / "init.ply", gaussians, comments)
        assert read_start(tmp_path / "init.ply").sparse == sparse


def test_density_control_grows_by_its_schedule_from_the_capped_initial_gaussians(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = tiny_scene.write_dataset(tmp_path / "dataset")
    write_splat(tmp_path / "init.ply", tiny_scene.true_model(500), [sparse_comment(100)])
    monkeypatch.setattr(planned, "resolve_schedule", tiny_scene.resolver(gradient=1e-12, prune_opacity=0.0))
    parts = {"undistort.dataset": dataset, "initialize.splat": tmp_path / "init.ply"} | tiny_scene.split_part(dataset)
    inputs = Inputs(parts, tmp_path, machine=Machine("cpu", 1))
    train.run(tiny_scene.plain(iterations=60, max_gaussians=400), inputs, tmp_path, tiny_scene.Recorder())
    plan = TrainingPlan.from_json((tmp_path / "plan.json").read_text())
    assert plan.initial_gaussians == 200
    events = json.loads((tmp_path / "history.json").read_text())["density"]
    room = [room_at(plan.schedule.density, 200, event["iteration"]) for event in events]
    assert 200 < events[0]["gaussians"] <= room[0] < 300 < events[-1]["gaussians"] <= 400
