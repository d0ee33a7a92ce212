"""Assignment of targets to control points: by ID, by place, with and without positions; and rejected ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from surveyed import HEIGHT, POINTS, TRUTH, WIDTH, true_model

from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.placing.model import SparseModel, model_of
from splatpipe.pipeline.survey.targets.target_finds import QUADRANT, TargetFind
from splatpipe.pipeline.survey.targets.target_marks import ExpectedPoints, TargetMarks, named_tracks

NAMES = tuple(POINTS)
PHOTOS = {photo["name"]: Photo(photo["name"], "0" * 64, WIDTH, HEIGHT, 0) for photo in TRUTH["photos"]}
PLACES = np.array([POINTS[name]["xyz_m"] for name in NAMES])
MISPLACED = Similarity(1.0, np.eye(3), np.array([3.0, -2.0, 40.0]))  # a receiver's error, and another datum's heights


@cache
def model() -> SparseModel:
    return model_of(true_model(points=300), PHOTOS)


def finds(names: Sequence[str] = NAMES, kind: str = QUADRANT, noise_px: float = 0.1) -> list[TargetFind]:
    """Return detections of points; coded ones have the IDs in their names."""
    rng = np.random.default_rng(1)
    found = []
    for name in names:
        number = None if kind == QUADRANT else int(name[1:])
        for photo, pixel in sorted(POINTS[name]["seen_px"].items()):
            x, y = (np.array(pixel) + rng.normal(size=2) * noise_px).tolist()
            found.append(TargetFind(photo, kind, number, x, y, 15.0, 0.1))
    return found


def strangers(count: int) -> list[TargetFind]:
    """Quadrants by chance: nothing is there."""
    rng = np.random.default_rng(2)
    photos = rng.choice(sorted(PHOTOS), count)
    at = rng.uniform([0.0, 0.0], [WIDTH, HEIGHT], (count, 2))
    return [
        TargetFind(str(p), QUADRANT, None, float(x), float(y), 12.0, 0.1) for p, (x, y) in zip(photos, at, strict=True)
    ]


def named(found: Sequence[TargetFind], positions: Similarity | None, names: Sequence[str] = NAMES) -> TargetMarks:
    return named_tracks(found, names, (model(), PHOTOS), ExpectedPoints(NAMES, PLACES, positions), {})


def assert_true(marks: TargetMarks, least: int) -> None:
    """Assert that at least ``least`` points have marks, and that each mark is on its own point."""
    pixels = marks.pixels()
    assert len(pixels) >= least
    for name, seen in pixels.items():
        off = [np.hypot(*np.subtract(pixel, POINTS[name]["seen_px"][photo])) for photo, pixel in seen.items()]
        assert max(off) < 1.0


def test_coded_targets_are_assigned_by_number_without_any_position() -> None:
    assert_true(named(finds(kind="apriltag_36h11"), None), len(NAMES))


def test_quadrants_are_assigned_by_place_despite_an_offset_and_false_detections() -> None:
    marks = named([*strangers(60), *finds()], MISPLACED)
    assert_true(marks, len(NAMES) - 1)


def test_three_numbered_targets_identify_the_quadrants_if_photos_have_no_positions() -> None:
    coded = ("P01", "P06", "P12")
    quadrants = [name for name in NAMES if name not in coded]
    assert_true(named([*finds(coded, "4x4_250"), *finds(quadrants)], None), len(NAMES) - 1)
    assert named(finds(quadrants), None).named == ()


def test_a_quadrant_without_a_point_gets_no_name() -> None:
    known = [name for name in NAMES if name not in ("P05", "P16")]
    rows = [NAMES.index(name) for name in known]
    expected = ExpectedPoints(tuple(known), PLACES[rows], MISPLACED)
    marks = named_tracks(finds(), known, (model(), PHOTOS), expected, {})
    assert_true(marks, len(known) - 1)
    assert set(marks.pixels()) <= set(known) and marks.refused["targets at no surveyed point"] >= 2


def test_a_coded_target_away_from_its_point_is_rejected() -> None:
    """The boards of two points were swapped in the field."""
    number = {1: 6, 6: 1}
    swapped = [replace(find, number=number.get(find.number or 0, find.number)) for find in finds(kind="5x5_250")]
    marks = named(swapped, MISPLACED)
    assert "P01" not in marks.pixels() and "P06" not in marks.pixels()
    assert_true(marks, len(NAMES) - 2)
    assert marks.refused["coded targets far from the points of their numbers"] == 2


def test_one_false_detection_of_a_target_is_rejected_by_geometry() -> None:
    right = finds(("P02",), "6x6_250")
    wrong = replace(right[0], x=WIDTH - right[0].x, y=HEIGHT - right[0].y)
    marks = named([wrong, *right[1:]], MISPLACED)
    assert wrong.photo not in marks.pixels()["P02"] and len(marks.pixels()["P02"]) == len(right) - 1


def test_two_rays_that_meet_by_chance_are_no_quadrant() -> None:
    pair = finds(("P02",))[:2]
    assert named(pair, MISPLACED).named == ()
