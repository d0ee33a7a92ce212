"""The path between photos passes through them smoothly, and a change of exposure is told from a change of content."""

import sys
from pathlib import Path

import numpy as np
import pytest

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.scene.camera import Camera, rotation_matrix

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from path_frames import Frame, change
from smooth_path import nearest_first, path


def camera(place: tuple[float, float, float], turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(np.array(turn))
    pose[:3, 3] = -pose[:3, :3] @ np.array(place)
    return Camera("photo", 120, 90, 100.0, 100.0, 60.0, 45.0, pose)


def test_a_path_passes_through_the_photos_in_equal_steps() -> None:
    given = [camera((0, 0, 0)), camera((3, 0, 0), (0.0, 0.6, 0.0)), camera((6, 0, 0), (0.0, 0.6, 0.4))]
    found = path(given, 9)
    np.testing.assert_allclose([at for at, _ in found], np.linspace(0, 2, 9), atol=1e-12)
    np.testing.assert_allclose([c.centre()[0] for _, c in found], np.linspace(0, 6, 9), atol=1e-9)
    for photo, frame in zip(given, (0, 4, 8), strict=True):
        np.testing.assert_allclose(found[frame][1].cam_from_world, photo.cam_from_world, atol=1e-9)
    np.testing.assert_allclose(found[2][1].cam_from_world[:3, :3], rotation_matrix(np.array([0, 0.3, 0])), atol=1e-9)


def test_a_path_has_no_corner_where_photos_are_unevenly_apart() -> None:
    given = [camera(place) for place in ((0, 0, 0), (1, 0, 0), (1.5, 2, 0), (9, 3, 1), (9, 3, 1), (9, 8, 0))]
    centres = np.array([c.centre() for _, c in path(given, 4001)])
    steps = np.diff(centres, axis=0)
    moving = np.linalg.norm(steps, axis=1) > 1e-6
    directions = steps[moving] / np.linalg.norm(steps[moving], axis=1, keepdims=True)
    at_rest = (
        np.linalg.norm(centres[1:][moving] - [9, 3, 1], axis=1) < 0.05
    )  # two photos from one place: it stops there
    turns = np.arccos(np.clip((directions[1:] * directions[:-1]).sum(axis=1), -1.0, 1.0))
    assert turns[~at_rest[1:]].max() < 0.05
    assert (centres.min(axis=0) > -1.0).all() and (centres.max(axis=0) < [11.0, 9.0, 2.0]).all()


def test_photos_from_one_place_have_no_path() -> None:
    with pytest.raises(UsageError, match="one place"):
        path([camera((1, 2, 3)), camera((1, 2, 3))], 5)


def test_the_nearest_photo_that_is_left_comes_next() -> None:
    given = [camera((x, 0, 0)) for x in (0, 5, 1, 2)]
    assert [c.centre()[0] for c in nearest_first(given)] == [0, 1, 2, 5]


def test_brighter_is_told_from_moved() -> None:
    """A wall with a pattern at a distance of 10: the next frame sees it from a metre beside."""
    frames = []
    for x, brighter in ((0.0, 0), (1.0, 0), (1.0, 12)):
        columns, rows = np.meshgrid(np.arange(120) + 0.5 + 10.0 * x, np.arange(90) + 0.5)
        grey = 120.0 + 60.0 * np.sin(columns / 9.0) * np.sin(rows / 7.0) + brighter
        pixels = np.repeat(np.round(grey)[:, :, None], 3, axis=2).astype(np.uint8)
        frames.append(Frame(camera((x, 0, 0)), pixels, np.full((90, 120), 10.0, np.float32)))
    moved, brighter = change(frames[0], frames[1]), change(frames[0], frames[2])
    assert moved["places"] == brighter["places"] > 900
    assert abs(moved["exposure"]) < 0.1 and moved["colour"] < 0.1
    assert abs(brighter["exposure"] - 12.0) < 0.1 and abs(brighter["colour"] - 12.0) < 0.1
    hidden = Frame(frames[1].camera, frames[1].pixels, np.full((90, 120), 5.0, np.float32))
    assert change(frames[0], hidden) == {"places": 0}
