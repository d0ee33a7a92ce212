"""A similarity fitted to points: exact, robust, with a covariance that holds, or refused with a reason."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import splatpipe

RNG = np.random.default_rng(7)
MODEL = RNG.normal(size=(12, 3))
TRUTH = splatpipe.Similarity(
    12.5, Rotation.from_rotvec([0.3, 0.2, 2.0]).as_matrix(), np.array([412_345.5, 5_654_321.25, 120.0])
)
SITE = TRUTH.apply(MODEL)
SIGMA = 0.02


def test_three_exact_points_give_the_similarity_at_survey_coordinates() -> None:
    fit = splatpipe.fit_similarity(MODEL[:3].tolist(), SITE[:3].tolist(), SIGMA)
    assert fit.similarity.scale == pytest.approx(TRUTH.scale, rel=1e-8)
    assert np.abs(fit.similarity.apply(MODEL) - SITE).max() < 1e-5
    assert fit.inliers.all()


def test_wrong_points_are_left_out() -> None:
    wrong = SITE.copy()
    wrong[[2, 7]] += [4.0, -3.0, 1.0]
    fit = splatpipe.fit_similarity(MODEL, wrong, SIGMA)
    assert np.flatnonzero(~fit.inliers).tolist() == [2, 7]
    assert np.abs(fit.similarity.apply(MODEL) - SITE).max() < 1e-5
    assert splatpipe.fit_similarity(MODEL, wrong, SIGMA, max_error=0.1).inliers.sum() == 10


@pytest.mark.parametrize("count", [3, 12])
def test_the_covariance_is_the_spread_of_repeated_surveys(count: int) -> None:
    elsewhere = np.array([[2.0, -1.0, 0.5], [0.0, 0.0, 0.0]])
    found, stated = [], []
    for _ in range(60):
        measured = SITE[:count] + SIGMA * RNG.normal(size=(count, 3))
        fit = splatpipe.fit_similarity(MODEL[:count], measured, SIGMA)
        found.append(fit.similarity.apply(elsewhere))
        stated.append(fit.sigmas_at(elsewhere))
    # 60 surveys know a spread to 9 %; the noise of 12 points, estimated from themselves, and robust weights add 15 %.
    assert np.mean(stated, axis=0) == pytest.approx(np.std(found, axis=0), rel=0.35)


def test_sigmas_may_differ_by_axis_and_point() -> None:
    by_axis = splatpipe.fit_similarity(MODEL[:4], SITE[:4], [0.01, 0.01, 0.03])
    assert (by_axis.sigmas_at(MODEL[:4])[:, 2] > by_axis.sigmas_at(MODEL[:4])[:, 0]).all()
    each = np.full((4, 3), SIGMA)
    each[0] = 1e-4
    near = splatpipe.fit_similarity(MODEL[:4], SITE[:4], each).sigmas_at(MODEL[:4])
    assert near[0].max() < 2e-4 < near[1].max()


@pytest.mark.parametrize(
    ("source", "target", "sigmas", "message"),
    [
        (MODEL[:2], SITE[:2], SIGMA, "do not determine a similarity"),
        (MODEL[:4], SITE[:3], SIGMA, "do not determine a similarity"),
        (MODEL[:4, :2], SITE[:4], SIGMA, r"source points are not \(n, 3\)"),
        (MODEL[:4], [[1.0, 2.0, float("inf")]] * 4, SIGMA, r"target points are not \(n, 3\)"),
        ([[0.0] * 3] * 4, SITE[:4], SIGMA, "in one place"),
        (np.outer(np.arange(4.0), [1.0, 2.0, 3.0]), np.outer(np.arange(4.0), [1.0, 2.0, 3.0]), SIGMA, "on a line"),
        (MODEL[:4], SITE[:4], -1.0, "not positive"),
        (MODEL[:4], SITE[:4], [0.1, 0.1], "do not fit"),
    ],
)
def test_points_that_determine_nothing_are_refused(
    source: object, target: object, sigmas: object, message: str
) -> None:
    with pytest.raises(splatpipe.SplatpipeError, match=message) as caught:
        splatpipe.fit_similarity(source, target, sigmas)  # type: ignore[arg-type]
    assert caught.value.hint


@pytest.mark.parametrize("count", [4, 5, 8])  # at least 4 have to agree, and more than half
def test_mirrored_or_unrelated_points_are_refused(count: int) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        points = 10.0 * rng.normal(size=(count, 3))
        for target in (points * [1.0, 1.0, -1.0], 10.0 * rng.normal(size=(count, 3))):
            with pytest.raises(splatpipe.SplatpipeError, match="contradict each other"):
                splatpipe.fit_similarity(points, target, 0.01)


def test_three_points_that_are_off_by_far_more_than_their_sigmas_are_refused() -> None:
    wrong = SITE[:3] + np.array([[5.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, -5.0, 0.0]])
    with pytest.raises(splatpipe.SplatpipeError, match="times their sigmas"):
        splatpipe.fit_similarity(MODEL[:3], wrong, 0.001)
    assert splatpipe.fit_similarity(MODEL[:3], wrong, 0.001, max_error=10.0).inliers.all()


def test_one_wrong_point_of_five_is_left_out() -> None:
    wrong = SITE[:5].copy()
    wrong[0, 2] += 4.0
    assert splatpipe.fit_similarity(MODEL[:5], wrong, SIGMA).inliers.tolist() == [False, True, True, True, True]


@pytest.mark.parametrize("max_error", [float("nan"), -1.0, 0.0])
def test_a_limit_that_is_none_is_named(max_error: float) -> None:
    with pytest.raises(splatpipe.SplatpipeError, match="max_error"):
        splatpipe.fit_similarity(MODEL, SITE, SIGMA, max_error=max_error)
