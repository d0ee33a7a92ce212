"""The block adjustment of positions: its equations, the noise it finds, and the accuracy that it states."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from splatpipe.pipeline.geometry.similarity import rotation_from_vector
from splatpipe.pipeline.survey.adjustment import block as block_module
from splatpipe.pipeline.survey.adjustment.adjusted_positions import height_sentence
from splatpipe.pipeline.survey.adjustment.block import Block, part_of, reduce_block, settle_points
from splatpipe.pipeline.survey.adjustment.block_accuracy import accuracy_of, with_control, with_cross_strip
from splatpipe.pipeline.survey.adjustment.block_adjustment import adjust_block, joint_system, solve
from splatpipe.pipeline.survey.adjustment.block_distances import Distances
from splatpipe.pipeline.survey.adjustment.block_lens import free_lens
from splatpipe.pipeline.survey.adjustment.position_adjustment import (
    BlockFit,
    LensKnowledge,
    converge,
    parts_of,
    prior_lens,
)
from splatpipe.pipeline.survey.adjustment.position_noise import as_stated, strip_pieces
from splatpipe.pipeline.survey.adjustment.tie_points import image_errors, tie_sigma
from tests.scenes.flown_block import FlownBlock, flown

EVERY = 24


@pytest.fixture(scope="module")
def flight() -> FlownBlock:
    return flown()


@pytest.fixture(scope="module")
def fitted(flight: FlownBlock) -> BlockFit:
    return converge(flight.start, flight.positions, kept(flight))


def kept(flight: FlownBlock) -> np.ndarray:
    return np.ones(len(flight.positions), dtype=bool)


def ground_errors(block: Block, flight: FlownBlock) -> np.ndarray:
    return np.asarray(block.points - flight.truth.points)


def test_gradient_is_the_derivative_of_the_cost_with_points_settled(flight: FlownBlock) -> None:
    block = settle_points(flight.start, 8)
    reduced = reduce_block(block)
    rng = np.random.default_rng(1)
    sizes = 1.0 / np.sqrt(np.diag(reduced.normal))
    for _ in range(3):
        step = 1e-2 * rng.normal(size=block.unknowns) * sizes
        still = np.zeros_like(block.points)
        ahead, back = (settle_points(block.moved(side * step, still), 8).cost() for side in (1.0, -1.0))
        assert (ahead - back) / 2.0 == pytest.approx(2.0 * float(reduced.gradient @ step), rel=1e-3)


def with_bars(block: Block, truth: Block, sigma_m: float) -> Block:
    """A block with scale bars that share an end, and one apart."""
    ends = np.array([[0, 40], [40, 80], [100, 160]])
    lengths = np.linalg.norm(truth.points[ends[:, 0]] - truth.points[ends[:, 1]], axis=1)
    return replace(block, distances=Distances(ends, lengths, np.full(3, sigma_m)))


def test_distances_join_their_points_in_the_equations(flight: FlownBlock) -> None:
    block = settle_points(with_bars(flight.start, flight.truth, 0.002), 8)
    reduced = reduce_block(block)
    rng = np.random.default_rng(3)
    sizes = 1.0 / np.sqrt(np.diag(reduced.normal))
    for _ in range(3):
        step = 1e-2 * rng.normal(size=block.unknowns) * sizes
        still = np.zeros_like(block.points)
        ahead, back = (settle_points(block.moved(side * step, still), 8).cost() for side in (1.0, -1.0))
        assert (ahead - back) / 2.0 == pytest.approx(2.0 * float(reduced.gradient @ step), rel=2e-3)
    alone = reduce_block(replace(block, distances=part_of(block, np.zeros(len(block), dtype=bool)).distances))
    assert np.linalg.eigvalsh(reduced.normal - alone.normal).min() > -1e-6 * np.diag(alone.normal).max()
    tighter = np.trace(reduced.own[[0, 40, 100]] - alone.own[[0, 40, 100]], axis1=1, axis2=2)
    assert (tighter < 0.0).all()


def test_scale_bars_scale_a_block_whose_positions_are_poor() -> None:
    poor = flown(sigmas_m=(0.5, 0.5, 0.5))
    observed = as_stated(poor.positions).observations(poor.positions)

    def error(block: Block) -> float:
        done = adjust_block(block, observed)
        assert done.converged
        found, true = (each.points[::7] - each.points.mean(axis=0) for each in (done.block, poor.truth))
        return float(abs(np.linalg.norm(found) / np.linalg.norm(true) - 1.0))

    without, bars = error(poor.start), error(with_bars(poor.start, poor.truth, 0.002))
    assert bars < 1e-3
    assert bars < 0.3 * without


def test_exact_observations_give_the_true_block() -> None:
    exact = flown(noise_px=0.0, sigmas_m=(1e-4, 1e-4, 1e-4))
    noise = as_stated(exact.positions)
    sure = replace(exact.start, sigmas=np.full_like(exact.start.sigmas, 1e-3))
    done = adjust_block(sure, noise.observations(exact.positions))
    assert done.converged
    assert np.abs(ground_errors(done.block, exact)).max() < 0.02
    assert np.abs(done.block.centres - exact.truth.centres).max() < 1e-3
    assert np.abs(image_errors(done.block)).max() < 0.01


def test_a_block_that_only_loose_positions_hold_is_turned_back_in_a_few_steps() -> None:
    loose = flown(sigmas_m=(1.0, 1.0, 1.0))
    start, tilt = loose.start, rotation_from_vector(np.array([0.2, -0.1, 0.3]))
    tilted = replace(
        start, rotations=start.rotations @ tilt.T, centres=start.centres @ tilt.T, points=start.points @ tilt.T
    )
    observed = as_stated(loose.positions).observations(loose.positions)
    done, level = adjust_block(tilted, observed, rounds=12), adjust_block(start, observed)
    assert done.converged
    assert done.cost == pytest.approx(level.cost, abs=0.1)


def test_a_bent_start_is_straightened_and_the_lens_is_found(flight: FlownBlock, fitted: BlockFit) -> None:
    fit = fitted
    lens = dict(zip(fit.adjusted.block.lenses[0].names, fit.adjusted.block.lenses[0].values, strict=True))
    assert lens["k1"] == pytest.approx(-0.08, abs=0.02)
    assert (lens["cx"], lens["cy"]) == pytest.approx((408.0, 294.0), abs=2.0)
    assert np.sqrt((ground_errors(fit.adjusted.block, flight)[:, :2] ** 2).mean()) < 0.07
    predicted = fit.predicted()
    assert np.sqrt((predicted**2).mean(axis=0)) == pytest.approx([0.1, 0.1, 0.03], abs=0.1)


def test_sparse_equations_are_the_dense_ones(flight: FlownBlock, monkeypatch: pytest.MonkeyPatch) -> None:
    observed = as_stated(flight.positions).observations(flight.positions)
    offsets = np.zeros((1, 3))
    dense, right = joint_system(reduce_block(flight.start), observed, flight.start, offsets)
    monkeypatch.setattr(block_module, "MAX_DENSE", 10)
    sparse, same = joint_system(reduce_block(flight.start), observed, flight.start, offsets)
    assert np.allclose(sparse.toarray(), dense, rtol=1e-12, atol=1e-6)
    assert np.array_equal(right, same)
    assert np.allclose(solve(sparse, right), solve(dense, right), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("times", [0.1, 1.0, 10.0])
def test_sigmas_stated_wrong_by_a_factor_are_found_out(times: float) -> None:
    flight = flown(sigmas_m=(0.2, 0.2, 0.3))
    stated = replace(flight.positions, sigmas=times * flight.positions.sigmas)
    fit = converge(flight.start, stated, kept(flight))
    assert fit.kept.all()
    assert (np.abs(np.log(fit.noise.factors[0] * times)) < np.log(4.5 if times > 1.0 else 1.6)).all()


def test_wrong_positions_are_found_and_left_out(flight: FlownBlock) -> None:
    wrong = flight.positions.stated.copy()
    wrong[[3, 11]] += [[0.5, -0.4, 0.3], [0.0, 3.0, 4.0]]
    fit = converge(flight.start, replace(flight.positions, stated=wrong), kept(flight))
    assert np.flatnonzero(~fit.kept).tolist() == [3, 11]


def test_drifting_errors_are_recognised() -> None:
    long = flown(strips=6, steps_m=(0.0, 6.0))
    rng = np.random.default_rng(5)
    drift = np.zeros((36, 3))
    for k in range(1, 36):
        drift[k] = 0.95 * drift[k - 1] + np.sqrt(1.0 - 0.95**2) * rng.normal(size=3) * [0.3, 0.3, 0.4]
    fit = converge(long.start, replace(long.positions, stated=long.positions.stated + drift), kept(long))
    assert (fit.noise.shares >= 0.5).all()
    assert fit.noise.white_correlations().min() > 0.3


def test_positions_left_out_are_predicted_as_a_fit_without_them_does(flight: FlownBlock, fitted: BlockFit) -> None:
    fit = fitted
    piece = strip_pieces(flight.positions)[0]
    without = flight.positions.only(~piece)
    noise = replace(fit.noise, of=fit.noise.of[~piece])
    refit = adjust_block(fit.adjusted.block, noise.observations(without))
    errors = refit.block.centres[flight.positions.photo[piece]] - flight.positions.stated[piece]
    assert np.abs(fit.predicted()[piece] - errors).max() < 0.003


def test_heights_straight_down_are_as_uncertain_as_the_focal_length(flight: FlownBlock, fitted: BlockFit) -> None:
    fit = fitted
    accuracy = accuracy_of(fit.adjusted, fit.observed)
    focal = float(np.sqrt(accuracy.lens_sigmas()[0][0, 0])) / 900.0
    assert accuracy.mean_sigmas()[2] == pytest.approx(38.5 * focal, rel=0.15)
    assert height_sentence(float(accuracy.mean_sigmas()[2]), 0.044, 0.014) is not None
    strip = with_cross_strip(accuracy)
    assert strip is not None and strip.height_sigma_m < 0.4 * accuracy.mean_sigmas()[2]


def test_control_does_what_is_predicted_of_it(flight: FlownBlock, fitted: BlockFit) -> None:
    fit = fitted
    accuracy = accuracy_of(fit.adjusted, fit.observed)
    promised = with_control(accuracy)[1]
    index = int(np.argmin(np.abs(fit.adjusted.block.points - promised.places[0]).sum(axis=1)))
    weights = fit.adjusted.block.weights.copy()
    weights[index] = 1.0 / np.array([0.02, 0.02, 0.03]) ** 2
    stated = fit.adjusted.block.stated.copy()
    stated[index] = flight.truth.points[index]
    sigmas = np.where(fit.adjusted.block.point == index, 0.5, fit.adjusted.block.sigmas)
    done = adjust_block(replace(fit.adjusted.block, weights=weights, stated=stated, sigmas=sigmas), fit.observed)
    assert accuracy_of(done, fit.observed).mean_sigmas()[2] == pytest.approx(promised.height_sigma_m, rel=0.1)
    error = abs(float(ground_errors(done.block, flight)[:, 2].mean()))
    assert error < 3.0 * promised.height_sigma_m


def test_two_heights_need_no_remedy() -> None:
    stepped = flown(steps_m=(0.0, 8.0))
    fit = converge(stepped.start, stepped.positions, kept(stepped))
    up = float(accuracy_of(fit.adjusted, fit.observed).mean_sigmas()[2])
    assert up < 3.0 * 0.044
    assert height_sentence(up, 0.044, 0.014) is None


@pytest.mark.parametrize("off", [0.6, None])
def test_heights_are_not_warned_of_where_positions_are_poor_or_nothing_has_a_scale(off: float | None) -> None:
    assert height_sentence(5.0, None if off is None else 0.02, 0.014 if off is None else off) is None


def test_a_long_flight_is_judged_in_parts(
    monkeypatch: pytest.MonkeyPatch, flight: FlownBlock, fitted: BlockFit
) -> None:

    monkeypatch.setattr("splatpipe.pipeline.survey.adjustment.position_adjustment.PART_POSITIONS", 12)
    parts = list(parts_of(fitted.adjusted, flight.positions))
    assert [int(part.chosen.sum()) for part in parts] == [12, 12]
    assert all(len(part.block) == 12 and len(part.system.gradient) == 36 for part in parts)
    fit = converge(flight.start, flight.positions, kept(flight))
    assert np.abs(fit.adjusted.block.centres - fitted.adjusted.block.centres).max() < 0.02


def test_part_has_the_photos_and_what_two_of_them_see(flight: FlownBlock) -> None:
    photos = np.arange(EVERY) < 6
    part = part_of(flight.truth, photos)
    assert len(part) == 6
    assert np.bincount(part.point).min() >= 2
    assert np.allclose(part.cost(), float((part.residuals() ** 2).sum()) + prior_cost(part))


def prior_cost(block: Block) -> float:
    return sum(float((((lens.values - lens.mean) / lens.sigmas) ** 2).sum()) for lens in block.lenses)


def test_errors_that_neighbours_share_make_tie_points_worth_less(fitted: BlockFit) -> None:
    fit = fitted.adjusted.block
    assert tie_sigma(fit) == pytest.approx(1.0, abs=0.1)
    rng = np.random.default_rng(2)
    shift = 3.0 * rng.normal(size=(EVERY, 5, 5, 2))
    cell = np.minimum((5 * fit.pixels / [800, 600]).astype(int), 4)
    shared = replace(fit, pixels=fit.pixels + shift[fit.photo, cell[:, 1], cell[:, 0]])
    assert tie_sigma(shared) > 3.5


def test_a_lens_of_an_unknown_model_is_held() -> None:
    camera = pycolmap.Camera(camera_id=1, model="FOV", width=800, height=600, params=[500, 500, 400, 300, 0.9])
    assert prior_lens(camera, LensKnowledge(500.0, 0.01), None).names == ()


def test_focal_lengths_move_together_and_the_aspect_alone() -> None:
    params = [900.0, 918.0, 400, 300, *([0.0] * 8)]
    camera = pycolmap.Camera(camera_id=1, model="FULL_OPENCV", width=800, height=600, params=params)
    lens = free_lens(camera, ("f", "aspect"), {}, {})
    assert lens.values == pytest.approx([900.0, 0.02])
    moved = lens.moved(np.array([9.0, 0.01])).camera.params
    assert moved[:2] == pytest.approx([909.0, 918.0 * 1.01 + 9.0])
