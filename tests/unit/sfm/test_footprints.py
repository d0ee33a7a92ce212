"""Pairs by overlapping footprints: against plain geometry, and against the demo photos' true overlap."""

import json
from pathlib import Path

import numpy as np
import pytest

from splatpipe.demo import capture_path
from splatpipe.pipeline.geometry.upright import enu_from_gimbal
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.photos.files.scan import Candidate
from splatpipe.pipeline.photos.intake.check import CheckedPhoto, PictureLimits, check_photo
from splatpipe.pipeline.sfm.pairing.footprints import StatedPoses, crossing_distances, overlaps
from splatpipe.pipeline.sfm.pairing.layout import make_layout, make_views
from splatpipe.pipeline.sfm.pairing.pairs import Costs, Layout, choose_pairing, components, select_pairs
from splatpipe.pipeline.survey.positions.photo_positions import positions_json, read_positions

HALF_SIZE = (0.6, 0.45)


def views(centres: np.ndarray, yaw: np.ndarray, pitch: np.ndarray) -> StatedPoses:
    count = len(centres)
    return StatedPoses(
        centres.astype(np.float64),
        enu_from_gimbal(yaw.astype(np.float64), pitch.astype(np.float64), np.zeros(count)),
        np.tile(HALF_SIZE, (count, 1)),
        np.zeros(count),
    )


def nadir(centres: np.ndarray) -> StatedPoses:
    return views(centres, np.zeros(len(centres)), np.full(len(centres), -90.0))


def orbit(count: int, radius_m: float, height_m: float) -> StatedPoses:
    """Around a building, looking at it."""
    azimuths = np.arange(count) * 360.0 / count
    radians = np.radians(azimuths)
    centres = np.stack([radius_m * np.sin(radians), radius_m * np.cos(radians), np.full(count, height_m)], axis=1)
    return views(centres, azimuths + 180.0, np.full(count, -np.degrees(np.arctan2(height_m - 4.0, radius_m))))


def never() -> Costs:
    raise AssertionError("the photos' content is not needed")


def layout_of(these: StatedPoses) -> Layout:
    count = len(these)
    names = [f"{index:04d}.jpg" for index in range(count)]
    return Layout(names, np.full(count, np.nan), these.centres_m, np.full(count, 1.0), these.axes, these)


@pytest.mark.parametrize("step_m", [0.0, 8.0, 16.0, 24.0, 60.0])
def test_footprints_of_nadir_photos_overlap_as_rectangles_do(step_m: float) -> None:
    """From 40 m up an image is 48 m wide; a grid of five rays resolves the share to a fifth."""
    found = overlaps(nadir(np.array([[0.0, 0.0, 40.0], [step_m, 0.0, 40.0]])), 10).get((0, 1), 0.0)
    assert found == pytest.approx(max(0.0, 1.0 - step_m / 48.0), abs=0.21)
    assert (found == 0.0) == (step_m == 60.0)


def test_photos_from_one_place_in_opposite_directions_show_nothing_in_common() -> None:
    back_to_back = views(np.tile([0.0, 0.0, 10.0], (2, 1)), np.array([0.0, 180.0]), np.array([-20.0, -20.0]))
    assert overlaps(back_to_back, 10) == {}


def test_views_of_an_orbit_cross_at_the_building() -> None:
    these = orbit(24, 30.0, 14.0)
    np.testing.assert_allclose(crossing_distances(these), np.hypot(30.0, 10.0), rtol=0.02)
    assert np.isnan(crossing_distances(nadir(np.array([[x, 0.0, 40.0] for x in range(5)])))).all()


def test_neighbours_on_an_orbit_overlap_most_and_opposite_photos_not() -> None:
    shares = overlaps(orbit(24, 30.0, 14.0), 100)
    by_step = [
        np.mean([shares.get(tuple(sorted((i, (i + step) % 24))), 0.0) for i in range(24)]) for step in range(1, 13)
    ]  # type: ignore[arg-type]
    assert (np.diff(by_step) <= 1e-9).all()
    assert by_step[0] > 0.5
    assert by_step[11] == 0.0


