"""benchmarks: the synthetic flight is as described, and figures are reported as measured."""

from pathlib import Path

import flight_scene as scene
import numpy as np
import pycolmap
import pytest
from mapped_apart import centre_errors, pairs_by_look
from sfm_scaling import exponent

from splatpipe.pipeline.sfm.model.view_graph import read_verified

COUNT = 30


@pytest.fixture(scope="module")
def flight() -> scene.SyntheticFlight:
    return scene.make_flight(COUNT, 0)


def test_a_flight_has_the_requested_observations_and_noise(flight: scene.SyntheticFlight) -> None:
    per_photo = np.bincount(flight.photo)
    assert per_photo.min() > 1000 and per_photo.mean() > 1500
    assert np.bincount(flight.point).max() == scene.MAX_TRACK
    errors = []
    for number in range(COUNT):
        rows = flight.rows(number)
        rotation, centre = flight.cam_from_enu[number], flight.centres_m[number]
        local = (flight.points_m[flight.point[rows]] - centre) @ rotation.T
        assert (local[:, 2] > 0).all()
        errors.append(flight.places[rows] - scene.lens().img_from_cam(local))
    assert np.concatenate(errors).std() == pytest.approx(scene.NOISE_PX, rel=0.02)
    assert np.allclose(flight.cam_from_enu @ np.swapaxes(flight.cam_from_enu, 1, 2), np.eye(3))


def test_a_fifth_of_the_verified_matches_is_wrong_and_near_the_epipolar_line(
    flight: scene.SyntheticFlight, tmp_path: Path
) -> None:
    scene.write_database(flight, tmp_path / "database.db", 0)
    verified = read_verified(tmp_path / "database.db")
    wrong, total = 0, 0
    for (i, j), rows in verified.matches.items():
        first, second = flight.rows(i - 1), flight.rows(j - 1)
        same = flight.point[first][rows[:, 0]] == flight.point[second][rows[:, 1]]
        wrong, total = wrong + int((~same).sum()), total + len(same)
        assert len(np.unique(rows[:, 0])) == len(np.unique(rows[:, 1])) == len(rows)
    assert 0.17 < wrong / total <= 0.2
    assert verified.cameras[1].mean_focal_length() == pytest.approx(scene.FOCAL_OFF * scene.FOCAL_PX)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        geometry = database.read_two_view_geometry(1, 2)
    places = [
        np.column_stack(
            [verified.keypoints[k][geometry.inlier_matches[:, k - 1]], np.ones(len(geometry.inlier_matches))]
        )
        for k in (1, 2)
    ]
    lines = places[0] @ geometry.F.T
    off = np.abs((lines * places[1]).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)
    assert np.percentile(off, 95) < 2.0 * scene.EPIPOLAR_PX  # the lens bends the true ones off a pinhole's lines


def test_a_nameless_flight_is_the_same_flight_in_another_order(flight: scene.SyntheticFlight, tmp_path: Path) -> None:
    other = scene.anonymous(flight, 3)
    assert not np.array_equal(other.centres_m, flight.centres_m)
    assert np.array_equal(np.sort(other.centres_m[:, 0]), np.sort(flight.centres_m[:, 0]))
    for number in (0, 7):
        twin = int(np.flatnonzero((flight.centres_m == other.centres_m[number]).all(axis=1))[0])
        assert np.array_equal(other.places[other.rows(number)], flight.places[flight.rows(twin)])
    few = scene.anonymous(scene.make_flight(4, 0, 60), 0)
    scene.write_database(few, tmp_path / "database.db", 0, scene.guessed())
    scene.write_features(few, tmp_path / "features.db", 0)
    assert not read_verified(tmp_path / "database.db").cameras[1].has_prior_focal_length
    with pycolmap.Database.open(tmp_path / "features.db") as database:
        first, second = (np.asarray(database.read_descriptors(number).data, float) for number in (1, 2))
    _, ours, theirs = np.intersect1d(few.point[few.rows(0)], few.point[few.rows(1)], return_indices=True)
    assert len(ours) > 10 and np.array_equal((first[ours] @ second.T).argmax(axis=1), theirs)


def test_pairs_per_photo_are_bounded_for_any_number_of_photos(flight: scene.SyntheticFlight) -> None:
    small = 2 * len(scene.choose_pairs(flight, 0)) / COUNT
    large = 2 * len(scene.choose_pairs(scene.make_flight(90, 0, 10), 0)) / 90
    assert small < 30 and large < 30
    assert 2 * pairs_by_look(25) / 25 < 25


def test_centres_are_compared_with_the_truth_whatever_their_frame() -> None:
    rng = np.random.default_rng(0)
    true = rng.normal(size=(20, 3)) * [100.0, 80.0, 5.0]
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    errors, scale = centre_errors(0.2 * true @ turn.T + 7.0, true)
    assert errors.max() < 1e-9 and scale == pytest.approx(5.0)
    moved = true + [[3.0, 0.0, 0.0]] * 1 + np.eye(20, 3) * 0.5
    assert 0.1 < centre_errors(moved, true)[0].max() < 0.6
    assert exponent([{"photos": n, "cpu_s": 0.3 * n**1.2} for n in (10, 20, 40)]) == pytest.approx(1.2)
    assert exponent([{"photos": 10, "cpu_s": 1.0}]) is None
