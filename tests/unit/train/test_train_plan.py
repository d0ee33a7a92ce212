"""The plan and the checkpoints of training: schedules, round trips, and broken files."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
from pydantic import ValidationError

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.render.rendering import Rendering, load_rendering
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.plan import (
    TrainingPlan,
    load_or_write_plan,
    make_plan,
    scene_extent,
)
from splatpipe.pipeline.train.plan.rates import Rates, rates_of
from splatpipe.pipeline.train.plan.schedule import resolve_schedule
from splatpipe.pipeline.train.plan.windows import TrainingSize
from splatpipe.pipeline.train.state import memory
from splatpipe.pipeline.train.state.checkpoint import (
    BrokenCheckpointError,
    Checkpoint,
    load_checkpoint,
    save_checkpoint,
)


def camera_at(name: str, centre: tuple[float, float, float]) -> Camera:
    pose = np.eye(4)
    pose[:3, 3] = -np.array(centre)
    return Camera(name, 100, 50, 80.0, 80.0, 50.0, 25.0, pose)


def views(count: int = 4) -> list[View]:
    cameras = [camera_at(f"{i}.png", (2.0 * i, 0.0, 0.0)) for i in range(count)]
    return [View(camera, Path(camera.name), None) for camera in cameras]


def test_long_runs_have_the_published_schedule() -> None:
    schedule = resolve_schedule(TrainConfig())
    density = schedule.density
    assert (schedule.sh_every, density.first, density.last, density.every) == (1000, 500, 15_000, 100)
    assert density.reset_every == 0
    assert resolve_schedule(TrainConfig(density="published")).density.reset_every == 3000


@pytest.mark.parametrize("iterations", [1, 7, 100, 999, 3000, 7000, 9999])
def test_short_runs_have_every_phase_and_no_reset(iterations: int) -> None:
    schedule = resolve_schedule(TrainConfig(iterations=iterations))
    assert schedule.density.reset_every == 0
    assert 1 <= schedule.density.first <= max(1, schedule.density.last) <= iterations
    assert iterations < 10 or schedule.sh_degree_at(iterations) == 3


@pytest.mark.parametrize(
    ("density", "gradient", "resets"),
    [("published", 2e-4, 3000), ("absolute", 1.2e-3, 0)],
)
def test_each_score_of_density_control_has_its_threshold(density: str, gradient: float, resets: int) -> None:
    found = resolve_schedule(TrainConfig.model_validate({"density": density})).density
    assert (found.gradient, found.last, found.reset_every) == (gradient, 15_000, resets)


def test_published_density_has_the_rates_resets_and_pruning_of_that_method_however_short_the_run() -> None:
    for iterations in (1500, 30_000):
        schedule = resolve_schedule(TrainConfig(iterations=iterations, density="published"))
        assert schedule.rates == Rates(opacity=0.05, boost=1.0, sparse=False, by_distance=False)
        assert (schedule.density.reset_every, schedule.density.prune_screen_px) == (3000, 20.0)
        ours = resolve_schedule(TrainConfig(iterations=iterations))
        assert (
            ours.rates.sparse
            and ours.rates.by_distance
            and ours.rates.opacity == 0.15
            and ours.density.prune_screen_px == 0.0
        )


def test_a_time_budget_halves_the_threshold() -> None:
    given, free = (resolve_schedule(TrainConfig(time_budget_s=seconds)).density for seconds in (60.0, 0.0))
    assert given == replace(free, gradient=0.5 * free.gradient)


@pytest.mark.parametrize(
    "wrong",
    [
        {"iterations": 0},
        {"sh_degree": 4},
        {"density": "never"},
        {"dropout": 1.0},
        {"colour": 1},
    ],
)
def test_options_out_of_bounds_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        TrainConfig.model_validate(wrong)


def test_extent_is_a_tenth_more_than_the_farthest_camera() -> None:
    assert scene_extent([view.camera for view in views(3)]) == pytest.approx(1.1 * 2.0)


def test_rate_of_positions_falls_exponentially() -> None:
    schedule = replace(resolve_schedule(TrainConfig(iterations=100)), rates=Rates())
    found = [schedule.at(place).means_rate for place in (0, 50, 100, 200)]
    assert found == pytest.approx([1.6e-4, 1.6e-5, 1.6e-6, 1.6e-6])


def test_short_runs_take_longer_steps() -> None:
    boosts = [rates_of(run).boost for run in (100, 7500, 30_000, 100_000)]
    assert boosts == [4.0, 2.0, 1.0, 1.0]
    schedule = resolve_schedule(TrainConfig(iterations=7500))
    assert schedule.at(0).means_rate == pytest.approx(2.0 * 1.6e-4)
    assert schedule.at(7500).means_rate == pytest.approx(4.0 * 1.6e-6)


def test_the_schedule_determines_each_iterations_settings() -> None:
    schedule = resolve_schedule(TrainConfig(iterations=1000, background="white"))
    first, later, flat = schedule.at(1), schedule.at(600), schedule.at(550, flat_at=500)
    assert (first.sh_degree, later.sh_degree) == (0, 3) and (first.is_observed, later.is_observed) == (True, False)
    assert (later.place, later.share) == (600, 0.6) and (flat.place, flat.share) == (1000, 1.0)
    assert first.background == later.background == (1.0, 1.0, 1.0)
    random = resolve_schedule(TrainConfig(iterations=1000, background="random"))
    assert random.at(7) == random.at(7) and random.at(7).background != random.at(8).background
    assert all(0.0 < channel < 1.0 for channel in random.at(7).background)


@pytest.mark.parametrize(("background", "behind"), [("black", 0.0), ("white", 1.0), ("random", 0.0)])
def test_how_to_render_follows_from_the_plan_and_survives_its_file(
    tmp_path: Path, background: str, behind: float
) -> None:
    config = TrainConfig.model_validate({"background": background, "antialias": behind > 0.0})
    plan = make_plan(config, views(), tiny_scene.split_of(views()), 9)
    assert TrainingPlan.from_json(plan.to_json()) == plan
    (tmp_path / "rendering.json").write_text(plan.rendering().to_json())
    found = load_rendering(tmp_path / "rendering.json")
    assert found == plan.rendering() == Rendering(behind > 0.0, (behind,) * 3, plan.near, None)


def test_coarse_photos_come_first_in_equal_shares() -> None:
    schedule = resolve_schedule(TrainConfig(iterations=12, coarse_levels=2))
    assert [size.level for size in schedule.training_sizes_until(10)] == [2, 2, 2, 1, 1, 1, 0, 0, 0, 0]
    assert resolve_schedule(TrainConfig(iterations=3)).training_sizes_until(3) == [TrainingSize()] * 3


def test_held_out_photos_are_not_trained_on() -> None:
    plan = make_plan(TrainConfig(), views(), tiny_scene.split_of(views(), 2), 9)
    assert (plan.train_views, plan.test_views) == (("1.png", "3.png"), ("0.png", "2.png"))


def test_cameras_in_one_place_are_refused_with_a_hint() -> None:
    same = [View(camera_at(f"{i}.png", (1.0, 2.0, 3.0)), Path("x"), None) for i in range(3)]
    with pytest.raises(SplatpipeError, match="one position") as raised:
        make_plan(TrainConfig(), same, tiny_scene.split_of(same), 9)
    assert raised.value.hint


def test_plan_is_written_once_and_then_reused(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    first = make_plan(TrainConfig(iterations=50), views(), tiny_scene.split_of(views(), 2), 9)
    assert load_or_write_plan(path, lambda: first) == first
    text = path.read_bytes()

    def not_called() -> TrainingPlan:
        raise AssertionError("a plan that is there is taken as it is")

    assert load_or_write_plan(path, not_called) == first
    assert path.read_bytes() == text
    assert TrainingPlan.from_json(text.decode()).digest() == first.digest()


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"format": 1}', '{"format": 99}', '{"format": 1, "options": {}}']
)
def test_broken_plan_is_written_again(tmp_path: Path, text: str) -> None:
    path = tmp_path / "plan.json"
    path.write_text(text)
    fresh = make_plan(TrainConfig(), views(), tiny_scene.split_of(views(), 2), 9)
    assert load_or_write_plan(path, lambda: fresh) == fresh
    assert json.loads(path.read_text())["format"] == 4


def test_checkpoint_reads_back(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.npz"
    arrays = {"means": np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)}
    save_checkpoint(path, "plan", Checkpoint(arrays, {"iteration": 7, "loss": 0.1}))
    back = load_checkpoint(path, "plan")
    assert back.facts == {"iteration": 7, "loss": 0.1}
    np.testing.assert_array_equal(back.arrays["means"], arrays["means"])
    assert [item.name for item in tmp_path.iterdir()] == ["checkpoint.npz"]


def test_damaged_and_foreign_checkpoints_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.npz"
    with pytest.raises(FileNotFoundError):
        load_checkpoint(path, "plan")
    save_checkpoint(path, "plan", Checkpoint({"means": np.ones((100, 3))}, {}))
    with pytest.raises(BrokenCheckpointError, match="another plan"):
        load_checkpoint(path, "other")
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    packed = bytearray(whole)
    packed[whole.index(b"PK\x01\x02") + 10] = 99  # zip's method of compression
    for broken in (b"", b"rubbish", whole[: len(whole) // 2], whole[:-10], bytes(flipped), bytes(packed)):
        path.write_bytes(broken)
        with pytest.raises(BrokenCheckpointError, match="damaged"):
            load_checkpoint(path, "plan")


def test_failed_save_keeps_the_previous_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "checkpoint.npz"
    save_checkpoint(path, "plan", Checkpoint({}, {"iteration": 1}))

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_checkpoint(path, "plan", Checkpoint({}, {"iteration": 2}))
    assert load_checkpoint(path, "plan").facts == {"iteration": 1}
    assert [item.name for item in tmp_path.iterdir()] == ["checkpoint.npz"]


def test_memory_is_exceeded_only_above_a_limit() -> None:
    assert memory.over_memory(TrainConfig(max_memory_bytes=1))
    assert not memory.over_memory(TrainConfig(max_memory_bytes=1 << 44))
    assert not memory.over_memory(TrainConfig(max_memory_bytes=0))
