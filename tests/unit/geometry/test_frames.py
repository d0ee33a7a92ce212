"""Similarities, geodesy and the robust fit, against truth, group laws and PROJ."""

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.alignment import Correspondences, DirectionPrior, robust_similarity
from splatpipe.pipeline.geometry.similarity import Similarity, fit_similarity, rotation_from_vector
from splatpipe.pipeline.geometry.upright import (
    camera_axes,
    display_from_stored,
    enu_from_gimbal,
    mean_rotation,
    rotation_to_up,
    up_from_cameras,
)
from splatpipe.pipeline.survey.crs.frames import Frame, load_frame, save_frame
from splatpipe.pipeline.survey.crs.geodesy import Origin, ecef_from_geodetic, geodetic_from_ecef

EXACT = 1e-12  # float64, a few products of numbers near one


def random_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    return Similarity(float(np.exp(rng.normal())), rotation_from_vector(rng.normal(size=3) * 2.0), rng.normal(size=3))


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_similarities_form_a_group(seed: int) -> None:
    a, b, c = (random_similarity(3 * seed + i) for i in range(3))
    points = np.random.default_rng(seed).normal(size=(5, 3))
    np.testing.assert_allclose(a.compose(b).matrix(), a.matrix() @ b.matrix(), atol=1e-9)
    np.testing.assert_allclose(a.compose(b).apply(points), a.apply(b.apply(points)), atol=1e-9)
    np.testing.assert_allclose(a.compose(b.compose(c)).matrix(), a.compose(b).compose(c).matrix(), atol=1e-9)
    np.testing.assert_allclose(a.inverse().compose(a).matrix(), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(Similarity.from_matrix(a.matrix()).matrix(), a.matrix(), atol=1e-9)
    np.testing.assert_allclose(Similarity.identity().compose(a).matrix(), a.matrix(), atol=EXACT)


def test_camera_pose_sees_the_same_pixel_in_either_frame() -> None:
    similarity = random_similarity(1)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_vector(np.array([0.3, -0.2, 1.0])), [0.4, 0.5, 0.6]
    points = np.random.default_rng(2).normal(size=(10, 3))
    before = points @ pose[:3, :3].T + pose[:3, 3]
    moved = similarity.camera_pose(pose)
    after = similarity.apply(points) @ moved[:3, :3].T + moved[:3, 3]
    np.testing.assert_allclose(after, similarity.scale * before, atol=1e-10)


@pytest.mark.parametrize(
    "matrix", [np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([1.0, 2.0, 1.0, 1.0]), np.zeros((4, 4)), np.full((4, 4), np.nan)]
)
def test_mirrored_sheared_and_zero_matrices_are_no_similarities(matrix: np.ndarray) -> None:
    with pytest.raises(ValueError, match="not a similarity"):
        Similarity.from_matrix(matrix)


def test_ecef_agrees_with_proj_and_comes_back() -> None:
    rng = np.random.default_rng(0)
    geodetic = np.stack(
        [rng.uniform(-90, 90, 500), rng.uniform(-180, 180, 500), rng.uniform(-500, 20_000, 500)], axis=1
    )
    geodetic = np.concatenate([geodetic, [[90.0, 0.0, 10.0], [-90.0, 0.0, 10.0], [0.0, 180.0, 0.0], [0.0, 0.0, 0.0]]])
    transformer = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    theirs = np.stack(transformer.transform(geodetic[:, 1], geodetic[:, 0], geodetic[:, 2]), axis=1)
    ours = ecef_from_geodetic(geodetic)
    np.testing.assert_allclose(ours, theirs, atol=1e-8)  # metres; 6e6 m times float64's 1e-16
    back = geodetic_from_ecef(ours)
    np.testing.assert_allclose(back[:, 0], geodetic[:, 0], atol=1e-11)
    apart = (back[:, 1] - geodetic[:, 1] + 180.0) % 360.0 - 180.0
    inner = np.abs(geodetic[:, 0]) < 90.0  # a pole has no longitude
    np.testing.assert_allclose(apart[inner], 0.0, atol=1e-11)
    np.testing.assert_allclose(back[:, 2], geodetic[:, 2], atol=1e-7)


def test_local_frame_is_east_north_up_and_comes_back() -> None:
    origin = Origin(46.8, -91.9, 190.0)
    around = np.array([[46.8, -91.9, 190.0], [46.8, -91.899, 190.0], [46.801, -91.9, 190.0], [46.8, -91.9, 200.0]])
    enu = origin.enu_from_geodetic(around)
    np.testing.assert_allclose(enu[0], 0.0, atol=1e-8)
    assert enu[1, 0] == pytest.approx(76.3, abs=0.2)
    assert abs(enu[1, 1]) < 1e-3
    assert enu[2, 1] == pytest.approx(111.2, abs=0.2)
    np.testing.assert_allclose(enu[3], [0.0, 0.0, 10.0], atol=1e-8)
    np.testing.assert_allclose(origin.geodetic_from_enu(enu), around, atol=1e-9)
    matrix = origin.ecef_from_enu()
    np.testing.assert_allclose(enu @ matrix[:3, :3].T + matrix[:3, 3], ecef_from_geodetic(around), atol=1e-8)


def noisy(count: int, outliers: int, sigma: tuple[float, float], seed: int) -> tuple[Similarity, Correspondences]:
    """A survey of 80 m × 60 m at two heights, seen by GPS."""
    rng = np.random.default_rng(seed)
    truth = Similarity(7.3, rotation_from_vector(rng.normal(size=3)), rng.normal(size=3) * 50.0)
    target = np.stack(
        [rng.uniform(-40, 40, count), rng.uniform(-30, 30, count), rng.choice([30.0, 45.0], count)], axis=1
    )
    source = truth.inverse().apply(target)
    sigmas = np.tile([sigma[0], sigma[0], sigma[1]], (count, 1))
    measured = target + rng.normal(size=(count, 3)) * sigmas
    measured[:outliers] += rng.normal(size=(outliers, 3)) * 100.0 + 60.0
    return truth, Correspondences(source, measured, sigmas)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("sigma", [(0.02, 0.03), (1.5, 3.0)])
def test_fit_is_within_its_own_sigma_despite_outliers(seed: int, sigma: tuple[float, float]) -> None:
    truth, points = noisy(40, 12, sigma, seed)
    fit = robust_similarity(points, 10.0)
    assert not fit.inliers[:12].any()
    assert fit.inliers[12:].mean() > 0.95
    turn = truth.rotation.T @ fit.similarity.rotation
    angle = np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0))
    assert abs(fit.similarity.scale / truth.scale - 1.0) < 4.0 * fit.sigma_scale
    assert angle < 4.0 * fit.sigma_rotation_rad
    assert 0.6 < fit.noise < 1.4
    expected = 4.0 * np.hypot(*sigma) / np.sqrt(28)
    centre = points.source[12:].mean(axis=0)[None]
    assert np.linalg.norm(fit.similarity.apply(centre) - truth.apply(centre)) < expected


