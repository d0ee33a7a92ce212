"""Which photos suffice to show the whole scene."""

import numpy as np
import pytest

from splatpipe.pipeline.photos.pixels.covering import MIN_COVERED_SHARE, covering_photos

FEW = 12


def flight(photos: int, points: int = 4000, seed: int = 0) -> list[np.ndarray]:
    """Photos along a line over random points; each shows about half of what lies below it."""
    rng = np.random.default_rng(seed)
    places, below = rng.uniform(0.0, photos, points), np.arange(photos) + 0.5
    return [np.flatnonzero((abs(places - x) < 4.0) & (rng.random(points) < 0.5)) for x in below]


def counts(seen: list[np.ndarray], photos: list[int], points: int = 4000) -> np.ndarray:
    return np.bincount(np.concatenate([seen[photo] for photo in photos]), minlength=points)


@pytest.mark.parametrize("photos", [0, 1, 5, FEW])
def test_few_photos_are_all_chosen(photos: int) -> None:
    assert covering_photos(flight(photos), 4000, FEW) == list(range(photos))


@pytest.mark.parametrize("photos", [13, 30, 74, 300])
def test_chosen_photos_show_nearly_every_point_several_times(photos: int) -> None:
    seen = flight(photos)
    chosen = covering_photos(seen, 4000, FEW)
    assert np.sqrt(FEW * photos) <= len(chosen) <= photos
    assert (counts(seen, chosen) > 0).sum() >= MIN_COVERED_SHARE * (counts(seen, range(photos)) > 0).sum()
    assert np.median(counts(seen, chosen)) >= (1 if photos == 300 else 2)


def test_ten_times_as_many_photos_of_a_scene_are_not_ten_times_the_work() -> None:
    around = [[np.arange(4000)[number % 4 :: 4] for number in range(photos)] for photos in (30, 300)]
    few, many = (len(covering_photos(seen, 4000, FEW)) for seen in around)
    assert few == 19 and many == 60


def test_more_are_chosen_where_each_shows_something_else() -> None:
    apart = [np.arange(10) + 10 * photo for photo in range(100)]
    assert len(covering_photos(apart, 1000, FEW)) == 90


def test_the_choice_does_not_depend_on_the_order() -> None:
    seen = flight(50)
    chosen = covering_photos(seen, 4000, FEW)
    order = np.random.default_rng(3).permutation(50)
    again = covering_photos([seen[photo] for photo in order], 4000, FEW)
    assert sorted(order[again].tolist()) == chosen


def test_the_choice_is_the_best_at_each_step() -> None:
    seen, view_counts, expected = flight(40, seed=5), np.zeros(4000), []
    for _ in range(len(covering_photos(seen, 4000, FEW))):
        gains = [
            0.0 if photo in expected else (1.0 / (1.0 + view_counts[rows]) ** 2).sum()
            for photo, rows in enumerate(seen)
        ]
        expected.append(int(np.argmax(gains)))
        view_counts[seen[expected[-1]]] += 1
    assert covering_photos(seen, 4000, FEW) == sorted(expected)


def test_photos_and_points_that_nobody_shows_do_no_harm() -> None:
    nothing = [np.zeros(0, np.int64)] * 20
    assert len(covering_photos(nothing, 0, FEW)) == len(covering_photos(nothing, 7, FEW)) == 16
