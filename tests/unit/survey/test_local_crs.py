"""The polynomial that replaces PROJ in a page: accurate, even for large scenes, geographic CRSs and odd units."""

import numpy as np
import pytest

from splatpipe.pipeline.survey.crs.frames import Frame, Origin, Similarity
from splatpipe.pipeline.survey.crs.local_crs import local_crs
from splatpipe.pipeline.survey.crs.world import open_world

DEGREE_M = 111_000.0
NEAR_ENOUGH_M = 1e-3


@pytest.mark.parametrize("crs", ["EPSG:32634", "EPSG:2180", "EPSG:4326", "EPSG:3857"])
@pytest.mark.parametrize("half_m", [40.0, 2500.0])
def test_it_agrees_with_proj_to_a_millimetre_all_over_the_scene(crs: str, half_m: float) -> None:
    frame = Frame("enu", Similarity(1.0, np.eye(3), np.zeros(3)), Origin(52.2, 20.97, 110.0), crs=crs)
    world = open_world(frame)
    made = local_crs(world, np.array([[-half_m, -half_m, -20.0], [half_m, half_m, 60.0]]))
    local = np.random.default_rng(2).uniform(-half_m, half_m, (200, 3)) * [1.0, 1.0, 0.02]
    off = np.abs(made.coordinates(local) - world.crs_from_local(local))
    metres = np.array([DEGREE_M, DEGREE_M, 1.0]) if made.geographic else np.ones(3)
    off *= metres
    assert off.max() < NEAR_ENOUGH_M
    assert made.geographic == (crs == "EPSG:4326")
    assert (made.largest_error * metres).max() < 30.0 * NEAR_ENOUGH_M  # over twice the scene, up and down as well


def test_its_facts_are_plain_numbers_that_give_the_same_coordinates() -> None:
    frame = Frame("enu", Similarity(1.0, np.eye(3), np.zeros(3)), Origin(47.8, 13.5, 512.0))
    made = local_crs(open_world(frame), np.array([[-10.0, -10.0, 0.0], [10.0, 10.0, 5.0]]))
    facts = made.facts()
    point = np.array([[3.0, -7.0, 2.5]])
    steps = point[0] / facts["scale_m"]
    by_hand = list(facts["origin"])
    for (a, b, c), term in zip(facts["powers"], facts["coefficients"], strict=True):
        for axis in range(3):
            by_hand[axis] += steps[0] ** a * steps[1] ** b * steps[2] ** c * term[axis]
    np.testing.assert_allclose(by_hand, made.coordinates(point)[0], rtol=0.0, atol=1e-7)
