"""Camera paths: level, smooth in speed and rotation, near the photos, collision-free; keyframes from files."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.film.camera_path import (
    FilmCamera,
    Route,
    angle_of,
    angles_between,
    cameras_along,
    centripetal_knots,
    smoothed,
    soft_progress,
    spline,
    towards,
    upright_route,
)
from splatpipe.pipeline.film.clearance import Clearance
from splatpipe.pipeline.film.keyframe_file import read_keyframes
from splatpipe.pipeline.film.orbit import orbit
from splatpipe.pipeline.film.photo_route import PhotoTrack, followed_photos, photo_film
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.similarity import rotation_from_vector
from splatpipe.pipeline.geometry.upright import rotation_to_up

UP = np.array([0.48, -0.64, 0.6])
TILT = rotation_to_up(UP).T  # world from the frame that the tests use, z up
FPS, SECONDS = 25, 10.0
FRAMES = round(FPS * SECONDS)


def photo(place: tuple[float, float, float], target: tuple[float, float, float], roll: float = 0.0) -> Camera:
    """A photo at a place, looking at another, rolled by an angle (radians), in the tilted world."""
    view = np.subtract(target, place).astype(float)
    view /= np.linalg.norm(view)
    right = np.cross(view, [0.0, 0.0, 1.0])
    right = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(right) < 1e-9 else right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = (
        rotation_from_vector(np.array([0.0, 0.0, roll])) @ np.stack((right, np.cross(view, right), view)) @ TILT.T
    )
    pose[:3, 3] = -pose[:3, :3] @ (TILT @ np.array(place))
    return Camera("photo.jpg", 400, 300, 300.0, 300.0, 200.0, 150.0, pose)


HOUSE = np.random.default_rng(4).uniform([-4, -4, 0], [4, 4, 6], (4000, 3))  # solid through and through


def capture(cameras: list[Camera], solid: np.ndarray = HOUSE) -> PhotoTrack:
    """Photos of a house of 8 × 8 × 6 metres; each sees the points in its image on the side facing it."""
    points = HOUSE @ TILT.T
    seen = []
    for camera in cameras:
        z = points @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
        pixels = camera.project(points)
        inside = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1) & (z > 0)
        near = np.linalg.norm(points - camera.centre(), axis=1)
        seen.append(np.flatnonzero(inside & (near < np.median(near))))
    return PhotoTrack(cameras, seen, points, UP, Clearance(solid @ TILT.T))


def ring(count: int, radius: float = 20.0, height: float = 8.0, turn: float = 2.0 * math.pi) -> list[Camera]:
    """Around the house, as drones do it: not quite evenly, not quite level."""
    draw = np.random.default_rng(7).normal(size=(count, 4))
    found = []
    for angle, noise in zip(turn * np.arange(count) / count, draw, strict=True):
        angle += 0.15 * turn / count * noise[0]
        r = radius + 0.5 * noise[1]
        found.append(
            photo((r * math.cos(angle), r * math.sin(angle), height + 0.3 * noise[2]), (0, 0, 3), 0.05 * noise[3])
        )
    return found


def film(cameras: list[Camera], solid: np.ndarray = HOUSE) -> Route:
    return photo_film(capture(cameras, solid), FRAMES, SECONDS)


def assert_smooth(route: Route) -> None:
    """Speed and rotation change little from frame to frame, starting and ending at rest."""
    views = route.directions()
    moved = np.linalg.norm(np.diff(route.places, axis=0), axis=1)
    turned = angles_between(views[:-1], views[1:])
    for steps in (moved, turned):
        if steps.max() > 1e-6:
            assert steps[0] < 0.05 * steps.max() and steps[-1] < 0.05 * steps.max()
            assert np.abs(np.diff(steps)).max() < 0.12 * steps.max()
    velocity = np.diff(route.places, axis=0)
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() < 0.15 * moved.max()  # nor in its direction
    turning = np.diff(views, axis=0)
    assert np.linalg.norm(np.diff(turning, axis=0), axis=1).max() < 0.2 * max(turned.max(), 1e-9)


@pytest.mark.parametrize("count", [3, 16, 300])
def test_a_film_is_smooth_and_near_its_photos_however_many_there_are(count: int) -> None:
    cameras = ring(count, turn=1.2 if count == 3 else 2.0 * math.pi)
    route = film(cameras)
    assert len(route) == FRAMES
    assert_smooth(route)
    centres = np.array([camera.centre() for camera in cameras]) @ TILT
    off = np.linalg.norm(route.places[:, None] - centres[None], axis=2).min(axis=1)
    assert off.max() < (4.5 if count == 3 else 0.5 * 2.0 * math.pi * 20.0 / count + 2.5)
    assert np.linalg.norm(np.diff(route.places, axis=0), axis=1).sum() > (15.0 if count == 3 else 60.0)


def test_cameras_of_a_film_are_level_whatever_the_photos_roll() -> None:
    rolled = [photo((20.0 * math.cos(a), 20.0 * math.sin(a), 8.0), (0, 0, 3), 0.4) for a in np.linspace(0, 2, 9)]
    found = cameras_along(film(rolled), FilmCamera(640, 360, 400.0), UP)
    for camera in found:
        rotation = camera.cam_from_world[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0.0
        assert abs(rotation[0] @ UP) < 1e-12 and rotation[1] @ UP < 0.0  # x level, y down
        assert (camera.width, camera.height, camera.cx, camera.cy) == (640, 360, 320.0, 180.0)


def test_a_film_looks_in_the_photos_directions() -> None:
    route = film(ring(24))
    to_middle = towards(route.places, np.tile([0.0, 0.0, 3.0], (FRAMES, 1))).directions()
    assert np.degrees(angles_between(route.directions(), to_middle)).max() < 5.0


def test_outlying_photos_are_left_out() -> None:
    cameras = ring(20)
    far = photo((300.0, 40.0, 8.0), (0, 0, 3))
    away = photo((20.0, 0.0, 8.0), (90.0, 0.0, 30.0))  # sees nothing of the house
    near = photo((0.5, 0.0, 7.0), (0, 0, 3))  # on the roof: left out of the path, since it would be a detour
    found, _ = followed_photos(capture([*cameras[:10], far, away, near, *cameras[10:]]))
    assert found.tolist() == [*range(10), *range(12, 23)]
    route = film([*cameras[:10], far, away, near, *cameras[10:]])
    assert np.abs(np.linalg.norm(route.places[:, :2], axis=1) - 19.5).max() < 2.0
    assert_smooth(route)


def test_a_film_goes_round_the_house_and_not_through_it() -> None:
    """Names alternate between the two sides, so that straight lines from one name to the next go through the house."""
    one = [photo((x, -12.0, 5.0), (x, 0, 3)) for x in np.linspace(-8, 8, 9)]
    other = [photo((x, 12.0, 5.0), (x, 0, 3)) for x in np.linspace(8, -8, 9)]
    mixed = [camera for pair in zip(one, other, strict=True) for camera in pair]
    route = film(mixed)
    assert_smooth(route)
    outside = np.abs(route.places) - [4.0, 4.0, 6.0]
    assert np.maximum(outside, 0.0).max(axis=1).min() > 3.0
    with pytest.raises(UsageError, match="free space"):
        film([one[4], other[4]])


def test_the_path_keeps_its_distance_from_the_ground() -> None:
    """Two photos on either side of a hill: what is between them is solid."""
    hill = np.random.default_rng(1).uniform([-3, -40, 0], [3, 40, 20], (40000, 3))
    left, right = photo((-15.0, 0.0, 5.0), (0, 0, 3)), photo((15.0, 0.0, 5.0), (0, 0, 3))
    with pytest.raises(UsageError):
        film([left, right], hill)


def test_if_names_give_no_order_the_nearest_photo_comes_next() -> None:
    cameras = ring(24)
    shuffled = [cameras[index] for index in np.random.default_rng(5).permutation(24)]
    route = film(shuffled)
    assert_smooth(route)
    steps = np.diff(np.unwrap(np.arctan2(route.places[:, 1], route.places[:, 0])))
    assert (steps > -1e-9).all() or (steps < 1e-9).all()  # around in one direction


def test_photos_straight_down_make_a_film_like_a_moving_map() -> None:
    """A survey in strips, the drone turning at the end of each: the film does not turn with it."""
    cameras = []
    for strip, y in enumerate((-8.0, 0.0, 8.0)):
        line = np.linspace(-15, 15, 8)[:: 1 if strip % 2 == 0 else -1]
        cameras += [photo((x, y, 30.0), (x, y, 0.0), math.pi * (strip % 2)) for x in line]
    route = film(cameras)
    assert np.ptp(route.headings) < 1e-9
    np.testing.assert_allclose(route.pitches, -math.pi / 2, atol=1e-6)
    assert_smooth(route)


def test_photos_from_a_swaying_kite_are_followed_in_direction() -> None:
    """Nearly down, leaning to the side of the picture, one photo far enough to have a heading of its own."""
    cameras = []
    for k, y in enumerate(np.linspace(-8, 8, 14)):
        lean = 33.0 if k == 6 else 17.0 + 3.0 * (-1) ** k
        camera = photo((0.0, y, 30.0), (0.0, y, 0.0))
        turn = np.eye(4)
        turn[:3, :3] = rotation_from_vector(np.array([0.0, math.radians(lean), 0.0]))  # about the picture's top
        cameras.append(replace(camera, cam_from_world=turn @ camera.cam_from_world))
    route = film(cameras)
    assert np.ptp(route.headings) < 1e-9
    mean = np.mean([TILT.T @ camera.cam_from_world[2, :3] for camera in cameras], axis=0)
    aside = np.degrees(angles_between(route.directions(), np.tile(mean / np.linalg.norm(mean), (FRAMES, 1))))
    assert aside.max() < 12.0 and np.median(aside) < 4.0
    tops = np.array([-camera.cam_from_world[1, :3] for camera in cameras_along(route, FilmCamera(64, 36, 50.0), UP)])
    assert np.degrees(angles_between(tops, np.tile(-cameras[0].cam_from_world[1, :3], (FRAMES, 1)))).max() < 5.0


def test_from_the_side_to_straight_down_without_spinning() -> None:
    over = [photo((x, 0.3 * x, 26.0), (x, 0.3 * x, 0.0), 1.3 * k) for k, x in enumerate(np.linspace(-6, 6, 5))]
    route = film([*ring(24, turn=2.0)[18:], *over])
    assert_smooth(route)
    assert np.degrees(np.abs(np.diff(route.headings))).max() < 2.0


def test_photos_from_one_place_have_no_path() -> None:
    with pytest.raises(UsageError, match="one position"):
        smoothed(upright_route([photo((9, 2, 3), (0, 0, 3))] * 2, UP), 10.0, 0.1)
    with pytest.raises(UsageError, match="no path"):
        film([photo((20, 2, 3), (0, 0, 3))])


def test_upright_routes_know_places_headings_and_pitches() -> None:
    route = upright_route([photo((10, 0, 4), (0, 0, 4), 0.3), photo((0, 10, 14), (0, 0, 4))], UP)
    np.testing.assert_allclose(route.places, [[10, 0, 4], [0, 10, 14]], atol=1e-9)
    np.testing.assert_allclose(np.degrees(route.headings) % 360.0, [180, 270], atol=1e-6)
    np.testing.assert_allclose(np.degrees(route.pitches), [0, -45], atol=1e-6)
    back = cameras_along(route, FilmCamera(400, 300, 300.0), UP)[1]
    np.testing.assert_allclose(back.cam_from_world, photo((0, 10, 14), (0, 0, 4)).cam_from_world, atol=1e-9)
    assert angle_of([back]) == pytest.approx(math.degrees(2.0 * math.atan(200 / 300)))
    assert FilmCamera.of_angle(400, 300, angle_of([back])).focal_px == pytest.approx(300.0)


@given(st.floats(0.01, 0.5))
def test_motion_starts_and_stops_softly(start: float) -> None:
    progress = soft_progress(np.linspace(0.0, 1.0, 2001), start)
    assert progress[0] == 0.0 and progress[-1] == pytest.approx(1.0)
    steps = np.diff(progress)
    assert (steps >= 0.0).all() and steps[0] < 0.01 * steps.max()
    np.testing.assert_allclose(progress + progress[::-1], 1.0, atol=1e-12)
    inner = steps[int(2000 * start) + 1 : -int(2000 * start) - 1]
    assert len(inner) == 0 or np.ptp(inner) < 1e-9


def test_a_spline_meets_its_values_and_rests_where_two_are_the_same() -> None:
    values = np.array([[0.0, 1.0], [2.0, 0.0], [2.0, 0.0], [5.0, 7.0]])
    knots = np.array([0.0, 1.0, 3.0, 4.0])
    np.testing.assert_allclose(spline(values, knots, knots), values, atol=1e-12)
    np.testing.assert_allclose(spline(values, knots, np.linspace(1.0, 3.0, 9)), [[2.0, 0.0]] * 9, atol=1e-12)
    fine = spline(values, knots, np.linspace(0.0, 4.0, 40_001))
    speeds = np.diff(fine, axis=0) / 1e-4
    assert np.abs(np.diff(speeds, axis=0)).max() < 0.02  # no corner


def test_a_spline_through_places_unevenly_apart_has_no_corner_and_stays_near() -> None:
    places = np.array([(0, 0, 0), (1, 0, 0), (1.5, 2, 0), (9, 3, 1), (9, 8, 0)], float)
    route = Route(places, np.zeros(5), np.zeros(5), np.zeros(5))
    knots = centripetal_knots(route, 1.0)
    fine = spline(places, knots, np.linspace(0.0, knots[-1], 8001))
    steps = np.diff(fine, axis=0)
    directions = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    assert angles_between(directions[1:], directions[:-1]).max() < 0.05
    assert (fine.min(axis=0) > -1.0).all() and (fine.max(axis=0) < [11.0, 9.0, 2.0]).all()


def test_an_orbit_is_a_level_circle_around_the_house_that_closes() -> None:
    route = orbit(capture(ring(16)), 90)
    np.testing.assert_allclose(np.linalg.norm(route.places[:, :2], axis=1), 20.0, atol=2.5)
    assert np.ptp(route.places[:, 2]) < 1e-9 and np.ptp(route.pitches) < 1e-9
    steps = np.linalg.norm(np.diff(np.vstack((route.places, route.places[:1])), axis=0), axis=1)
    assert np.ptp(steps) < 1e-9
    to_middle = towards(route.places, np.tile([0.0, 0.0, 3.0], (90, 1))).directions()
    assert np.degrees(angles_between(route.directions(), to_middle)).max() < 8.0


def test_an_orbit_rises_over_obstacles() -> None:
    """A façade seen from one side; behind the house is another of the same height."""
    front = [photo((x, -14.0, 3.0), (x, 0, 3)) for x in np.linspace(-6, 6, 9)]
    other = np.random.default_rng(2).uniform([-8, 9, 0], [8, 20, 7], (8000, 3))
    solid = np.vstack((HOUSE, other))
    route = orbit(capture(front, solid), 60)
    assert Clearance(solid).at(route.places).min() > 3.0
    assert route.places[:, 2].min() > 8.0


def test_a_nadir_survey_is_orbited_obliquely() -> None:
    cameras = [photo((x, y, 30.0), (x, y, 0.0)) for x in (-6.0, 0.0, 6.0) for y in (-6.0, 0.0, 6.0)]
    route = orbit(capture(cameras), 12)
    assert -60.0 < np.degrees(route.pitches[0]) < -40.0


def write(folder: Path, value: object, name: str = "path.json") -> Path:
    path = folder / name
    path.write_text(value if isinstance(value, str) else json.dumps(value), encoding="utf-8")
    return path


def test_keyframes_in_json_and_csv_mean_the_same(tmp_path: Path) -> None:
    """Heading clockwise from north, pitch -90 straight down, as in a surveyor's files."""
    frames = [
        {"position": [10, 0, 5], "heading_deg": 270, "pitch_deg": 0, "time_s": 0, "fov_deg": 60},
        {"position": [0, 10, 15], "heading_deg": 180, "pitch_deg": -45, "time_s": 4, "fov_deg": 40},
    ]
    one = read_keyframes(write(tmp_path, {"keyframes": frames}))
    table = "time;fov;x;y;z;heading;pitch\n0;60;10;0;5;270;0\n\n# a comment\n4;40;0;10;15;180;-45\n"
    for keyframes in (one, read_keyframes(write(tmp_path, frames)), read_keyframes(write(tmp_path, table, "p.csv"))):
        views = keyframes.route.directions()
        np.testing.assert_allclose(views, [[-1, 0, 0], [0, -math.sqrt(0.5), -math.sqrt(0.5)]], atol=1e-9)
        assert keyframes.times_s is not None and keyframes.times_s.tolist() == [0, 4] and keyframes.targets is None
        route, angles = keyframes.film(10.0, 10, 99.0)
        assert len(route) == 40 and angles is not None and angles[0] == 60 and angles[-1] == 40
    target = write(tmp_path, "x,y,z,target_x,target_y,target_z\n10,0,5,0,0,5\n0,10,5,0,0,5\n", "t.csv")
    np.testing.assert_allclose(read_keyframes(target).route.directions(), [[-1, 0, 0], [0, -1, 0]], atol=1e-9)


