"""Budgets of time and memory: the plan, that it is met, and that its limits hold."""

import hashlib
import json
import math
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import tiny_scene
import torch
from repository import SCENES, environment

from splatpipe.pipeline.engine.errors import MachineError, UsageError
from splatpipe.pipeline.engine.heap import return_free_heap
from splatpipe.pipeline.engine.machine import resident_bytes
from splatpipe.pipeline.engine.quantities import parse_bytes, parse_duration
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.render.options import EvaluateConfig
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.train import iteration, loop
from splatpipe.pipeline.train.densify import room_at
from splatpipe.pipeline.train.options import FILM_FROM_BUDGET_S, TrainConfig
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan import plan as planning_of_schedule
from splatpipe.pipeline.train.plan.budget import (
    MIN_GAUSSIANS,
    SCHEDULE_SHARE,
    SMALLEST_MEGAPIXELS,
    BudgetChoice,
    BudgetTask,
    Speed,
    Timing,
    choose,
    fit_speed,
    forecast,
)
from splatpipe.pipeline.train.plan.lengths import PART_VISITS, WHOLE_VISITS, PhotoSizes, lengths_of
from splatpipe.pipeline.train.plan.limits import (
    FIXED_BYTES,
    MAX_ITERATIONS,
    MIN_ITERATIONS,
    PIXEL_BYTES,
    SMALLEST_WINDOW,
    bytes_per_gaussian,
)
from splatpipe.pipeline.train.plan.plan import TrainingPlan, duration, make_plan
from splatpipe.pipeline.train.plan.schedule import resolve_schedule
from splatpipe.pipeline.train.plan.start import InitialGaussians
from splatpipe.pipeline.train.sizing import planning, shortage
from splatpipe.pipeline.train.sizing.measure import MachineSpeed, middle_of
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.stages import evaluate, initialize, train

SPEED = Speed(base_s=2e-3, gaussian_s=3e-7, pixel_s=3e-8, pair_s=2e-13)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90s", 90.0), ("10m", 600.0), ("1h30m", 5400.0), ("1.5h", 5400.0), ("2h5s", 7205.0), (" 1m ", 60.0)],
)
def test_durations_are_read(text: str, seconds: float) -> None:
    assert parse_duration(text, "--time-budget") == seconds


@pytest.mark.parametrize(
    "text",
    [
        "",
        " ",
        "10",
        "m",
        "-5m",
        "+5m",
        "0s",
        "0h0m",
        "1m1h",
        "1m 30s",
        "5M",
        "1e3s",
        "nan",
        "infs",
        "１０m",
        "1..5m",
        ".5m",
        "1d",
        "5ms",
        "9" * 400 + "h",
        "5m\x00",
        "10m;rm -rf",
        "0x10s",
        "1_0s",
    ],
)
def test_an_invalid_duration_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match="--time-budget") as raised:
        parse_duration(text, "--time-budget")
    assert "10m" in raised.value.hint and len(str(raised.value)) < 80


@pytest.mark.parametrize(
    ("text", "number"), [("512M", 512 * 10**6), ("8G", 8 * 10**9), ("1.5GB", 1_500_000_000), ("1T", 10**12)]
)
def test_sizes_are_read(text: str, number: int) -> None:
    assert parse_bytes(text, "--max-memory") == number


@pytest.mark.parametrize(
    "text",
    ["", "8", "G", "-8G", "0G", "0.0000000000001M", "8g", "8 G", "8Gi", "8K", "nanG", "1e3G", "８G", "9" * 99 + "G"],
)
def test_an_invalid_size_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(UsageError, match="--max-memory") as raised:
        parse_bytes(text, "--max-memory")
    assert "8G" in raised.value.hint


def test_durations_are_formatted_for_people() -> None:
    said = {4.4: "4 s", 60.0: "1 min", 400.0: "6 min 40 s", 7500.0: "2 h 05 min", 7200.0: "2 h"}
    assert {seconds: duration(seconds) for seconds in said} == said


def test_a_speed_is_recovered_from_its_timings() -> None:
    sizes = [(n, p) for n in (5_000, 60_000) for p in (100_000, 400_000, 1_600_000)]
    fitted = fit_speed([Timing(n, p, SPEED.seconds(n, p)) for n, p in sizes])
    for n, p in ((7_000, 2e5), (200_000, 1e6)):
        assert fitted.seconds(n, p) == pytest.approx(SPEED.seconds(n, p), rel=1e-6)


