"""Early stopping: decided by the loss on training photos alone, after a tail, at the same iteration in every run."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.train import flatness, loop
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.lengths import Stretch
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.plan.schedule import resolve_schedule
from splatpipe.pipeline.train.sizing import shortage
from splatpipe.pipeline.train.state.history import History
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.stages import initialize, train

FEW = tiny_scene.plain(iterations=200, densify=False, exposure="affine", dropout=0.1)
FLAT = FEW.model_copy(update={"stop_when_flat": 0.9})  # so much that any curve is flat
SIZES = FLAT.model_copy(update={"coarse_levels": 1, "sh_degree": 1})  # half of the iterations are at half the size
PARTS = ("model.ply", "history.json", "exposures.json", "plan.json")


def make_plan(iterations: int, threshold: float, last: int = 0, **options: object) -> TrainingPlan:
    fields = TrainConfig().model_dump() | {"iterations": iterations, "stop_when_flat": threshold} | options
    config = TrainConfig.model_validate(fields)
    return TrainingPlan(config, resolve_schedule(config), 1.0, 0.01, ("a", "b"), (), 0.1, 10, last or iterations)


def power_law(exponent: float, noise: float = 0.0, until: int = 5000) -> list[tuple[int, float]]:
    """Epochs of 100 iterations from the 3501st on."""
    middles = np.arange(3550, until, 100)
    scatter = 1.0 + noise * np.random.default_rng(1).standard_normal(len(middles))
    return [(int(m), float(0.1 * (m / 1000.0) ** exponent * s)) for m, s in zip(middles, scatter, strict=True)]


@pytest.mark.parametrize("exponent", [-0.5, -0.1, 0.0, 0.2])
def test_expected_gain_of_a_power_law_is_exact(exponent: float) -> None:
    gain = flatness.expected_gain(power_law(exponent), 7000)
    assert gain == pytest.approx(1.0 - (7000 / 4950) ** exponent, abs=1e-9)


def test_noise_raises_the_expected_gain_and_does_not_end_a_training() -> None:
    plan = make_plan(7000, 0.01)
    assert flatness.is_flat(power_law(-0.001), plan, 5000)
    assert flatness.expected_gain(power_law(-0.001, noise=0.05), 7000) > 0.01
    assert not flatness.is_flat(power_law(-0.001, noise=0.05), plan, 5000)


def test_a_falling_curve_few_epochs_and_the_schedules_end_are_not_flat() -> None:
    plan = make_plan(7000, 0.05)
    assert not flatness.is_flat(power_law(-0.5), plan, 5000)
    assert not flatness.is_flat(power_law(0.0)[: flatness.MIN_EPOCHS - 1], plan, 4200)
    assert not flatness.is_flat(power_law(0.0, until=6500), plan, 6500)  # a tail would end after the schedule
    assert not flatness.is_flat([(middle, 0.0) for middle, _ in power_law(0.0)], plan, 5000)


def test_nothing_is_judged_before_density_control_all_degrees_and_full_size() -> None:
    schedule = make_plan(1000, 0.1).schedule
    assert flatness.final_phase_from(schedule) == 3 * schedule.sh_every == 600
    longer = replace(schedule, density=replace(schedule.density, last=700))
    assert flatness.final_phase_from(longer) == 700
    unchanging = replace(schedule, sh_degree=1, density=replace(longer.density, on=False))
    assert flatness.final_phase_from(unchanging) == 200
    assert flatness.final_phase_from(replace(schedule, stretches=(Stretch(1, 0, 900), Stretch(0, 0, 1000)))) == 900


def test_before_the_finest_size_losses_count_since_growth_begins_and_opacities_were_reset() -> None:
    schedule = replace(make_plan(1000, 0.1).schedule, stretches=(Stretch(1, 0, 700), Stretch(0, 0, 1000)))
    assert flatness.judged_from(schedule, 650, []) == schedule.density.first > 0
    assert flatness.judged_from(schedule, 650, [300, 500]) == 500
    three = replace(schedule, stretches=(Stretch(2, 0, 600), *schedule.stretches))
    assert flatness.judged_from(three, 650, [300]) == 600
    assert flatness.judged_from(three, 701, [300]) == flatness.final_phase_from(three)


def test_a_size_is_flat_where_all_iterations_that_are_left_would_gain_too_little() -> None:
    plan = make_plan(7000, 0.05)
    sizes = (Stretch(1, 0, 6000), Stretch(0, 0, 7000))
    plan = replace(plan, schedule=replace(plan.schedule, stretches=sizes))
    assert flatness.is_flat(power_law(-0.1), plan, 5000) == (1.0 - (7000 / 4950) ** -0.1 < 0.05)
    assert flatness.is_flat(power_law(-0.1, until=5950), plan, 5900)
    assert not flatness.is_flat(power_law(0.0, until=6050), plan, 6000)  # it ends here anyway


def test_iterations_saved_at_a_size_go_to_the_finest_by_its_pixels() -> None:
    plan = make_plan(10_000, 0.1, last=15_000)
    sizes = (Stretch(2, 0, 4000), Stretch(1, 0, 6000), Stretch(0, 0, 10_000))
    schedule = replace(plan.schedule, stretches=sizes, density=replace(plan.schedule.density, reset_until=4000))
    plan = replace(plan, schedule=schedule, sizes=((400, 400, 2),))
    assert plan.after([]) is plan
    sooner = plan.after([2000])
    assert sooner.schedule.stretches == (Stretch(2, 0, 2000), Stretch(1, 0, 4000), Stretch(0, 0, 8125))
    assert sooner.schedule.iterations == 8125 and sooner.last_iteration == 13_125
    assert sooner.schedule.density.last == 4000 + 4125 // 2 and sooner.schedule.density.reset_until == 2000
    twice = plan.after([2000, 3000])
    assert twice.schedule.stretches[1:] == (Stretch(1, 0, 3000), Stretch(0, 0, 7375))
    assert twice.schedule.density.reset_until == 2000
    assert twice.schedule.training_sizes_until(3000) == sooner.schedule.training_sizes_until(3000)


def test_the_tail_runs_through_the_rest_of_the_schedule_without_a_jump() -> None:
    plan = make_plan(7000, 0.1)
    assert flatness.ends_at(plan, 0) == 7000 and flatness.ends_at(plan, 5000) == 5500
    assert flatness.ends_at(replace(plan, last_iteration=5200), 5000) == 5200
    places = [plan.schedule.place(iteration, 5000) for iteration in range(4990, 5501)]
    assert places[:11] == list(range(4990, 5001)) and places[-1] == 7000
    assert set(np.diff(places[10:])) == {4}
    assert plan.schedule.at(5500, 5000).means_rate == plan.schedule.at(7000).means_rate
    assert plan.schedule.place(6000, 0) == 6000


def test_an_epoch_of_windows_counts_as_one_with_its_own_middle() -> None:
    plan, history = make_plan(1000, 0.1), History()
    history.add_loss(torch.tensor(0.5))
    flatness.end_epoch(history, plan, 700, 90)
    flatness.end_epoch(history, plan, 700, 101)  # it began before losses count
    assert flatness.judged_from(plan.schedule, 700, []) == 600
    assert history.epochs == [(655, 0.5)]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `dataset` and `init.ply`."""
    folder = tmp_path_factory.mktemp("scene")
    tiny_scene.write_dataset(folder / "dataset")
    inputs = Inputs({"undistort.dataset": folder / "dataset"}, folder)
    initialize.run(InitializeConfig(dense=False), inputs, folder, tiny_scene.Recorder())
    return folder


