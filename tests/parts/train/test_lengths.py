"""Lengths of trainings: derived from the photos and their size, or from a given number."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pytest
import tiny_scene

from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.lengths import (
    MAX_FIRST_ITERATIONS,
    MIN_PART_VISITS,
    PART_VISITS,
    WHOLE_VISITS,
    PhotoSizes,
    Stretch,
    divided,
    growth_until,
    lengths,
    lengths_of,
    stretches,
)
from splatpipe.pipeline.train.plan.limits import PIXEL_BYTES, SMALLEST_WINDOW, window_within
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan
from splatpipe.pipeline.train.plan.schedule import resolve_schedule
from splatpipe.pipeline.train.plan.windows import TrainingSize

WINDOW = 500_000
PHOTOS = (11, 50, 167, 500, 1000)
SIZES = {0.3: (640, 480), 1.0: (1152, 864), 4.0: (2304, 1728), 20.0: (5184, 3888)}


def footage_of(photos: int, size: float, window: int = WINDOW) -> PhotoSizes:
    return PhotoSizes(((*SIZES[size], photos),), window)


@pytest.mark.parametrize("photos", PHOTOS)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("least", [1500, 7000, 30_000])
def test_every_window_of_every_photo_is_visited_often_enough_at_every_size(
    photos: int, size: float, least: int
) -> None:
    footage = footage_of(photos, size)
    found = lengths(footage, least)
    assert [level for level, _ in found] == list(range(footage.first_level, -1, -1))
    (first, whole), *finer = found
    assert footage.parts(first) == photos and whole >= WHOLE_VISITS * photos
    assert all(count >= PART_VISITS * footage.parts(level) for level, count in finer)
    assert least <= sum(count for _, count in found)
    sizes = [TrainingSize(level, footage.window_at(level)) for level, _ in found]
    assert all(
        0.0 < footage.pixels(each_size) <= WINDOW and footage.largest(each_size) <= WINDOW for each_size in sizes
    )
    assert growth_until(found) == sum(count for _, count in found[:-1]) + found[-1][1] // 2


def test_few_photos_take_the_minimum_and_more_take_proportionally_more() -> None:
    totals = {photos: sum(count for _, count in lengths(footage_of(photos, 4.0), 7000)) for photos in PHOTOS}
    assert 7000 <= totals[11] < 7600 and list(totals.values()) == sorted(totals.values())
    assert totals[1000] == 2 * totals[500]
    # The pixels trained on for 50 photos: at most 1.4 times those of 7,000 iterations at 0.5 megapixels.
    footage = footage_of(50, 4.0)
    pixels = sum(
        count * footage.pixels(TrainingSize(level, footage.window_at(level))) for level, count in lengths(footage, 7000)
    )
    assert 0.7 < pixels / (7000 * 0.5e6) < 1.4


def test_a_given_number_is_exact_and_the_excess_over_auto_goes_to_the_finest_size() -> None:
    footage = footage_of(50, 4.0)
    auto = lengths(footage, 7000)
    for iterations in (1, 2, 99, 5001, 7000, 31_017):
        assert sum(count for _, count in divided(footage, 7000, iterations)) == iterations
    total = sum(count for _, count in auto)
    assert divided(footage, 7000, total) == auto
    assert divided(footage, 7000, 5 * total) == [*auto[:-1], (0, auto[-1][1] + 4 * total)]
    fewer = divided(footage, 7000, 3 * total // 4)
    assert all(abs(count - 0.75 * wanted) <= 1 for (_, count), (_, wanted) in zip(fewer, auto, strict=True))
    # Whatever the minimum length of a training, its first size is trained no longer than needed.
    assert lengths(footage, 300_000)[0] == (2, MAX_FIRST_ITERATIONS)
    assert lengths(footage_of(500, 4.0), 7000)[0] == (2, 10_000)
    assert divided(footage_of(50, 0.3), 7000, 600) == [(0, 600)]


def test_a_size_that_a_short_run_would_hardly_use_is_left_out() -> None:
    footage = footage_of(50, 4.0)
    last = [divided(footage, 7000, iterations)[-1] for iterations in (300, 2000, 4000, 15_000)]
    assert [level for level, _ in last] == [2, 2, 1, 0]
    assert all(count >= MIN_PART_VISITS * footage.parts(level) for level, count in last[2:])


def test_photos_of_several_sizes_begin_where_half_of_them_fit_in_whole() -> None:
    mixed = PhotoSizes(((*SIZES[0.3], 60), (*SIZES[20.0], 40)), WINDOW)
    assert mixed.first_level == 0 and mixed.parts(0) > mixed.photos
    assert mixed.window_at(0) == WINDOW and mixed.share(TrainingSize(0, WINDOW)) < 1.0
    assert PhotoSizes(((*SIZES[20.0], 40),), 0).first_level == 0


def test_phases_are_the_lengths_preceded_by_the_options_halvings() -> None:
    footage = footage_of(50, 4.0)
    found = stretches(footage, [(2, 100), (1, 20), (0, 60)], coarse_levels=1)
    assert found == (Stretch(3, 0, 50), Stretch(2, 0, 100), Stretch(1, WINDOW, 120), Stretch(0, WINDOW, 180))
    whole = footage_of(50, 0.3)
    assert stretches(whole, [(0, 12)], 2) == (Stretch(2, 0, 3), Stretch(1, 0, 6), Stretch(0, 0, 12))
    assert stretches(whole, [(0, 1)], 2) == (Stretch(0, 0, 1),)


def test_a_schedule_grows_gaussians_into_the_finest_size_and_resets_none_there() -> None:
    footage = footage_of(500, 4.0)
    config = TrainConfig(least_iterations=30_000, density="published")
    schedule, each = resolve_schedule(config, footage), lengths_of(config, footage)
    assert schedule.iterations == sum(count for _, count in each) == schedule.stretches[-1].until
    assert schedule.finest_from < schedule.density.last < schedule.iterations
    resets = [iteration for iteration in range(1, schedule.iterations + 1) if schedule.density.is_reset(iteration)]
    assert resets and max(resets) < each[0][1]
    assert schedule.training_size_at(1) == TrainingSize(2) and schedule.training_size_at(
        schedule.iterations + 5
    ) == TrainingSize(0, WINDOW)
    assert [schedule.training_sizes_until(each[0][1] + 1)[index] for index in (0, -2, -1)] == [
        TrainingSize(2),
        TrainingSize(2),
        TrainingSize(1, WINDOW),
    ]


def test_a_preview_grows_with_the_root_of_the_photos() -> None:
    config = TrainConfig(least_iterations=1500, length_growth=0.5)
    found = {photos: lengths_of(config, footage_of(photos, 0.3)) for photos in (11, 75, 300, 1200)}
    assert found == {11: [(0, 1500)], 75: [(0, 1500)], 300: [(0, 3000)], 1200: [(0, 6000)]}
    whole = config.model_copy(update={"length_growth": 1.0})
    assert lengths_of(whole, footage_of(300, 4.0)) == lengths(footage_of(300, 4.0), 1500)
    asked = sum(count for _level, count in lengths(footage_of(300, 4.0), 1500))
    assert sum(count for _level, count in lengths_of(config, footage_of(300, 4.0))) == round((1500 * asked) ** 0.5)


def test_many_photos_lengthen_the_phases_and_not_the_steps() -> None:
    few, many = (resolve_schedule(TrainConfig(least_iterations=1500), footage_of(n, 0.3)) for n in (50, 1000))
    assert (few.iterations, many.iterations) == (1500, 20_000)
    assert few.rates == many.rates
    assert (few.density.every, many.density.every) == (100, 1000)
    assert (few.sh_every, many.sh_every) == (300, 1000)
    given = resolve_schedule(TrainConfig(iterations=7000), footage_of(1000, 0.3))
    assert (given.density.every, given.sh_every, given.rates) == (
        100,
        1000,
        resolve_schedule(TrainConfig(iterations=7000)).rates,
    )


def views_of(size: float, count: int = 50) -> list:
    from dataclasses import replace

    from splatpipe.pipeline.photos.pixels.dataset import View

    width, height = SIZES[size]
    camera = tiny_scene.cameras()[0]
    views = []
    for number in range(count):
        pose = camera.cam_from_world.copy()
        pose[0, 3] += 0.1 * number
        placed = replace(camera.scaled(width, height), name=f"{number:03}.jpg", cam_from_world=pose)
        views.append(View(placed, Path(placed.name), None))
    return views


def plan_of(size: float, **options: object) -> TrainingPlan:
    views = views_of(size)
    return make_plan(TrainConfig.model_validate(options), views, tiny_scene.split_of(views, 8), 1000, WINDOW)


def test_a_plan_stores_and_reports_its_sizes_and_windows() -> None:
    plan = plan_of(4.0, least_iterations=7000)
    assert TrainingPlan.from_json(plan.to_json()) == plan and plan.last_iteration == plan.schedule.iterations
    assert plan.train_megapixels == pytest.approx(3.98, abs=0.01) and plan.megapixels is None
    assert "0.25 to 3.98 MP in windows of 0.44 MP" in plan.described()
    smaller = plan.of(plan.options.model_copy(update={"max_megapixels": 0.3}))
    assert smaller.megapixels == 0.3 and smaller.train_megapixels == pytest.approx(0.3, abs=0.001)
    assert smaller.schedule.stretches == (Stretch(0, 0, 7000),) and smaller.last_iteration == 7000
    assert smaller.rendering().megapixels == 0.3
    fine = plan.within_windows(WINDOW // 4)
    assert fine.footage.first_level == 3 and fine.schedule.iterations > plan.schedule.iterations
    short = plan.of(plan.options.model_copy(update={"iterations": 3000}))
    assert short.schedule.finest.level == 1 and short.train_megapixels == pytest.approx(1.0, abs=0.01)


def test_windows_shrink_with_the_memory_but_not_below_a_useful_size() -> None:
    assert window_within(10**12, WINDOW) == WINDOW and window_within(-1, WINDOW) == SMALLEST_WINDOW
    assert window_within(200_000_000, WINDOW) == math.floor(0.25 * 200_000_000 / PIXEL_BYTES) < WINDOW
    assert window_within(10**9, 0) == 0


def test_lengths_import_nothing_heavy() -> None:
    code = "import sys, splatpipe.pipeline.train.plan.lengths; print({'numpy', 'torch', 'cv2'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