def test_a_speed_separates_costs_that_windows_avoid() -> None:
    true = replace(SPEED, seen_s=5e-7)
    cases = [(n, p, share) for n in (5_000, 60_000) for p, share in ((1e5, 1.0), (4e5, 1.0), (1e5, 0.25), (5e4, 0.05))]
    fitted = fit_speed([Timing(n, int(p), true.seconds(n, p, share), share) for n, p, share in cases])
    for n, p, share in ((200_000, 4e5, 0.02), (7_000, 1e6, 1.0)):
        assert fitted.seconds(n, p, share) == pytest.approx(true.seconds(n, p, share), rel=1e-6)


def test_a_forecast_counts_windows_as_they_are_cut() -> None:
    footage = PhotoSizes(((2304, 1728, 50),), 500_000)
    schedule = resolve_schedule(TrainConfig(least_iterations=1000, max_gaussians=50_000), footage)
    speed, sizes = replace(SPEED, seen_s=5e-7), schedule.training_sizes_until(schedule.iterations)
    assert len(set(sizes)) == 3
    rooms = [room_at(schedule.density, 8_000, number) for number in range(1, len(sizes) + 1)]
    each = [
        speed.seconds(room, footage.pixels(size), footage.share(size)) for room, size in zip(rooms, sizes, strict=True)
    ]
    assert forecast(speed, schedule, 8_000, footage) == pytest.approx(math.fsum(each), rel=0.01)


def test_the_window_that_is_timed_is_the_middle_of_its_photo() -> None:
    camera = tiny_scene.cameras()[0]
    colour = torch.rand(camera.height, camera.width, 3)
    window = middle_of(TrainingPhoto(camera, colour, None))
    left, top = (camera.width - window.camera.width) // 2, (camera.height - window.camera.height) // 2
    assert window.camera.uncropped() == camera and window.share == pytest.approx(0.25, abs=0.01)
    assert torch.equal(window.colour, colour[top : top + window.camera.height, left : left + window.camera.width])


def test_a_size_whose_windows_would_be_visited_too_rarely_is_not_chosen() -> None:
    sizes = ((2304, 1728, 50),)
    tasks = [
        BudgetTask(tiny_scene.plain(), 8_000, 0, sizes, 500_000, SPEED, 0.0, s) for s in (15.0, 60.0, 240.0, 3600.0)
    ]
    chosen = [choose(task) for task in tasks]
    found = [choice.options.max_megapixels or tasks[0].megapixels for choice in chosen]
    assert found == sorted(found) and found[0] < 1.0 < found[-1] == tasks[0].megapixels
    for task, choice, size in zip(tasks, chosen, found, strict=True):
        assert 0.9 * task.seconds <= choice.forecast_s <= SCHEDULE_SHARE * task.seconds
        level, count = lengths_of(choice.options, task.footage(size))[-1]
        assert level == 0 and count >= 0.99 * PART_VISITS * task.footage(size).parts(0)
        assert not choice.is_most  # the time is spent, even where the loss is flat


def test_no_cost_is_below_zero_whatever_was_measured() -> None:
    noisy = [Timing(10, 100, 0.02), Timing(10, 400, 0.01), Timing(900, 100, 0.005), Timing(900, 400, 0.03)]
    fitted = fit_speed(noisy)
    assert min(fitted.base_s, fitted.gaussian_s, fitted.pixel_s, fitted.pair_s) >= 0.0
    assert fit_speed([Timing(10, 100, 0.02)]).seconds(10, 100) == pytest.approx(0.02)
    with pytest.raises(ValueError, match="timings"):
        fit_speed([])


def test_forecast_is_the_sum_over_the_iterations() -> None:
    schedule = resolve_schedule(tiny_scene.plain(iterations=2400, max_gaussians=50_000, coarse_levels=2))
    levels = [size.level for size in schedule.training_sizes_until(2400)]
    each = [SPEED.seconds(room_at(schedule.density, 8_000, i + 1), 4e5 / 4**level) for i, level in enumerate(levels)]
    assert forecast(SPEED, schedule, 8_000, PhotoSizes(((800, 500, 32),))) == pytest.approx(math.fsum(each), rel=0.01)