def trained(scene: Path, out: Path, config: TrainConfig) -> tuple[dict[str, object], tiny_scene.Recorder]:
    out.mkdir(exist_ok=True)
    parts = {"undistort.dataset": scene / "dataset", "initialize.splat": scene / "init.ply"}
    parts |= tiny_scene.split_part(scene / "dataset", 4)
    inputs = Inputs(parts, scene, machine=Machine("cpu", 1))
    recorder = tiny_scene.Recorder()
    return dict(train.run(config, inputs, out, recorder)), recorder


def test_a_flat_training_ends_early_and_says_so(scene: Path, tmp_path: Path) -> None:
    summary, recorder = trained(scene, tmp_path, FLAT)
    flat_at = summary["flat_at"]
    assert isinstance(flat_at, int) and flat_at % 6 == 0 and flat_at >= 15 + 6 * flatness.MIN_EPOCHS
    end = flat_at + round(0.1 * flat_at)
    assert summary["iterations"] == end < summary["planned_iterations"] == 200
    assert recorder.steps[-1] == (end, end)
    assert any("flat" in note and f"{end:,} of 200" in note for note in recorder.notes)
    history = json.loads((tmp_path / "history.json").read_text())
    assert history["flat_at"] == flat_at and history["curve"][-1]["iteration"] == end


