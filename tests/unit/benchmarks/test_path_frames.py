"""A change of exposure is distinguished from a change of content, along a path in the given order."""

import numpy as np
from path_frames import PathFrame, change, nearest_first

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.similarity import rotation_from_vector


def camera(place: tuple[float, float, float], turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(np.array(turn))
    pose[:3, 3] = -pose[:3, :3] @ np.array(place)
    return Camera("photo", 120, 90, 100.0, 100.0, 60.0, 45.0, pose)


def test_the_nearest_remaining_photo_comes_next() -> None:
    given = [camera((x, 0, 0)) for x in (0, 5, 1, 2)]
    assert [c.centre()[0] for c in nearest_first(given)] == [0, 1, 2, 5]


def test_brighter_is_distinguished_from_moved() -> None:
    """A wall with a pattern at a distance of 10: the next frame sees it from a metre to the side."""
    frames = []
    for x, brighter in ((0.0, 0), (1.0, 0), (1.0, 12)):
        columns, rows = np.meshgrid(np.arange(120) + 0.5 + 10.0 * x, np.arange(90) + 0.5)
        grey = 120.0 + 60.0 * np.sin(columns / 9.0) * np.sin(rows / 7.0) + brighter
        pixels = np.repeat(np.round(grey)[:, :, None], 3, axis=2).astype(np.uint8)
        frames.append(PathFrame(camera((x, 0, 0)), pixels, np.full((90, 120), 10.0, np.float32)))
    moved, brighter = change(frames[0], frames[1]), change(frames[0], frames[2])
    assert moved["places"] == brighter["places"] > 900
    assert abs(moved["exposure"]) < 0.1 and moved["colour"] < 0.1
    assert abs(brighter["exposure"] - 12.0) < 0.1 and abs(brighter["colour"] - 12.0) < 0.1
    hidden = PathFrame(frames[1].camera, frames[1].pixels, np.full((90, 120), 5.0, np.float32))
    assert change(frames[0], hidden) == {"places": 0}