def task_of(seconds: float, photos: int = 30, size: float = 0.5, cap: int = 1_000_000) -> BudgetTask:
    """8,000 sparse points."""
    config = tiny_scene.plain(time_budget_s=seconds, max_gaussians=cap)
    return BudgetTask(config, 8_000, 0, ((1000, round(1000 * size), photos),), 0, SPEED, 0.0, seconds)


def plan_for(seconds: float, photos: int = 30, size: float = 0.5, cap: int = 1_000_000) -> BudgetChoice:
    return choose(task_of(seconds, photos, size, cap))


@pytest.mark.parametrize("seconds", [10.0, 30.0, 60.0, 300.0, 600.0, 3600.0])
def test_plans_fill_their_time(seconds: float) -> None:
    choice = plan_for(seconds)
    assert 0.9 * seconds <= choice.forecast_s <= SCHEDULE_SHARE * seconds


def test_more_time_never_plans_less() -> None:
    plans = [plan_for(seconds) for seconds in (5.0, 15.0, 60.0, 240.0, 900.0, 3600.0, 14_400.0)]
    sizes = [plan.options.max_megapixels or 0.5 for plan in plans]
    caps = [plan.options.max_gaussians for plan in plans]
    assert sizes == sorted(sizes) and sizes[0] < 0.5 == sizes[-1]
    assert caps == sorted(caps) and caps[0] < caps[-1]
    assert plans[-1].options.iterations > plans[0].options.iterations


def test_no_limit_is_exceeded_however_much_time_there_is() -> None:
    choice = plan_for(1e6, cap=20_000)
    assert choice.options.max_gaussians == 20_000 and choice.iterations == choice.last_iteration == MAX_ITERATIONS
    assert choice.options.max_megapixels == 0.0


def test_too_little_time_still_plans_the_smallest_training() -> None:
    choice = choose(replace(task_of(0.01, size=2.0), sparse=500_000))
    assert choice.options.iterations == MIN_ITERATIONS and choice.options.max_gaussians == MIN_GAUSSIANS
    assert choice.options.max_megapixels == SMALLEST_MEGAPIXELS


def test_every_photo_is_seen_often_enough_before_photos_grow() -> None:
    many = plan_for(300.0, photos=1_000)
    assert many.iterations >= 0.99 * WHOLE_VISITS * 1_000
    assert 0.0 < many.options.max_megapixels < (plan_for(300.0, photos=10).options.max_megapixels or 0.5)