def test_a_training_that_still_improves_runs_to_its_end_with_the_same_bits(scene: Path, tmp_path: Path) -> None:
    off, _ = trained(scene, tmp_path / "off", FEW)
    on, recorder = trained(scene, tmp_path / "on", FEW.model_copy(update={"stop_when_flat": 1e-3}))
    assert on["iterations"] == off["iterations"] == 200 and "flat_at" not in on and not recorder.notes
    for part in ("model.ply", "history.json", "exposures.json"):
        assert (tmp_path / "on" / part).read_bytes() == (tmp_path / "off" / part).read_bytes()


def test_a_size_whose_loss_is_flat_is_followed_by_larger_photos_at_once(scene: Path, tmp_path: Path) -> None:
    summary, recorder = trained(scene, tmp_path, SIZES)
    assert summary["sizes_ended"] == [6 * flatness.MIN_EPOCHS]
    assert any("flat after 48 iterations: continuing with larger photos, to 161" in note for note in recorder.notes)
    history = json.loads((tmp_path / "history.json").read_text())
    assert {point["width"] for point in history["curve"]} == {tiny_scene.WIDTH}  # from iteration 50 on
    assert history["sizes_ended"] == [48] and history["flat_at"] == summary["flat_at"] == 96
    assert summary["iterations"] == 106 and recorder.steps[-1] == (106, 106)


def test_a_training_that_may_not_end_early_still_ends_its_smaller_sizes(scene: Path, tmp_path: Path) -> None:
    trained(scene, tmp_path / "any", SIZES)
    (tmp_path / "planned").mkdir()
    plan = replace(TrainingPlan.from_json((tmp_path / "any/plan.json").read_text()), ends_when_flat=False)
    (tmp_path / "planned/plan.json").write_text(plan.to_json())
    summary, _ = trained(scene, tmp_path / "planned", SIZES)
    assert summary["sizes_ended"] == [48] and "flat_at" not in summary and summary["iterations"] == 161


@pytest.mark.parametrize(("config", "before_end"), [(FLAT, 3), (SIZES, 20)])
def test_a_killed_training_ends_early_at_the_same_iteration_with_the_same_bits(
    scene: Path, tmp_path: Path, config: TrainConfig, before_end: int
) -> None:
    whole, _ = trained(scene, tmp_path / "whole", config)
    step = shortage.iterate

    def dying(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto) -> None:
        if state.iteration + 1 == int(str(whole["iterations"])) - before_end:
            raise KeyboardInterrupt
        step(state, plan, photo)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(loop, "CHECKPOINT_SHARE", 1e9)
        patch.setattr(shortage, "iterate", dying)
        trained(scene, tmp_path / "killed", config)
    resumed, _ = trained(scene, tmp_path / "killed", config)
    assert resumed["iterations"] == whole["iterations"] and resumed["flat_at"] == whole["flat_at"]
    for part in PARTS:
        assert (tmp_path / "killed" / part).read_bytes() == (tmp_path / "whole" / part).read_bytes()
