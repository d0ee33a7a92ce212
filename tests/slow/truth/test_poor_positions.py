"""Stated accuracy of poor positions is true, over many simulated flights."""

import numpy as np
from poor_flights import CENTRES, MODEL_FROM_WORLD, cameras, errors_of, placed, stated_of

from splatpipe.pipeline.geometry.alignment import robust_similarity
from splatpipe.pipeline.geometry.correspondences import Correspondences


def test_stated_accuracy_of_positions_off_by_13_m_is_true() -> None:
    """Thirty draws: the truth within the stated 95 % in 25 or more, the stated sigmas as large as the errors are."""
    model = cameras()
    errors, sigmas, within = [], [], []
    for seed in range(100, 130):
        frame, _ = placed(model, CENTRES + 13.0 * np.random.default_rng(seed).normal(size=CENTRES.shape))
        error, sigma, bound = errors_of(frame, model), stated_of(frame, "sigma"), stated_of(frame, "95")
        errors.append(list(error.values()))
        sigmas.append(list(sigma.values()))
        within.append([abs(error[name]) <= bound[name] for name in error])
        assert frame.left_out == ()
    ratio = np.median(sigmas, axis=0) / np.sqrt((np.array(errors) ** 2).mean(axis=0))
    assert ((ratio > 0.75) & (ratio < 1.4)).all()  # 0.8 to 1.3 of 50 draws, as the benchmark prints them
    assert (np.sum(within, axis=0) >= 25).all()


def test_errors_of_all_sizes_are_not_searched_for_ever() -> None:
    generator = np.random.default_rng(38)
    places = generator.normal(size=(9, 3)) * [50.0, 50.0, 1.0]
    errors = generator.normal(size=(9, 3)) * np.exp(generator.uniform(0.0, 20.0, (9, 1)))
    points = Correspondences(MODEL_FROM_WORLD.apply(places), places + errors, np.full((9, 3), 3.0))
    assert 3 <= np.count_nonzero(robust_similarity(points, None).inliers) < 9
