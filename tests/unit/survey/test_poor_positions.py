"""Positions worse than their stated accuracy still georeference the model, and its accuracy report is right."""

import math

import corner_photos
import numpy as np
import pytest
from poor_flights import CENTRES, MODEL_FROM_WORLD, TURNS, cameras, errors_of, placed, stated, stated_of

from splatpipe.pipeline.geometry.correspondences import Correspondences, SharedErrors
from splatpipe.pipeline.survey.control.local_survey import stations_of
from splatpipe.pipeline.survey.placing.fitting import FrameUndeterminedError
from splatpipe.pipeline.survey.placing.gps import report_fit
from splatpipe.pipeline.survey.placing.receiver_noise import fit_with_noise
from splatpipe.pipeline.survey.placing.uncertainty import student_95


def test_gross_errors_are_reported_among_noisy_positions() -> None:
    rng = np.random.default_rng(4)
    centres = np.concatenate([CENTRES, CENTRES[:35] + np.array([1.0, 2.0, 3.0])])
    model = cameras(centres, np.concatenate([TURNS, TURNS[:35]]))
    places = centres + 13.0 * rng.normal(size=centres.shape)
    wrong = rng.choice(75, 10, replace=False)
    away = rng.normal(size=(10, 3))
    places[wrong] += 500.0 * away / np.linalg.norm(away, axis=1, keepdims=True)
    frame, _ = placed(model, places)
    assert frame.left_out == tuple(sorted(model.names[k] for k in wrong))
    assert abs(errors_of(frame, model)["scale"]) < stated_of(frame, "95")["scale"]


def test_correlated_errors_are_reported_and_accounted_for() -> None:
    """Errors that are correlated from one position to the next: the mean of forty is hardly better than one."""
    rng, error = np.random.default_rng(1), np.zeros((40, 3))
    error[0] = rng.normal(size=3)
    for k in range(1, 40):
        error[k] = 0.9 * error[k - 1] + math.sqrt(1.0 - 0.9**2) * rng.normal(size=3)
    slow, _ = placed(cameras(), CENTRES + 13.0 * error)
    white, _ = placed(cameras(), CENTRES + 13.0 * rng.normal(size=(40, 3)))
    uncertainty = slow.residuals["uncertainty"]
    assert min(uncertainty["noise_correlation"]) > 0.6
    assert stated_of(slow, "sigma")["east"] > 1.8 * stated_of(white, "sigma")["east"]
    errors, bounds = errors_of(slow, cameras()), stated_of(slow, "95")
    assert all(abs(errors[name]) <= bounds[name] for name in errors)


def test_errors_not_seen_in_residuals_are_common_to_all_positions() -> None:
    """Positions of stated 3 m that agree to 0.4 m are somewhere within 3 m; those that scatter as stated show all."""
    rng = np.random.default_rng(2)
    quiet, _ = placed(cameras(), CENTRES + rng.normal(size=CENTRES.shape) * [0.4, 0.4, 0.6])
    loud, _ = placed(cameras(), CENTRES + rng.normal(size=CENTRES.shape) * [3.0, 3.0, 5.0])
    assert 2.7 < stated_of(quiet, "sigma")["east"] < 3.1
    assert 4.5 < stated_of(quiet, "sigma")["height"] < 5.2
    assert stated_of(loud, "sigma")["east"] < 1.3


def test_altitude_that_drifts_does_not_tilt_the_model() -> None:
    """A level flight whose GPS heights drift by 100 m eastwards: up comes from the cameras, and the user learns why."""
    x, y = np.meshgrid(np.arange(9) * 10.0, np.arange(8) * 12.0, indexing="ij")
    y[1::2] = y[1::2, ::-1]
    centres = np.stack([x.ravel(), y.ravel(), np.full(72, 60.0)], axis=1)
    down = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    model = cameras(centres, np.tile(down, (72, 1, 1)))
    rng = np.random.default_rng(5)
    drift = np.concatenate([np.linspace(-60.0, 40.0, 50), np.full(22, 40.0)])
    lag = 4.0 * np.sign(np.gradient(centres[:, 1]))
    places = centres + np.stack([rng.normal(size=72), lag + rng.normal(size=72), drift + rng.normal(size=72)], axis=1)
    frame, fit = placed(model, places)
    errors, bounds = errors_of(frame, model), stated_of(frame, "95")
    assert errors["up"] < 8.0
    assert all(abs(errors[name]) <= bounds[name] for name in errors)
    notes = corner_photos.Recorder()
    report_fit(frame, fit, model, stated(model, places), notes)
    assert any("positions are inaccurate" in warning for warning in notes.warnings)


def test_noise_that_leaves_scale_unknown_is_refused_with_its_size() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(FrameUndeterminedError, match="agree with the model: they are off by") as uncertainty:
        placed(cameras(), CENTRES + 90.0 * rng.normal(size=CENTRES.shape))
    assert "%" in str(uncertainty.value)


def test_five_positions_keep_their_stated_accuracy() -> None:
    """So few residuals may be small by chance: no photo is excluded, and no position is rated better than stated."""
    five = [0, 8, 16, 24, 36]
    model = cameras(CENTRES[five], TURNS[five])
    for seed in range(5):
        rng = np.random.default_rng(seed)
        frame, _ = placed(model, CENTRES[five] + rng.normal(size=(5, 3)) * [1.5, 1.5, 2.5])
        assert frame.left_out == ()
        assert stated_of(frame, "sigma")["scale"] > 3.0


def test_flights_share_errors_besides_their_noise() -> None:
    """Two flights, one 4 m off: noise and offset are separated, and the frame's offset is between them."""
    rng = np.random.default_rng(3)
    group = np.repeat([0, 1], 20)
    target = CENTRES + rng.normal(size=(40, 3)) + np.where(group[:, None] == 1, [4.0, 0.0, 0.0], 0.0)
    shared = SharedErrors(group, np.full((2, 3), 3.0))
    before = np.arange(40) - 1
    before[20] = -1
    points = Correspondences(MODEL_FROM_WORLD.apply(CENTRES), target, np.full((40, 3), 3.0), shared)
    fit = fit_with_noise(points, before, MODEL_FROM_WORLD.inverse())
    assert fit.noise.factors == pytest.approx(np.full(2, 1.0 / 3.0), rel=0.2)
    assert fit.offsets[1, 0] - fit.offsets[0, 0] == pytest.approx(4.0, abs=1.5)
    assert 1.5 < math.sqrt(fit.covariance[4, 4]) < 3.0


def test_control_weights_poor_positions_by_their_actual_accuracy() -> None:
    model = cameras()
    places = CENTRES + 13.0 * np.random.default_rng(6).normal(size=CENTRES.shape)
    frame, _ = placed(model, places)
    sigmas = stations_of(model, stated(model, places), frame).sigmas
    assert sigmas.mean(axis=0) == pytest.approx([13.0, 13.0, 13.0], rel=0.5)


def test_students_t_is_that_of_the_tables() -> None:
    assert [student_95(n) for n in (3.0, 5.0, 10.0, 30.0, 1e6)] == pytest.approx(
        [3.182, 2.571, 2.228, 2.042, 1.960], rel=8e-3
    )