def test_fit_of_exact_points_is_exact_and_repeats_to_the_bit() -> None:
    truth, points = noisy(20, 5, (1e-12, 1e-12), 3)
    first, second = robust_similarity(points, 10.0), robust_similarity(points, 10.0)
    np.testing.assert_allclose(first.similarity.matrix(), truth.matrix(), atol=1e-9)
    assert first.similarity.matrix().tobytes() == second.similarity.matrix().tobytes()


@given(st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_mirrored_points_never_give_a_reflection(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(12, 3)) * 20.0
    mirrored = source * [1.0, 1.0, -1.0]
    fit = robust_similarity(Correspondences(source, mirrored, np.ones((12, 3))), 10.0)
    assert np.linalg.det(fit.similarity.rotation) == pytest.approx(1.0)
    assert fit.similarity.scale > 0.0
    _, rotation, _ = fit_similarity(source, mirrored, np.ones(12))
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_accurate_positions_outweigh_rough_ones() -> None:
    truth, rough = noisy(60, 0, (3.0, 5.0), 5)
    sigmas = rough.sigmas.copy()
    target = rough.target.copy()
    sigmas[:6] = [0.02, 0.02, 0.03]
    target[:6] = truth.apply(rough.source[:6]) + np.random.default_rng(1).normal(size=(6, 3)) * sigmas[:6]
    fit = robust_similarity(Correspondences(rough.source, target, sigmas), 20.0)
    error = fit.similarity.apply(rough.source) - truth.apply(rough.source)
    assert np.linalg.norm(error, axis=1).max() < 0.3


def test_line_of_cameras_takes_its_free_rotation_from_the_prior() -> None:
    rng = np.random.default_rng(0)
    truth = Similarity(4.0, rotation_from_vector(np.array([0.5, -1.0, 0.7])), np.array([5.0, 6.0, 7.0]))
    target = np.stack([np.linspace(-50, 50, 15), np.linspace(-20, 20, 15), np.full(15, 30.0)], axis=1)
    sigmas = np.tile([0.5, 0.5, 1.0], (15, 1))
    points = Correspondences(truth.inverse().apply(target), target + rng.normal(size=(15, 3)) * sigmas, sigmas)
    up = truth.rotation.T @ [0.0, 0.0, 1.0]
    free = robust_similarity(points, 10.0)
    assert free.sigma_rotation_rad > 1.0
    held = robust_similarity(points, 10.0, DirectionPrior(up[None], np.array([[0.0, 0.0, 1.0]]), np.radians(3.0)))
    assert held.used_prior
    assert held.sigma_rotation_rad < np.radians(6.0)
    assert (held.similarity.rotation @ up)[2] > np.cos(np.radians(4.0))
    assert held.similarity.scale == pytest.approx(4.0, rel=0.03)


def test_well_distributed_cameras_ignore_a_wrong_prior() -> None:
    _, points = noisy(40, 0, (0.5, 1.0), 7)
    wrong = DirectionPrior(np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]]), 0.05)
    with_prior, without = robust_similarity(points, 10.0, wrong), robust_similarity(points, 10.0)
    assert not with_prior.used_prior
    np.testing.assert_array_equal(with_prior.similarity.matrix(), without.similarity.matrix())