@pytest.mark.parametrize("seconds", [5.0, 15.0, 60.0])
def test_dense_points_reduce_neither_photo_size_nor_iterations(seconds: float) -> None:
    """A plan drops them first, so it need not reserve room for them: only the forecast counts those that are kept."""
    bare, dense = choose(task_of(seconds)), choose(replace(task_of(seconds), dense=50_000))
    assert dense.options.max_megapixels == bare.options.max_megapixels
    assert dense.options.iterations >= 0.9 * bare.options.iterations
    assert dense.options.max_gaussians >= 0.8 * bare.options.max_gaussians
    assert dense.forecast_s <= SCHEDULE_SHARE * seconds


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `dataset` and `init.ply`."""
    folder = tmp_path_factory.mktemp("scene")
    tiny_scene.write_dataset(folder / "dataset")
    parts = {"undistort.dataset": folder / "dataset"}
    initialize.run(InitializeConfig(dense=False), Inputs(parts, folder), folder, tiny_scene.Recorder())
    return folder


def make_inputs(scene: Path, began_s: float = 0.0) -> Inputs:
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    parts |= tiny_scene.split_part(scene / "dataset", 4)
    return Inputs(parts, scene, machine=Machine("cpu", 1, began_s))


def read_plan(out: Path) -> TrainingPlan:
    return TrainingPlan.from_json((out / "plan.json").read_text())


def digest(out: Path) -> str:
    return hashlib.sha256((out / "model.ply").read_bytes() + (out / "history.json").read_bytes()).hexdigest()


def test_a_budget_is_planned_reported_and_ends_the_training(scene: Path, tmp_path: Path) -> None:
    recorder = tiny_scene.Recorder()
    summary = train.run(tiny_scene.plain(time_budget_s=5.0), make_inputs(scene), tmp_path, recorder)
    plan = read_plan(tmp_path)
    assert 0.0 < plan.train_seconds < 5.0
    assert summary["planned_iterations"] == plan.options.iterations
    assert 0 < summary["iterations"] <= plan.last_iteration
    assert recorder.notes[0] == plan.described() and "5 s budget" in recorder.notes[0]
    assert summary["iterations"] >= plan.options.iterations or "time budget used up" in recorder.notes[1]
    assert len(read_splat(tmp_path / "model.ply")) == summary["gaussians"] > 0


def test_a_budget_spent_before_training_gives_a_minimal_training_and_one_warning(scene: Path, tmp_path: Path) -> None:
    recorder = tiny_scene.Recorder()
    summary = train.run(
        TrainConfig(time_budget_s=6.0), make_inputs(scene, time.monotonic() - 100.0), tmp_path, recorder
    )
    assert len(recorder.warnings) == 1
    assert re.search("stages before training took 1[0-9]{2} s of the 6 s", recorder.warnings[0])
    assert 0.0 < read_plan(tmp_path).train_seconds <= 0.1 * 6.0
    assert summary["iterations"] >= 1


def trained(scene: Path, out: Path, plan: TrainingPlan, monkeypatch: pytest.MonkeyPatch) -> tiny_scene.Recorder:
    """Train by an existing plan: measuring again would fail the test."""
    out.mkdir(exist_ok=True)
    if not (out / "plan.json").exists():
        (out / "plan.json").write_text(plan.to_json())
    monkeypatch.setattr(planning, "measure", None)
    recorder = tiny_scene.Recorder()
    train.run(tiny_scene.plain(time_budget_s=600.0), make_inputs(scene), out, recorder)
    return recorder


@pytest.fixture
def plan(scene: Path, tmp_path: Path) -> TrainingPlan:
    """Return the plan of a budget with time for more iterations than it has."""
    (tmp_path / "first").mkdir()
    train.run(TrainConfig(iterations=60), make_inputs(scene), tmp_path / "first", tiny_scene.Recorder())
    made = read_plan(tmp_path / "first")
    budgeted = made.options.model_copy(update={"time_budget_s": 600.0})
    return TrainingPlan(**{**vars(made), "options": budgeted, "megapixels": 0.002, "train_seconds": 500.0})


class Kill(BaseException):
    """Stands in for a kill."""


def test_a_killed_training_keeps_its_plan_and_ends_with_the_same_bits(
    scene: Path, tmp_path: Path, plan: TrainingPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained(scene, tmp_path / "whole", plan, monkeypatch)
    step = shortage.iterate

    def dying(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto) -> None:
        if state.iteration + 1 == 31:
            raise Kill
        step(state, plan, photo)

    with monkeypatch.context() as patch, pytest.raises(Kill):
        patch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(loop, "CHECKPOINT_SHARE", 1e9)
        patch.setattr(shortage, "iterate", dying)
        trained(scene, tmp_path / "killed", plan, patch)
    assert (tmp_path / "killed" / loop.CHECKPOINT).exists()
    recorder = trained(scene, tmp_path / "killed", plan, monkeypatch)
    assert read_plan(tmp_path / "killed") == plan
    assert not recorder.warnings and recorder.notes == [plan.described()]
    assert digest(tmp_path / "killed") == digest(tmp_path / "whole")


def test_the_deadline_ends_after_a_whole_iteration_and_changes_none(
    scene: Path, tmp_path: Path, plan: TrainingPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained(scene, tmp_path / "whole", plan, monkeypatch)
    short = TrainingPlan(**{**vars(plan), "train_seconds": 1e-9})
    recorder = trained(scene, tmp_path / "short", short, monkeypatch)
    assert "time budget used up after 1 of 60 planned iterations" in recorder.notes[-1]
    curve = json.loads((tmp_path / "short/history.json").read_text())["curve"]
    assert [point["iteration"] for point in curve] == [1]
    assert len(read_splat(tmp_path / "short/model.ply")) == plan.initial_gaussians


def test_iterations_beyond_the_schedule_fill_the_time_and_change_none_before(
    scene: Path, tmp_path: Path, plan: TrainingPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained(scene, tmp_path / "schedule", plan, monkeypatch)
    recorder = trained(scene, tmp_path / "longer", TrainingPlan(**{**vars(plan), "last_iteration": 80}), monkeypatch)
    assert recorder.steps[-1] == (80, 80) and recorder.notes == [plan.described()]
    longer, schedule = (json.loads((tmp_path / name / "history.json").read_text()) for name in ("longer", "schedule"))
    assert longer["density"] == schedule["density"]
    assert longer["curve"][0] == schedule["curve"][0]
    assert [point["iteration"] for point in longer["curve"]] == [50, 80]
    assert plan.schedule.at(80).means_rate == plan.schedule.at(60).means_rate
    assert digest(tmp_path / "longer") != digest(tmp_path / "schedule")


def test_photos_are_trained_on_at_the_planned_size_and_measured_at_the_datasets(
    scene: Path, tmp_path: Path, plan: TrainingPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    trained(scene, out, plan, monkeypatch)
    widths = {point["width"] for point in json.loads((out / "history.json").read_text())["curve"]}
    assert len(widths) == 1 and widths.pop() < tiny_scene.WIDTH
    parts = {"clean.model": out / "model.ply", "train.rendering": out / "rendering.json", "train.sky": out / "sky.npz"}
    parts |= {"undistort.dataset": scene / "dataset"} | tiny_scene.split_part(scene / "dataset", 4)
    evaluate.run(EvaluateConfig(), Inputs(parts, scene), out, tiny_scene.Recorder())
    for view in json.loads((out / "metrics.json").read_text())["per_view"]:
        assert (view["width"], view["height"]) == (tiny_scene.WIDTH, tiny_scene.HEIGHT) and view["psnr"] > 10.0


def test_initial_gaussians_that_do_not_fit_are_thinned_with_a_warning_or_refused(scene: Path, tmp_path: Path) -> None:
    count = len(read_splat(scene / "init.ply"))
    return_free_heap()  # memory of earlier tests, which the plan would not count
    config = tiny_scene.plain(iterations=10, max_memory_bytes=resident_bytes() + FIXED_BYTES // 2)
    with pytest.raises(MachineError, match="GB already") as raised:
        train.run(config, make_inputs(scene), tmp_path, tiny_scene.Recorder())
    assert "--max-memory at least" in raised.value.hint
    assert not (tmp_path / "plan.json").exists()
    assert count < MIN_GAUSSIANS


def test_memory_that_holds_the_sparse_points_takes_dense_ones_without_a_warning(
    plan: TrainingPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planning, "resident_bytes", lambda: 0)
    pixels = tiny_scene.WIDTH * tiny_scene.HEIGHT
    limit = FIXED_BYTES + PIXEL_BYTES * pixels + 2000 * bytes_per_gaussian(plan.options.sh_degree)
    limited = plan.of(plan.options.model_copy(update={"max_memory_bytes": limit}))
    for sparse, warnings in ((1500, 0), (2500, 1)):
        recorder = tiny_scene.Recorder()
        capped = planning.within_memory(replace(limited, initial_gaussians=50_000), sparse, recorder)
        assert capped.options.max_gaussians == 2000
        assert len(recorder.warnings) == warnings
    assert "2,000 Gaussians, fewer than the 2,500 sparse points" in recorder.warnings[0]


def test_little_memory_takes_smaller_windows_before_it_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "resident_bytes", lambda: 0)
    views = [View(camera.scaled(2304, 1728), Path("photo.jpg"), None) for camera in tiny_scene.cameras()]
    plan = make_plan(TrainConfig(least_iterations=100), views, tiny_scene.split_of(views, 4), 150, 500_000)
    of_one, room = bytes_per_gaussian(3), 100_000_000
    limited = plan.of(plan.options.model_copy(update={"max_memory_bytes": FIXED_BYTES + room}))
    fitted = planning.within_memory(limited, 150, tiny_scene.Recorder())
    assert fitted.window_pixels == pytest.approx(0.25 * room / PIXEL_BYTES, abs=1)
    assert (
        fitted.options.max_gaussians * of_one >= 0.74 * room and fitted.schedule.iterations > plan.schedule.iterations
    )
    least = FIXED_BYTES + PIXEL_BYTES * SMALLEST_WINDOW + MIN_GAUSSIANS * of_one
    tight = limited.of(plan.options.model_copy(update={"max_memory_bytes": least}))
    assert planning.within_memory(tight, 5000, tiny_scene.Recorder()).window_pixels == SMALLEST_WINDOW
    refused = limited.of(plan.options.model_copy(update={"max_memory_bytes": FIXED_BYTES + of_one}))
    with pytest.raises(MachineError, match="need memory") as raised:
        planning.within_memory(refused, 5000, tiny_scene.Recorder())
    assert "at least" in raised.value.hint


TRAIN_IN_LITTLE_MEMORY = """
import json, sys
from pathlib import Path
import tiny_scene
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.engine.runs.peak_memory import peak_memory_bytes
from splatpipe.stages import train
from splatpipe.pipeline.train.plan import plan
from splatpipe.pipeline.train.sizing.measure import middle_of
from splatpipe.pipeline.train.plan.lengths import PART_VISITS, WHOLE_VISITS, lengths_of
from splatpipe.pipeline.train.plan.limits import FIXED_BYTES
from splatpipe.pipeline.engine.machine import resident_bytes