def test_keyframes_are_passed_at_their_times_and_targets_stay_in_the_middle(tmp_path: Path) -> None:
    frames = [
        {"position": [30 * math.cos(a), 30 * math.sin(a), 10], "target": [1, 2, 3], "time_s": 2.0 * k}
        for k, a in enumerate((0.0, 1.0, 2.5, 4.0))
    ]
    keyframes = read_keyframes(write(tmp_path, frames))
    route, _ = keyframes.film(20.0, 10, 0.0)
    assert len(route) == 60
    for k, frame in enumerate(frames):
        at = 2.0 * k / 6.0 * 59
        nearest = route.places[[math.floor(at), math.ceil(at)]].mean(axis=0)
        np.testing.assert_allclose(nearest, frame["position"], atol=1.0)
    to_target = towards(route.places, np.tile([1.0, 2.0, 3.0], (60, 1))).directions()
    np.testing.assert_allclose(route.directions(), to_target, atol=1e-9)
    for frame in frames:
        del frame["time_s"]
    route, _ = read_keyframes(write(tmp_path, frames)).film(20.0, FPS, SECONDS)
    assert len(route) == FRAMES
    assert_smooth(route)


HOSTILE = [
    "",
    "[]",
    "{}",
    "{",
    "[" * 100_000,
    '{"keyframes": 5}',
    "[1, 2]",
    '[{"position": [1, 2]}]',
    '[{"position": [1, 2, NaN], "target": [0, 0, 0]}]',
    '[{"position": [1, 2, 1e999], "target": [0, 0, 0]}]',
    '[{"position": [1, 2, true], "target": [0, 0, 0]}]',
    '[{"position": [1, 2, 3], "target": [1, 2, 3]}]',
    '[{"position": [1, 2, 3]}]',
    '[{"position": [1, 2, 3], "heading": 5}]',
    '[{"position": [1, 2, 3], "heading": 5, "pitch": 91}]',
    '[{"position": [1, 2, 3], "heading": 1e8, "pitch": 0}]',
    '[{"position": [1, 2, 3], "heading": 5, "pitch": 1, "fov": 179}]',
    '[{"position": [1, 2, 3], "heading": 5, "pitch": 1, "time": 1}, {"position": [1, 2, 4], "heading": 5, "pitch": 1}]',
    "x,y,z\n1,2,3\n",
    "x,y,z,heading,pitch\n1,2,abc,0,0\n",
    "x,y,z,target_x\n1,2,3,4\n",
    "x,y,z,heading,pitch,time\n1,2,3,0,0,5\n1,2,4,0,0,5\n",
    "x,y,z,heading,pitch,time\n1,2,3,0,0,5\n1,2,4,0,0,50000\n",
    "x,y,z,heading,pitch\n" + "1,2,3,0,0\n" * 20_000,
    "\x00\x01",
    "a" * 5000,
]