def test_too_few_or_coinciding_points_are_refused() -> None:
    two, same = np.eye(3)[:2], np.ones((5, 3))
    with pytest.raises(ValueError, match="at least 3"):
        robust_similarity(Correspondences(two, two, np.ones((2, 3))), 1.0)
    with pytest.raises(ValueError, match="coincide"):
        robust_similarity(Correspondences(same, same, same), 1.0)


def test_frame_reads_back_to_the_bit(tmp_path: Path) -> None:
    frame = Frame(
        "enu",
        random_similarity(5),
        Origin(46.84266, -91.994, 199.0),
        residuals={"rmse_m": 0.5},
        left_out=("ä b.jpg",),
        note="From …",
    )
    save_frame(frame, tmp_path / "frame.json")
    again = load_frame(tmp_path / "frame.json")
    assert again.world_from_model.matrix().tobytes() == frame.world_from_model.matrix().tobytes()
    assert (again.kind, again.origin, again.left_out, again.note) == ("enu", frame.origin, ("ä b.jpg",), "From …")
    assert load_frame(tmp_path / "frame.json").residuals == {"rmse_m": 0.5}


@pytest.mark.parametrize("change", [{"scale": -1.0}, {"kind": "moon"}, {"rotation": [1.0]}, {"scale": "x"}])
def test_broken_frame_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    path = tmp_path / "frame.json"
    save_frame(Frame("arbitrary", Similarity.identity()), path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(SplatpipeError, match="cannot be read"):
        load_frame(path)


def looking_along(forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Rotation from the world to a camera that looks along ``forward`` with its top towards ``up``."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


GROUND = np.random.default_rng(4).uniform(-30, 30, (400, 3)) * [1.0, 1.0, 0.001]
TURN = rotation_from_vector(np.array([0.9, -0.4, 1.3]))  # rotation of the model against the world


def estimate(
    cameras: list[np.ndarray], centres: np.ndarray, points: np.ndarray = GROUND, orientation: int = 1
) -> float:
    """Degrees between the estimated and the true up, in a turned model."""
    stored = np.stack([display_from_stored(orientation).T @ camera @ TURN.T for camera in cameras])
    axes = camera_axes(stored, np.full(len(cameras), orientation, dtype=np.int64))
    upright = up_from_cameras(axes, centres @ TURN.T, points @ TURN.T)
    return float(np.degrees(np.arccos(np.clip(upright.up @ TURN @ [0.0, 0.0, 1.0], -1.0, 1.0))))


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("pitch_deg", [-60.0, -20.0, 25.0])
def test_up_of_an_orbit_whatever_its_pitch_and_however_stored(pitch_deg: float, orientation: int) -> None:
    angles = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    outwards = np.stack([np.cos(angles), np.sin(angles), np.zeros(20)], axis=1)
    pitch = np.radians(pitch_deg)
    cameras = [
        looking_along(-out * np.cos(pitch) + np.array([0, 0, np.sin(pitch)]), np.array([0, 0, 1.0])) for out in outwards
    ]
    assert estimate(cameras, outwards * 20.0, orientation=orientation) < 1.0


def test_up_of_nadir_strips_flown_back_and_forth_or_with_constant_heading() -> None:
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(6) * 10.0, np.arange(4) * 12.0), axis=-1).reshape(-1, 2)
    centres = np.concatenate([grid, np.full((len(grid), 1), 40.0)], axis=1)
    down = np.array([0.0, 0.0, -1.0]) + rng.normal(size=(len(grid), 3)) * 0.01
    north, flown = np.array([0.0, 1.0, 0.0]), [1.0 if row % 24.0 == 0.0 else -1.0 for row in grid[:, 1]]
    assert estimate([looking_along(d, north) for d in down], centres) < 1.5
    assert estimate([looking_along(d, north * sign) for d, sign in zip(down, flown, strict=True)], centres) < 1.5


