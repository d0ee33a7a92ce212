"""Robust fits against a known truth."""

import numpy as np

from splatpipe.pipeline.geometry.robust import absolute_weights, robust_similarity
from splatpipe.pipeline.geometry.similarity import Similarity, fit_similarity, rotation_from_vector


def test_robust_similarity_ignores_the_fifth_of_the_points_that_are_wrong() -> None:
    rng = np.random.default_rng(46)
    truth = Similarity(2.5, rotation_from_vector(np.array([0.3, -0.2, 1.0])), np.array([10.0, -4.0, 2.0]))
    source = rng.normal(0.0, 1.0, (40, 3))
    target = truth.apply(source)
    target[:8] += rng.normal(0.0, 5.0, (8, 3))
    similarity, residuals = robust_similarity(source, target, absolute_weights, 50)
    off = np.linalg.norm(truth.apply(source) - similarity.apply(source), axis=1).max()
    scale, rotation, translation = fit_similarity(source, target, np.ones(40))
    plain = np.linalg.norm(truth.apply(source) - Similarity(float(scale), rotation, translation).apply(source), axis=1)
    assert off < 0.02 < 0.5 < plain.max()
    np.testing.assert_allclose(residuals, similarity.apply(source) - target)
