"""How fast the camera of a film moved and turned at each frame, from the poses of the frames before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.geometry.similarity import rotation_from_vector

MAX_GAP_S = 5.0  # seconds between frames above which a neighbour says nothing of the speed at a frame


@dataclass(frozen=True, eq=False)
class FrameMotion:
    """The motion at a frame.

    Attributes:
        velocity: Of the camera's centre in the world, model units a second.
        turning: Angular velocity of the world in the camera's frame, radians a second: ``cam_from_world`` is
            ``exp(t * turning) @ cam_from_world`` after ``t`` seconds.
    """

    velocity: Float64[np.ndarray, " 3"]
    turning: Float64[np.ndarray, " 3"]


def frame_motions(
    poses: Mapping[int, Float64[np.ndarray, "3 4"]], times_s: Mapping[int, float], parts: Mapping[int, int]
) -> dict[int, FrameMotion]:
    """Differentiate the poses of a film's frames by time.

    The speed at a frame is that of the parabola through it and the frames before and after, at an end or a gap through
    the two nearest on the other side. Through one neighbour alone, it is a straight line's.

    Args:
        poses: cam_from_world of the placed frames.
        times_s: When each was taken.
        parts: The film's part, between cuts, of each frame.

    Returns:
        The motions; frames without a neighbour of their part within ``MAX_GAP_S`` are missing.
    """
    result = {}
    for part in sorted(set(parts.values())):
        frames = sorted((number for number in poses if parts[number] == part), key=lambda number: times_s[number])
        for place, number in enumerate(frames):
            near = _neighbours([times_s[other] for other in frames], place)
            if near:
                result[number] = _motion(poses, times_s, number, [frames[at] for at in near])
    return result


def _neighbours(times: Sequence[float], place: int) -> list[int]:
    """The places of the one or two frames that tell the speed at a frame."""

    def follows(first: int, second: int) -> bool:
        return first >= 0 and second < len(times) and 0.0 < times[second] - times[first] <= MAX_GAP_S

    before, after = follows(place - 1, place), follows(place, place + 1)
    if before and after:
        return [place - 1, place + 1]
    if after:
        return [place + 1, place + 2] if follows(place + 1, place + 2) else [place + 1]
    if before:
        return [place - 1, place - 2] if follows(place - 2, place - 1) else [place - 1]
    return []


def _motion(
    poses: Mapping[int, Float64[np.ndarray, "3 4"]], times_s: Mapping[int, float], number: int, near: Sequence[int]
) -> FrameMotion:
    from scipy.spatial.transform import Rotation  # half a CPU second, which photos need not pay

    own, centre = poses[number], _centre(poses[number])
    steps = [times_s[other] - times_s[number] for other in near]
    velocity, turning = np.zeros(3), np.zeros(3)
    for other, weight in zip(near, _slopes(steps), strict=True):
        velocity += weight * (_centre(poses[other]) - centre)
        turning += weight * Rotation.from_matrix(poses[other][:, :3] @ own[:, :3].T).as_rotvec()
    return FrameMotion(velocity, turning)


def _centre(pose: Float64[np.ndarray, "3 4"]) -> Float64[np.ndarray, " 3"]:
    return np.asarray(-pose[:, :3].T @ pose[:, 3])


def _slopes(steps: Sequence[float]) -> list[float]:
    """Weights of values at some times in the slope at 0 of the polynomial through them, which is 0 at 0 (Lagrange)."""
    if len(steps) == 1:
        return [1.0 / steps[0]]
    first, second = steps
    return [second / (first * (second - first)), first / (second * (first - second))]


def pose_later(
    points_cam: Float64[np.ndarray, "n 3"],
    rotation: Float64[np.ndarray, "3 3"],
    motion: FrameMotion,
    late_s: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, "n 3"]:
    """Move points of a frame's camera to where they are in the camera some time later.

    Args:
        points_cam: In the camera at the frame's time.
        rotation: The frame's, cam_from_world.
        motion: The frame's.
        late_s: How much later, for each point.
    """
    moved = points_cam - late_s[:, None] * (rotation @ motion.velocity)
    turns = rotation_from_vector(late_s[:, None] * motion.turning)
    return np.asarray(np.einsum("nij,nj->ni", turns, moved))