scene, out = Path(sys.argv[1]), Path(sys.argv[2])
limit = resident_bytes() + FIXED_BYTES + int(sys.argv[3])
parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
parts |= tiny_scene.split_part(scene / "dataset", 4)
inputs = Inputs(parts, scene, machine=Machine("cpu", 1))
config = tiny_scene.plain(iterations=40, max_memory_bytes=limit)
plan.resolve_schedule = tiny_scene.resolver(first=2, last=40, every=1, gradient=1e-12, prune_opacity=0.0)
recorder = tiny_scene.Recorder()
summary = train.run(config, inputs, out, recorder)
print(json.dumps({"limit": limit, "peak": peak_memory_bytes(), **summary, "warnings": recorder.warnings}))
"""


def in_little_memory(scene: Path, out: Path, room: int) -> dict[str, object]:
    out.mkdir()
    command = [sys.executable, "-c", TRAIN_IN_LITTLE_MEMORY, str(scene), str(out), str(room)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment(SCENES))
    assert done.returncode == 0, done.stderr
    output: dict[str, object] = json.loads(done.stdout)
    return output


def test_a_memory_limit_binds_and_the_resident_memory_stays_below_it(scene: Path, tmp_path: Path) -> None:
    room = 30_000_000
    output = in_little_memory(scene, tmp_path / "out", room)
    cap = read_plan(tmp_path / "out").options.max_gaussians
    assert cap < room // bytes_per_gaussian(TrainConfig().sh_degree) < TrainConfig().max_gaussians
    assert 0.8 * cap < output["gaussians"] <= cap  # type: ignore[operator]  # halved again and again, some are never seen
    assert output["peak"] <= output["limit"]  # type: ignore[operator]


def test_growth_ends_when_memory_runs_out_and_pruning_continues(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(iteration, "over_memory", lambda options: True)
    limits = {"first": 10, "last": 60, "every": 10, "gradient": 1e-9, "prune_opacity": 0.08, "reset_every": 25}
    monkeypatch.setattr(planning_of_schedule, "resolve_schedule", tiny_scene.resolver(**limits))
    recorder = tiny_scene.Recorder()
    train.run(tiny_scene.plain(iterations=60), make_inputs(scene), tmp_path, recorder)
    assert len(recorder.warnings) == 1 and "no Gaussians are added after iteration 10" in recorder.warnings[0]
    history = json.loads((tmp_path / "history.json").read_text())
    assert history["growth_ended"] == 10 and history["resets"] == [25, 50]
    first, *rest = history["density"]
    assert first["iteration"] == 10 and first["cloned"] + first["split"] > 0
    assert [event["iteration"] for event in rest] == [20, 30, 40, 50, 60]
    assert not any(event["cloned"] + event["split"] for event in rest) and sum(event["pruned"] for event in rest) > 0
    left = first["gaussians"] - sum(event["pruned"] for event in rest)
    assert rest[-1]["gaussians"] == left == len(read_splat(tmp_path / "model.ply"))


def test_a_budget_long_enough_for_a_film_reserves_time_for_it() -> None:
    """Ten seconds of film take as long as measuring forty photos; shorter budgets have no film."""
    views = [View(camera, Path("photo.jpg"), None) for camera in tiny_scene.cameras()]
    measured = MachineSpeed(SPEED, 0.0, 2.0)
    left = []
    for budget in (FILM_FROM_BUDGET_S - 1.0, FILM_FROM_BUDGET_S):
        config = TrainConfig(time_budget_s=budget)
        plan = make_plan(config, views, tiny_scene.split_of(views, 4), 100)
        scene = planning.PlanningInput(config, InitialGaussians(tiny_scene.true_model(), 100), views, 3, Machine())
        left.append(planning._task(plan, scene, measured, 500.0).seconds)
    size = 1e-6 * tiny_scene.WIDTH * tiny_scene.HEIGHT
    assert left[0] - left[1] == pytest.approx(planning.FILM_VIEWS * 2.0 * size)
