"""Why photos could not be placed is told by their keypoints and matches, with what to do."""

import numpy as np
import pycolmap
import pytest

from splatpipe.pipeline.sfm.model.view_graph import ViewGraph
from splatpipe.pipeline.sfm.recovery.refusal import THERMAL, little_texture, refusal, texture_hint


def graph(
    photos: int, pairs: dict[tuple[int, int], int], keypoints: int = 3000, size: tuple[int, int] = (1200, 900)
) -> ViewGraph:
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=size[0], height=size[1], params=[900, 600, 450])
    numbers = range(1, photos + 1)
    return ViewGraph(
        names={number: f"{number}.jpg" for number in numbers},
        camera_of=dict.fromkeys(numbers, 1),
        cameras={1: camera},
        keypoints={number: np.zeros((keypoints, 2), np.float32) for number in numbers},
        matches={pair: np.zeros((count, 2), np.uint32) for pair, count in pairs.items()},
    )


def test_two_photos_that_match_are_too_few_for_a_model() -> None:
    error = refusal(0, 3, graph(2, {(1, 2): 1051}), 1)
    assert error.message == (
        "None of 2 photos could be placed: 2 are too few, as a model needs 3 photos (sparse.min_model_size)."
    )
    assert error.hint.startswith("These match each other (1,051 matches). Add photos")


def test_more_photos_of_which_two_match_are_too_few_as_well() -> None:
    error = refusal(0, 3, graph(8, {(1, 2): 400, (5, 6): 90}), 28)
    assert "only 2 show the same place" in error.message


def test_photos_without_matches_and_those_that_cannot_be_placed_are_told_apart() -> None:
    apart = refusal(0, 3, graph(8, {}), 10)
    assert "no two of them match" in apart.message
    assert "matches.pairing=exhaustive" in apart.hint
    whole = refusal(3, 3, graph(60, {(k, k + 1): 99 for k in range(1, 60)}), 60 * 59 // 2)
    assert whole.message == "Only 3 of 60 photos could be placed."
    assert "exhaustive" not in whole.hint  # every pair was tried


@pytest.mark.parametrize(("size", "thermal"), [((640, 480), True), ((512, 640), True), ((4000, 3000), False)])
def test_photos_without_texture_are_told_and_thermal_ones_what_to_do(size: tuple[int, int], thermal: bool) -> None:
    error = refusal(0, 3, graph(40, {(1, 2): 20}, keypoints=52, size=size), 780)
    assert "they have too little texture, 52 keypoints a photo (median)" in error.message
    assert (error.hint == THERMAL) is thermal
    assert texture_hint([size] * 3) == error.hint
    assert little_texture([52, 52, 4000]) and not little_texture([52, 4000, 4000])
