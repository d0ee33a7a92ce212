"""A smooth path of a camera through the places and directions of others.

Positions by a Catmull-Rom spline with centripetal knots, which does not overshoot where places are unevenly far apart
(Yuksel, Schaefer, Keyser: "Parameterization and Applications of Catmull-Rom Curves", 2011), rotations by slerp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.scene.camera import Camera, rotation_matrix


def path(cameras: Sequence[Camera], frames: int) -> list[tuple[float, Camera]]:
    """Cameras along a smooth path through others, evenly spaced by the length of the chords.

    Args:
        cameras: In the order of the path, at least two, not all in one place.
        frames: At least two.

    Returns:
        How far along each is, in cameras from the first, and the camera: the intrinsics are the first's.
    """
    centres = np.array([camera.centre() for camera in cameras])
    chords = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    if not chords.sum() > 0.0:
        raise UsageError("All photos were taken from one place: there is no path between them.")
    along = np.interp(
        np.linspace(0.0, chords.sum(), frames), np.append(0.0, np.cumsum(chords)), np.arange(len(centres))
    )
    result = []
    for place in along.tolist():
        index = min(int(place), len(cameras) - 2)
        first, second = (camera.cam_from_world[:3, :3] for camera in cameras[index : index + 2])
        pose = np.eye(4)
        pose[:3, :3] = rotation_matrix((place - index) * _rotation_vector(second @ first.T)) @ first
        pose[:3, 3] = -pose[:3, :3] @ _spline(centres, index, place - index)
        result.append((place, replace(cameras[0], cam_from_world=pose)))
    return result


def _rotation_vector(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, " 3"]:
    return np.asarray(cv2.Rodrigues(rotation)[0].ravel())


def _spline(points: Float64[np.ndarray, "n 3"], index: int, share: float) -> Float64[np.ndarray, " 3"]:
    """Between a point and the next, as Hermite's cubic; beyond the ends the last chord goes on."""
    around = np.vstack([2.0 * points[0] - points[1], points, 2.0 * points[-1] - points[-2]])[index : index + 4]
    chords = np.diff(around, axis=0)
    knots = np.maximum(np.sqrt(np.linalg.norm(chords, axis=1)), 1e-9)
    before, here, after = chords / knots[:, None]
    start = before - (chords[0] + chords[1]) / (knots[0] + knots[1]) + here
    end = here - (chords[1] + chords[2]) / (knots[1] + knots[2]) + after
    t = share
    blended = (t * (1.0 - t) ** 2 * start - t**2 * (1.0 - t) * end) * knots[1]
    return np.asarray(around[1] + t**2 * (3.0 - 2.0 * t) * chords[1] + blended)


def nearest_first(cameras: Sequence[Camera]) -> list[Camera]:
    """From the first on, always to the nearest that is left."""
    ordered, left = [cameras[0]], list(cameras[1:])
    while left:
        here = ordered[-1].centre()
        ordered.append(left.pop(int(np.argmin([np.linalg.norm(camera.centre() - here) for camera in left]))))
    return ordered