def test_up_of_a_walk_along_a_street_is_that_of_the_photos() -> None:
    rng = np.random.default_rng(5)
    centres = np.stack([np.linspace(0.0, 40.0, 30), rng.normal(scale=0.3, size=30), rng.normal(1.6, 0.3, 30)], axis=1)
    ahead = np.array([1.0, 0.0, 0.0]) + rng.normal(size=(30, 3)) * 0.05
    assert estimate([looking_along(forward, np.array([0.0, 0.0, 1.0])) for forward in ahead], centres) < 3.0


def test_up_below_a_swaying_kite_is_normal_to_the_ground() -> None:
    rng = np.random.default_rng(1)
    centres = np.stack([rng.uniform(-20, 20, 30), rng.uniform(-20, 20, 30), rng.uniform(45, 55, 30)], axis=1)
    tilt = np.array([0.3, 0.0, -1.0]) + rng.normal(size=(30, 3)) * 0.15
    assert estimate([looking_along(d, np.array([0.0, 1.0, 0.0])) for d in tilt], centres) < 1.0


def test_photos_along_a_facade_are_not_taken_for_a_survey() -> None:
    centres = np.stack([np.linspace(-15, 15, 12), np.full(12, -20.0), np.full(12, 1.7)], axis=1)
    cameras = [looking_along(np.array([0.01 * i, 1.0, 0.1]), np.array([0.0, 0.0, 1.0])) for i in range(12)]
    assert estimate(cameras, centres) < 8.0  # all tilted up by 6°, and nothing reveals it


def test_gimbal_angles_place_the_camera() -> None:
    angles = np.array([[0.0, 0.0, 0.0], [90.0, 0.0, 0.0], [45.0, -90.0, 0.0], [0.0, 0.0, 90.0]])
    enu = enu_from_gimbal(*angles.T.copy())
    np.testing.assert_allclose(enu[0] @ [0, 0, 1], [0, 1, 0], atol=EXACT)  # looks north
    np.testing.assert_allclose(enu[0] @ [0, -1, 0], [0, 0, 1], atol=EXACT)  # its top is up
    np.testing.assert_allclose(enu[1] @ [0, 0, 1], [1, 0, 0], atol=EXACT)  # looks east
    np.testing.assert_allclose(enu[2] @ [0, 0, 1], [0, 0, -1], atol=EXACT)  # looks down
    np.testing.assert_allclose(enu[2] @ [0, -1, 0], [np.sqrt(0.5), np.sqrt(0.5), 0], atol=EXACT)  # top to north-east
    np.testing.assert_allclose(enu[3] @ [1, 0, 0], [0, 0, -1], atol=EXACT)  # right side down: clockwise
    np.testing.assert_allclose(np.linalg.det(enu), 1.0, atol=EXACT)


def test_mean_rotation_ignores_a_minority() -> None:
    truth = rotation_from_vector(np.array([1.0, 2.0, 0.5]))
    wrong = rotation_from_vector(np.array([0.0, 0.0, 2.0])) @ truth
    mean, spread = mean_rotation(np.stack([truth] * 7 + [wrong] * 3))
    assert np.degrees(np.arccos((np.trace(mean @ truth.T) - 1) / 2)) < 1.0
    assert spread < 0.02


@pytest.mark.parametrize("up", [[0, 0, 1.0], [0, 0, -1.0], [1.0, 0, 0], [0.6, 0, -0.8]])
def test_rotation_to_up_brings_up_to_z(up: list[float]) -> None:
    rotation = rotation_to_up(np.array(up))
    np.testing.assert_allclose(rotation @ up, [0.0, 0.0, 1.0], atol=EXACT)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=EXACT)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
