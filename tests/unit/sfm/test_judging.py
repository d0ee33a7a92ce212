"""Judging a model by verified matches: right ones are good, each kind of error is called bad, with its reason."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from lens_scene import HEIGHT, WIDTH
from like_sides import folded, make_sides, unfolded
from view_graph import FOCAL, Ring, make_ring, model_of, moved, turn_up, with_matches, with_shifted_matches

from splatpipe.pipeline.sfm.judging.agreement import compare, contradicting, epipolar_errors
from splatpipe.pipeline.sfm.judging.cuts import find_cut
from splatpipe.pipeline.sfm.judging.doubles import doubles_reasons, find_doubles
from splatpipe.pipeline.sfm.judging.external_evidence import disagreement
from splatpipe.pipeline.sfm.judging.judging import judge

TRUSTED = [{"has_prior": True, "focal_source": "sensor-table"}]
ROUGH = [{"has_prior": True, "focal_source": "35mm-equivalent"}]


@pytest.fixture(scope="module")
def ring() -> Ring:
    return make_ring()


def test_the_true_model_is_good_and_explains_the_matches(ring: Ring) -> None:
    found = judge(model_of(ring), ring.verified, TRUSTED)
    assert (found.level, found.reasons, found.contradicted) == ("good", (), 0)
    assert found.explained > 0.99
    assert found.pairs == len(ring.verified.matches)


def test_a_few_pairs_that_only_look_alike_do_not_make_a_true_model_bad(ring: Ring) -> None:
    graph = with_matches(ring, {(1, 12): 18, (5, 17): 20, (3, 14): 16, (8, 20): 25})
    found = judge(model_of(ring), graph, TRUSTED)
    assert (found.level, found.contradicted) == ("good", 4)


def test_large_photos_whose_keypoints_were_found_in_reduced_ones_are_judged_equally(ring: Ring) -> None:
    """Seven times the size, seven times the noise: 3.5 pixels correspond to half a pixel in a photo of 1,200."""
    model = model_of(ring)
    lens = pycolmap.Camera(model.cameras[1].todict())
    for camera in (model.cameras[1], lens):
        camera.rescale(7.0)
    keypoints = {number: places * np.float32(7.0) for number, places in ring.verified.keypoints.items()}
    large = judge(model, replace(ring.verified, cameras={1: lens}, keypoints=keypoints), TRUSTED)
    small = judge(model_of(ring), ring.verified, TRUSTED)
    assert (large.level, large.contradicted) == (small.level, small.contradicted) == ("good", 0)
    assert large.explained > small.explained - 0.02


def test_a_model_whose_halves_disagree_is_bad(ring: Ring) -> None:
    half = range(13, 25)  # rotated and scaled about the first of its cameras, like an incremental mapper's joint
    bent = model_of(ring, moved(ring, half, ring.centre(13), turn_up(8.0), 1.15))
    found = judge(bent, ring.verified, TRUSTED)
    assert (found.level, found.reasons[0].kind, found.reasons[0].level) == ("bad", "bent", "bad")
    assert "contradict" in found.reasons[0].text and found.reasons[0].hint
    assert found.score < judge(model_of(ring), ring.verified, TRUSTED).score - 0.05


def test_the_photos_of_a_misplaced_group_are_named(ring: Ring) -> None:
    ghost = (9, 10, 11, 12)
    poses = moved(ring, ghost, np.zeros(3), turn_up(30.0), 1.0)
    agreement = compare(model_of(ring, poses), ring.verified)
    cut = find_cut(agreement, contradicting(agreement))
    assert cut.group == ghost and cut.ratio > 1.0
    found = judge(model_of(ring, poses), ring.verified, TRUSTED)
    assert found.level == "bad" and "4 photos (009.jpg, 010.jpg, …) disagree" in found.reasons[0].text


@pytest.mark.parametrize("cameras", [TRUSTED, ROUGH])
def test_an_implausible_focal_length_is_bad(ring: Ring, cameras: list[dict[str, object]]) -> None:
    found = judge(model_of(ring, focal=2.4 * FOCAL), ring.verified, cameras)
    assert found.level == "bad"
    assert any(reason.kind == "focal" and "2400 pixels, +140 %" in reason.text for reason in found.reasons)


@pytest.mark.parametrize(("photos", "level"), [(2, "doubt"), (6, "bad")])
def test_a_focal_length_of_few_photos_does_not_affect_the_verdict_on_the_others(
    ring: Ring, photos: int, level: str
) -> None:
    stated = ring.verified.cameras[1]
    second = pycolmap.Camera(stated.todict())
    second.camera_id = 2
    camera_of = {number: 2 if number <= photos else 1 for number in ring.poses}
    model = pycolmap.Reconstruction()
    for camera in (stated, second):
        model.add_camera_with_trivial_rig(pycolmap.Camera(camera.todict()))
    for number, pose in ring.poses.items():
        places = ring.verified.keypoints[number].astype(np.float64)
        image = pycolmap.Image(ring.verified.names[number], places, camera_of[number], number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    second.params = [0.3 * FOCAL, *second.params[1:]]  # the metadata describe another lens
    graph = replace(ring.verified, camera_of=camera_of, cameras={1: stated, 2: second})
    assert judge(model, graph, [TRUSTED[0], ROUGH[0]]).level == level


def test_only_a_trusted_focal_length_is_held_against_a_model(ring: Ring) -> None:
    model = model_of(ring, focal=0.8 * FOCAL)
    kinds = [{reason.kind for reason in judge(model, ring.verified, cameras).reasons} for cameras in (TRUSTED, ROUGH)]
    assert "focal" in kinds[0] and "focal" not in kinds[1]


def test_a_model_of_a_fifth_of_the_photos_is_bad(ring: Ring) -> None:
    found = judge(model_of(ring, photos=range(1, 6)), ring.verified, TRUSTED)
    assert (found.level, found.reasons[0].kind) == ("bad", "placed")
    assert "Only 5 of 24 photos" in found.reasons[0].text
    assert found.explained < 0.2


def test_the_distance_from_an_epipolar_line_is_that_of_the_noise() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.0, 1.0, (500, 3)) + np.array([0.0, 0.0, 6.0])
    one, two = np.eye(3, 4), np.column_stack([turn_up(3.0), [-1.0, 0.2, 0.1]])
    seen = [points @ pose[:, :3].T + pose[:, 3] for pose in (one, two)]
    exact = [place[:, :2] / place[:, 2:] for place in seen]
    assert epipolar_errors(*exact, one, two, 1e-3).max() < 1e-9
    noisy = [place + rng.normal(0.0, 1e-3, place.shape) for place in exact]
    # Sampson's distance of two places of noise s each is |N(0, s)|: the two distances share the correction.
    assert np.median(epipolar_errors(*noisy, one, two, 1e-3)) == pytest.approx(0.6745e-3, rel=0.1)
    behind = np.column_stack([turn_up(3.0), [1.0, -0.2, -0.1]])  # the other way along the same line: points behind
    assert np.isinf(epipolar_errors(*exact, one, behind, 1e-3)).mean() > 0.95


def test_positions_distinguish_a_bend_from_noise(ring: Ring) -> None:
    rng = np.random.default_rng(5)
    true = 10.0 * np.array([ring.centre(number) for number in range(1, 25)])  # metres; the ring's radius is 200
    noisy = disagreement(true + rng.normal(0.0, 3.0, true.shape), true)
    assert noisy.median_m < 8.0 and noisy.smooth > 0.8
    half = moved(ring, range(13, 25), ring.centre(13), turn_up(25.0), 1.2)
    bent = np.array([-pose[:, :3].T @ pose[:, 3] for pose in {**ring.poses, **half}.values()])
    off = disagreement(bent, true + rng.normal(0.0, 1.0, true.shape))
    assert off.median_m > 0.04 * off.size_m and off.smooth < 0.5


def test_matches_that_are_the_models_own_observations_are_distinguished_from_others(ring: Ring) -> None:
    model = model_of(ring)
    rows = {number: {int(point): row for row, point in enumerate(point_ids)} for number, point_ids in ring.rows.items()}
    point = int(np.intersect1d(ring.rows[1], ring.rows[2])[0])
    track = pycolmap.Track([pycolmap.TrackElement(number, rows[number][point]) for number in (1, 2)])
    model.add_point3D(ring.points[point], track, np.zeros(3, np.uint8))
    first = compare(model, ring.verified)
    own = [int(rows[1][point]), int(rows[2][point])] in ring.verified.matches[1, 2].tolist()
    assert first.held_out[0] == first.matches[0] - own


def test_rows_of_windows_do_not_speak_against_a_right_model(ring: Ring) -> None:
    """A quarter of all pairs match a place beside the right one, consistently; the castle has a third."""
    found = judge(model_of(ring), with_shifted_matches(ring, 40), TRUSTED)
    assert (found.level, found.reasons) == ("good", ())
    assert found.contradicted >= 36 and len(found.alike) > 0.7 * found.contradicted  # in the rest the bay is narrow
    assert found.reachable < found.score + 0.005


@pytest.mark.parametrize(("degrees", "level"), [(0.25, "bad"), (0.5, "bad"), (1.0, "bad"), (40.0, "bad")])
def test_a_ring_bent_by_little_or_much_is_known_by_the_arrangement_that_explains_more(
    ring: Ring, degrees: float, level: str
) -> None:
    bent = model_of(ring, moved(ring, range(13, 25), ring.centre(13), turn_up(degrees), 1.0 + degrees / 100.0))
    found = judge(bent, ring.verified, TRUSTED)
    true = judge(model_of(ring), ring.verified, TRUSTED)
    assert found.level == level and found.reasons[0].kind == "bent"
    assert found.reachable == pytest.approx(true.score, abs=0.003)  # the arrangement found is the true one
    assert set(found.better) == set(ring.poses) and not true.better


def test_a_group_far_from_its_place_is_moved_back(ring: Ring) -> None:
    found = judge(
        model_of(ring, moved(ring, (9, 10, 11, 12), np.zeros(3), turn_up(120.0), 1.0)), ring.verified, TRUSTED
    )
    assert found.reachable > 0.89 and not found.alike


@pytest.mark.parametrize("alike", [0.1, 0.3, 0.5])
def test_two_like_sides_that_are_taken_for_one_are_known_by_what_is_missing(alike: float) -> None:
    """No pair contradicts the folded model, and no arrangement explains more."""
    sides = make_sides(alike)
    model = folded(sides, alike)
    tried = [(i, j) for j in sides.poses for i in range(1, j)]
    assert judge(model, sides.verified, TRUSTED).level == "good"
    found = find_doubles(model, tried)
    (reason,) = doubles_reasons(sides.verified, found)
    assert (reason.level, reason.kind) == ("bad", "doubles")
    one, two = found.pair
    assert one <= 12 < two and all(sides.verified.names[number] in reason.text for number in found.pair)
    assert len({number <= 12 for number in found.group}) == 1  # all of one side
    assert all(0.0 < x < WIDTH and 0.0 < y < HEIGHT for x, y in found.places)


def test_what_was_never_matched_is_not_missing() -> None:
    sides = make_sides(0.3)
    found = find_doubles(folded(sides, 0.3), sorted(pair for pair in sides.verified.matches if pair[1] <= 12))
    assert doubles_reasons(sides.verified, found) == []


def test_a_right_model_lacks_nothing() -> None:
    sides = make_sides(0.3)
    found = find_doubles(unfolded(sides), [(i, j) for j in sides.poses for i in range(1, j)])
    assert found.ratio < 0.02 and found.as_json(sides.verified) is None