@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_hostile_keyframes_are_refused_with_a_hint(text: str, tmp_path: Path) -> None:
    with pytest.raises(SplatpipeError, match=r"path\.json") as raised:
        read_keyframes(write(tmp_path, text))
    assert raised.value.hint


@given(st.text(max_size=200) | st.recursive(st.floats() | st.none() | st.text(max_size=5), st.lists).map(repr))
@settings(max_examples=150, deadline=None)
def test_no_text_breaks_the_reader(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.mktemp("any") / "path.json"
    path.write_text(text, encoding="utf-8", errors="ignore")
    with pytest.raises(SplatpipeError):
        read_keyframes(path)


def test_a_single_keyframe_is_no_film(tmp_path: Path) -> None:
    keyframes = read_keyframes(write(tmp_path, [{"position": [1, 2, 3], "target": [0, 0, 0]}]))
    with pytest.raises(UsageError, match="two keyframes"):
        keyframes.film(10.0, 25, 5.0)
    twice = read_keyframes(write(tmp_path, [{"position": [1, 2, 3], "target": [0, 0, 0]}] * 2))
    with pytest.raises(UsageError, match="no path"):
        twice.film(10.0, 25, 5.0)


def test_clearance_is_the_distance_to_solid_objects_and_ignores_a_lone_floater() -> None:
    wall = np.column_stack((np.full(900, 5.0), *(grid.ravel() for grid in np.mgrid[-3:3:30j, -3:3:30j])))
    clearance = Clearance(np.vstack((wall, [[1.0, 0.0, 0.0]] * 3, [[np.nan] * 3])))
    assert clearance.at(np.zeros((1, 3)))[0] == pytest.approx(5.0, abs=0.1)
    assert clearance.between(np.zeros(3), np.array([10.0, 0.0, 0.0]), 0.5).min() < 0.5
    assert np.isinf(Clearance(np.zeros((0, 3))).at(np.zeros((2, 3)))).all()