def test_photos_without_metadata_overlap_with_none() -> None:
    these = orbit(12, 30.0, 14.0)
    these.centres_m[3] = np.nan
    these.enu_from_camera[3] = np.nan
    shares = overlaps(these, 100)
    assert shares and all(3 not in pair for pair in shares)


def test_strips_are_matched_with_overlapping_photos_only() -> None:
    grid = np.array([[12.0 * x, 16.0 * y, 40.0] for y in range(3) for x in range(6)])
    these = layout_of(nadir(grid))
    assert choose_pairing(these, 30) == "spatial"
    pairs = select_pairs(these, "spatial", 20, never)
    assert len(pairs) < 18 * 17 // 2
    rectangle = 40.0 * 2.0 * np.array(HALF_SIZE)
    for i in range(18):
        for j in range(i + 1, 18):
            apart = np.abs(grid[i] - grid[j])[:2] / rectangle
            if (apart < 0.75).all():
                assert (i, j) in pairs
            assert (apart < 1.3).all() or (i, j) not in pairs


def test_a_photo_that_looks_away_is_still_connected() -> None:
    these = orbit(40, 30.0, 14.0)
    turned = views(these.centres_m, np.arange(40) * 9.0 + np.where(np.arange(40) == 5, 0.0, 180.0), np.full(40, -18.0))
    pairs = select_pairs(layout_of(turned), "spatial", 6, never)
    assert components(pairs, 40).max() == 0
    assert any(5 in pair for pair in pairs)


@pytest.fixture(scope="module")
def checked() -> list[CheckedPhoto]:
    paths = sorted(capture_path().glob("*.JPG"))
    results = [check_photo(Candidate(path.name, path), PictureLimits(320, 10**8)) for path in paths]
    return [result for result in results if isinstance(result, CheckedPhoto)]


def test_the_demo_is_matched_wherever_photos_truly_show_the_same_points(checked: list[CheckedPhoto]) -> None:
    """Uses the noisy metadata alone; the truth is which surveyed points each photo shows, and from where."""
    truth = json.loads((Path(capture_path()).parent / "truth.json").read_text())
    photos = [Photo(each.name, each.sha256, each.width, each.height, 0) for each in checked]
    entries = positions_json(read_positions(checked))["positions"]
    focal = truth["camera"]["params"][0]
    half_size = np.array([[each.width, each.height] for each in checked]) / (2.0 * focal)
    found = make_layout(photos, entries)
    these = make_views(photos, entries, half_size)
    assert these is not None and these.known().all()
    taken = Layout(found.names, found.times, found.positions_m, found.sigmas_m, found.directions, these)
    assert choose_pairing(taken, 30) == "spatial"
    pairs = set(select_pairs(taken, "spatial", 20, never))
    assert len(pairs) <= 0.9 * 40 * 39 / 2
    poses = {each["name"]: np.array(each["cam_from_world"]) for each in truth["photos"]}
    centres = np.array([-poses[name][:3, :3].T @ poses[name][:3, 3] for name in taken.names])
    numbers = {name: index for index, name in enumerate(taken.names)}
    common: dict[tuple[int, int], int] = {}
    for point in truth["points"]:
        seeing = sorted(numbers[name] for name in point["seen_px"])
        rays = {i: (np.array(point["xyz_m"]) - centres[i]) for i in seeing}
        for i in seeing:
            for j in seeing:
                cosine = rays[i] @ rays[j] / np.linalg.norm(rays[i]) / np.linalg.norm(rays[j])
                if i < j and cosine > np.cos(np.radians(40.0)):
                    common[i, j] = common.get((i, j), 0) + 1
    alike = [pair for pair, count in common.items() if count >= 3]
    assert len(alike) > 100
    assert all(pair in pairs for pair in alike)
