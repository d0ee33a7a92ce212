"""The weighted fit of control and positions, and points from rays, against synthetic truth."""

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from splatpipe.pipeline.geometry.joint_fit import JointFit, JointObservations, Priors, find_blunders, fit_jointly
from splatpipe.pipeline.geometry.similarity import Similarity, rotation_from_vector
from splatpipe.pipeline.geometry.triangulation import Rays, triangulate
from splatpipe.pipeline.survey.placing.model import ModelView

Array = NDArray[np.float64]
TRUTH = Similarity(6.5, rotation_from_vector(np.array([1.9, -0.7, 0.4])), np.array([12.0, -7.0, 3.0]))
NEAR = Similarity(6.4, rotation_from_vector(np.array([1.88, -0.69, 0.42])), np.array([12.5, -6.0, 2.0]))
CONTROL, PHOTOS = 6, 20
OFFSET = np.array([0.8, -1.2, 47.0])


def observed(seed: int = 0, sigma: float = 0.02) -> tuple[JointObservations, Priors]:
    """Control, and positions of one flight that are off together."""
    rng = np.random.default_rng(seed)
    world = np.concatenate(
        [rng.uniform(-20, 20, (CONTROL, 3)), rng.uniform(-30, 30, (PHOTOS, 3)) + np.array([0, 0, 40])]
    )
    sigmas = np.concatenate([np.full((CONTROL, 3), sigma), np.full((PHOTOS, 3), 1.5)])
    target = world + rng.normal(size=world.shape) * sigmas
    target[CONTROL:] += OFFSET
    is_control = np.arange(len(world)) < CONTROL
    group = np.where(is_control, -1, 0).astype(np.int64)
    return (
        JointObservations(TRUTH.inverse().apply(world), target, sigmas, group, is_control),
        Priors(np.array([[9.0, 9.0, 1000.0]])),
    )


def errors(fit: JointFit, source: Array) -> Array:
    return np.asarray(fit.similarity.apply(source) - TRUTH.apply(source))


def test_control_determines_the_frame_and_the_flight_gets_its_offset() -> None:
    points, priors = observed()
    fit = fit_jointly(NEAR, points, priors)
    assert np.abs(errors(fit, points.source[:CONTROL])).max() < 0.05
    np.testing.assert_allclose(fit.offsets[0], OFFSET, atol=4.0 * 1.5 / np.sqrt(PHOTOS))


def test_stated_standard_deviations_are_those_of_many_fits() -> None:
    """Monte Carlo: 200 draws determine a standard deviation to 5 %; the tolerance is 20 %."""
    points, priors = observed()
    exact = TRUTH.apply(points.source) + np.where(points.is_control[:, None], 0.0, OFFSET)
    place = TRUTH.inverse().apply(np.array([[5.0, 8.0, 2.0], [-15.0, 3.0, 9.0]]))
    rng = np.random.default_rng(1)
    drawn = []
    for _ in range(200):
        target = exact + rng.normal(size=exact.shape) * points.sigmas
        noisy = JointObservations(points.source, target, points.sigmas, points.group, points.is_control)
        drawn.append(errors(fit_jointly(TRUTH, noisy, priors), place))
    stated = fit_jointly(TRUTH, points, priors).sigmas_at(place)
    np.testing.assert_allclose(np.std(drawn, axis=0), stated, rtol=0.2)


def test_unknown_heights_do_not_matter() -> None:
    points, priors = observed()
    sigmas, target = points.sigmas.copy(), points.target.copy()
    sigmas[:2, 2], target[:2, 2] = np.inf, -1000.0
    fit = fit_jointly(NEAR, JointObservations(points.source, target, sigmas, points.group, points.is_control), priors)
    assert np.abs(errors(fit, points.source[:CONTROL])).max() < 0.05


@pytest.mark.parametrize("wrong", [(), (4,), (1, 3)])
def test_blunders_are_found_and_nothing_else(wrong: tuple[int, ...]) -> None:
    points, priors = observed()
    for index in wrong:
        points.target[index, 0] += 0.5
    assert find_blunders(NEAR, points, priors, 0.05) == wrong


def rays(seed: int = 0) -> tuple[Rays, Array]:
    """Six cameras on an arc that look at a point, with half a pixel of noise."""
    rng = np.random.default_rng(seed)
    point, focal = np.array([1.0, 2.0, 3.0]), 1000.0
    poses, seen = [], []
    for angle in np.linspace(-0.6, 0.6, 6):
        rotation = rotation_from_vector(np.array([0.1, angle, 0.05]))
        pose = np.column_stack([rotation, np.array([0.2, -0.1, 20.0]) - rotation @ point])
        x, y, z = pose @ np.append(point, 1.0)
        poses.append(pose)
        seen.append(np.array([x / z, y / z]) + rng.normal(size=2) * 0.5 / focal)
    return Rays(np.array(poses), np.array(seen), np.tile(focal * np.eye(2), (6, 1, 1))), point


def test_blunders_among_very_many_points_are_found() -> None:
    """More points than are tried one by one."""
    rng = np.random.default_rng(3)
    world = rng.uniform(-50.0, 50.0, (400, 3))
    target = world + rng.normal(size=world.shape) * 0.06
    target[[7, 123, 399]] += [1.5, -1.0, 0.8]
    count = len(world)
    many = JointObservations(
        TRUTH.inverse().apply(world), target, np.full((count, 3), 0.02), np.full(count, -1), np.ones(count, bool)
    )
    assert find_blunders(NEAR, many, Priors(np.zeros((0, 3))), 0.1) == (7, 123, 399)


def test_triangulated_point_is_as_accurate_as_its_covariance() -> None:
    normed = []
    for seed in range(60):
        seen, point = rays(seed)
        found = triangulate(seen, 5.0)
        assert found is not None
        assert found.agree.all()
        off = found.xyz - point
        normed.append(off @ np.linalg.solve(0.25 * found.covariance, off) / 3.0)
    assert np.mean(normed) == pytest.approx(1.0, abs=0.3)


def test_wrong_ray_is_found_and_parallel_ones_give_no_point() -> None:
    seen, point = rays()
    seen.rays[2] += [0.05, 0.0]
    found = triangulate(seen, 5.0)
    assert found is not None
    assert found.agree.tolist() == [True, True, False, True, True, True]
    assert np.linalg.norm(found.xyz - point) < 0.05
    one = Rays(seen.cam_from_world[[0, 0]], seen.rays[[0, 0]], seen.pixels[[0, 0]])
    assert triangulate(one, 5.0) is None
    back = np.column_stack([np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, 10.0])])
    head_on = Rays(np.stack([np.eye(3, 4), back]), np.zeros((2, 2)), seen.pixels[:2])
    assert triangulate(head_on, 5.0) is None


def test_lens_weighs_marks_as_it_shows_them() -> None:
    """Against the derivative of x = f u (1 + k r²) by hand, in photos twice as large as the model's."""
    f, k = 800.0, -0.2
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=1200, height=900, params=[f, 600.0, 450.0, k])
    view = ModelView(camera, np.eye(3, 4), scale=0.5)
    u, v = ray = np.array([0.5, -0.3])
    radial, squares = 1.0 + k * (u * u + v * v), np.array([[u * u, u * v], [u * v, v * v]])
    by_hand = 2.0 * f * (radial * np.eye(2) + 2.0 * k * squares)
    np.testing.assert_allclose(view.pixels_by_ray(ray), by_hand, rtol=1e-6, atol=1e-4)
    assert np.isnan(view.pixels_by_ray(np.full(2, np.nan))).all()
