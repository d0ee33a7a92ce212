"""Points where many rays meet."""

import numpy as np
import pytest

from splatpipe.pipeline.geometry.meeting_rays import ray_equations

RATIO = 1e-6


def test_points_are_where_their_rays_meet() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 3)) * [10.0, 10.0, 2.0]
    row = np.sort(rng.integers(0, 40, 300))
    centres = rng.normal(size=(300, 3)) * 5.0 + [0.0, 0.0, 50.0]
    ways = points[row] - centres
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    found, meet = ray_equations(row, 40, centres, ways, rng.uniform(0.5, 2.0, 300)).solved(RATIO)
    assert meet[np.bincount(row, minlength=40) >= 2].all()
    np.testing.assert_allclose(found[meet], points[meet], atol=1e-6)


def test_the_sums_are_those_of_the_rows() -> None:
    rng = np.random.default_rng(1)
    row = rng.integers(0, 7, 50)
    ways = rng.normal(size=(50, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    found = ray_equations(row, 8, rng.normal(size=(50, 3)), ways, np.ones(50))
    for number in range(8):
        np.testing.assert_allclose(found.whole[number], found.across[row == number].sum(axis=0))
        np.testing.assert_allclose(found.side[number], found.pulled[row == number].sum(axis=0), atol=1e-12)


@pytest.mark.parametrize("ways", [[[0.0, 0.0, 1.0]], [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]], ids=["one", "parallel"])
def test_rays_that_do_not_meet_determine_no_point(ways: list[list[float]]) -> None:
    centres = np.arange(3.0 * len(ways)).reshape(-1, 3)
    found, meet = ray_equations(np.zeros(len(ways), np.int64), 1, centres, np.array(ways), np.ones(len(ways))).solved(
        RATIO
    )
    assert not meet.any() and not found.any()


def test_no_rays_determine_no_points() -> None:
    none = np.zeros((0, 3))
    found, meet = ray_equations(np.zeros(0, np.int64), 2, none, none, np.zeros(0)).solved(RATIO)
    assert found.shape == (2, 3) and not meet.any()
