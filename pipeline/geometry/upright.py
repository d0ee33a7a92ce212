"""Up and north from the cameras alone: from how photographers hold them, or from a drone's gimbal."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from splatpipe.pipeline.geometry.robust import absolute_weights

# Direction of the displayed image's top in the stored pixel grid (x right, y down), by EXIF orientation.
TOP_OF_ORIENTATION = {
    1: (0.0, -1.0),
    2: (0.0, -1.0),
    3: (0.0, 1.0),
    4: (0.0, 1.0),
    5: (-1.0, 0.0),
    6: (-1.0, 0.0),
    7: (1.0, 0.0),
    8: (1.0, 0.0),
}
UPRIGHT_AND_TURNED = (1, 6)  # EXIF orientations for landscape and portrait
MIN_ALIKE_LENGTH = 0.9  # least length of the mean of unit vectors within about 25°
MIN_STEADY_LENGTH = 0.997  # mean within about 4°: a gimbal, which points down better than the ground is level
MIN_PARALLEL_LENGTH = 0.9995  # mean within about 2°: nobody holds a camera this steady while walking
MAX_SCATTERED_LENGTH = 0.5  # mean below which the vectors mostly cancel
MIN_GRID_RATIO = 0.3  # least spread of the cameras along the image's height, over that along its width, of a survey
MIN_FAN_WIDTH = 0.2  # width of the fan of the cameras' horizontal axes (a sine) that determines their plane
MAX_FAN_THICKNESS_RATIO = 0.35  # thickness of that fan over its width, below which the axes lie in a plane
GROUND_POINTS = 5000
MIN_GROUND_POINTS = 50
GROUND_SAMPLES = 500
GROUND_COSINE = math.cos(math.radians(40.0))  # between the ground's normal and the cameras' mean view
GROUND_THICKNESS = 0.015  # distance of the ground's points from their plane, over the cameras' height above it
MIN_GROUND_SHARE = 0.2  # least share of the points that lie on the ground plane
ROBUST_ROUNDS = 20
MIN_WEIGHT_RAD = 0.01


@dataclass(frozen=True)
class CameraAxes:
    """Directions of upright cameras in the model's frame, unit vectors.

    Attributes:
        right: Towards the right edge of the displayed image.
        up: Towards its top edge.
        forward: Viewing directions.
    """

    right: Float64[np.ndarray, "n 3"]
    up: Float64[np.ndarray, "n 3"]
    forward: Float64[np.ndarray, "n 3"]


@dataclass(frozen=True)
class UpEstimate:
    """An estimate of up in the model's frame (unit vector) and, in a few words, what it is based on."""

    up: Float64[np.ndarray, " 3"]
    source: str


def display_from_stored(orientation: int) -> Float64[np.ndarray, "3 3"]:
    """Rotation from the stored image's camera frame to that of the image turned by EXIF (mirroring is ignored)."""
    top = np.array([*TOP_OF_ORIENTATION.get(orientation, (0.0, -1.0)), 0.0])
    forward = np.array([0.0, 0.0, 1.0])
    return np.stack([np.cross(-top, forward), -top, forward])


def camera_axes(cam_from_world: Float64[np.ndarray, "n 3 3"], orientations: Int64[np.ndarray, " n"]) -> CameraAxes:
    """Axes of the images in the world, turned as EXIF says.

    Args:
        cam_from_world: Rotations of the stored images.
        orientations: EXIF orientations, 1 to 8.
    """
    turns = np.stack([display_from_stored(int(orientation)) for orientation in orientations])
    rows = turns @ cam_from_world
    return CameraAxes(rows[:, 0], -rows[:, 1], rows[:, 2])


def up_from_cameras(
    axes: CameraAxes, centres: Float64[np.ndarray, "n 3"], points: Float64[np.ndarray, "m 3"]
) -> UpEstimate:
    """Estimate up from cameras held level: their horizontal axes lie in one plane, whatever they look at.

    Cameras that all face the same way do not determine that plane. Then only the layout of their positions
    distinguishes façade views from nadir views: a survey spreads along both image axes. Down is the mean viewing
    direction or, if the cameras sway (a kite), the normal of the ground plane that most points lie on.

    Args:
        axes: Axes of the cameras.
        centres: Camera positions in the model.
        points: The sparse point cloud.
    """
    mean_up, mean_forward = axes.up.mean(axis=0), axes.forward.mean(axis=0)
    normal, thickness, width = _plane_normal(axes.right)
    if width > MIN_FAN_WIDTH and thickness < MAX_FAN_THICKNESS_RATIO * width:
        sign = float(np.sign(((axes.up - axes.forward) @ normal).sum())) or 1.0
        return UpEstimate(sign * normal, "the horizontal edges of the pictures")
    alike_up, alike_forward = float(np.linalg.norm(mean_up)), float(np.linalg.norm(mean_forward))
    if alike_forward > MIN_ALIKE_LENGTH and (
        alike_up < MAX_SCATTERED_LENGTH or _is_survey(centres, mean_up, mean_forward)
    ):
        ground = _ground_normal(points, centres, -_unit(mean_forward))
        if ground is not None and alike_forward < MIN_STEADY_LENGTH:
            return UpEstimate(ground, "the ground below cameras that look down")
        return UpEstimate(-_unit(mean_forward), "the viewing direction of cameras that look down")
    if alike_up > MAX_SCATTERED_LENGTH:
        return UpEstimate(_unit(mean_up), "the upper edges of the pictures")
    return UpEstimate(_unit(mean_up - mean_forward), "the pictures' upper edges and viewing directions")


def up_without_orientation(
    cam_from_world: Float64[np.ndarray, "n 3 3"],
    centres: Float64[np.ndarray, "n 3"],
    points: Float64[np.ndarray, "m 3"],
    brighter: Callable[[], Float64[np.ndarray, "n 2"]],
) -> UpEstimate:
    """Estimate up for photos of unknown EXIF orientation: all upright, or all stored with a quarter turn.

    The orientation chosen is the one whose horizontal axes lie better in one plane; of the two quarter turns, the one
    whose images are brighter at the top. If neither gives a plane, the photos count as upright.

    Args:
        cam_from_world: Rotations of the stored images.
        centres: Camera positions in the model.
        points: The sparse point cloud.
        brighter: Returns each image's brightness gradient (right, down in the stored image), of any length; called
            only if the photos are turned.
    """
    upright, turned = (
        camera_axes(cam_from_world, np.full(len(cam_from_world), orientation)) for orientation in UPRIGHT_AND_TURNED
    )
    (_, thickness, width), (normal, other_thickness, other_width) = (
        _plane_normal(axes.right) for axes in (upright, turned)
    )
    is_plane = other_width > MIN_FAN_WIDTH and other_thickness < MAX_FAN_THICKNESS_RATIO * other_width
    if not is_plane or (width > MIN_FAN_WIDTH and thickness * other_width <= other_thickness * width):
        return up_from_cameras(upright, centres, points)
    light = np.einsum("nij,ni->nj", cam_from_world[:, :2], brighter()).sum(axis=0)
    return UpEstimate(
        (float(np.sign(light @ normal)) or 1.0) * normal, "the vertical edges of pictures that are turned"
    )


def enu_from_gimbal(
    yaw_deg: Float64[np.ndarray, " n"], pitch_deg: Float64[np.ndarray, " n"], roll_deg: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3 3"]:
    """Rotations from the camera (x right, y down, z forward) to east-north-up.

    Args:
        yaw_deg: Clockwise from north.
        pitch_deg: 0 level, -90 straight down (then the image's top points along the yaw).
        roll_deg: Clockwise seen from behind the camera.
    """
    yaw, pitch, roll = np.radians(yaw_deg), np.radians(pitch_deg), np.radians(roll_deg)
    forward = np.stack([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)], axis=1)
    level_right = np.stack([np.cos(yaw), -np.sin(yaw), np.zeros_like(yaw)], axis=1)
    level_down = np.cross(forward, level_right)
    right = np.cos(roll)[:, None] * level_right + np.sin(roll)[:, None] * level_down
    return np.stack([right, np.cross(forward, right), forward], axis=2)


def mean_rotation(rotations: Float64[np.ndarray, "n 3 3"]) -> tuple[Float64[np.ndarray, "3 3"], float]:
    """Robust mean rotation (least sum of chordal distances, by reweighting) and the median angle to it in radians."""
    weights = np.ones(len(rotations))
    for _ in range(ROBUST_ROUNDS):
        u, _, vt = np.linalg.svd((weights[:, None, None] * rotations).sum(axis=0))
        mean = u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt
        cosines = (np.einsum("nij,ij->n", rotations, mean) - 1.0) / 2.0
        angles = np.arccos(np.clip(cosines, -1.0, 1.0))
        weights = absolute_weights(angles, MIN_WEIGHT_RAD)
    return mean, float(np.median(angles))


def rotation_to_up(up: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """The smallest rotation that brings a unit vector to +z."""
    cosine = float(up[2])
    if cosine < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    axis = np.array([up[1], -up[0], 0.0])  # up × z
    k = np.array([[0.0, 0.0, axis[1]], [0.0, 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.asarray(np.eye(3) + k + k @ k / (1.0 + cosine))


def _plane_normal(vectors: Float64[np.ndarray, "n 3"]) -> tuple[Float64[np.ndarray, " 3"], float, float]:
    """Robust fit of the plane that unit vectors lie in.

    Returns:
        Its normal; the RMS distance of the vectors from the plane (thickness) and from their main direction in it (the
        fan's width), both as sines of angles.
    """
    weights = np.ones(len(vectors))
    for _ in range(ROBUST_ROUNDS):
        values, axes = np.linalg.eigh((vectors * weights[:, None]).T @ vectors / weights.sum())
        weights = absolute_weights(np.abs(vectors @ axes[:, 0]), MIN_WEIGHT_RAD)
    return axes[:, 0], math.sqrt(max(float(values[0]), 0.0)), math.sqrt(max(float(values[1]), 0.0))


def _is_survey(
    centres: Float64[np.ndarray, "n 3"], mean_up: Float64[np.ndarray, " 3"], mean_forward: Float64[np.ndarray, " 3"]
) -> bool:
    """Whether cameras that face the same way spread along both axes of their images.

    If they spread mostly along the viewing direction, it is a walk, unless they are as parallel as only a gimbal keeps
    them: on a mast, or hovering.
    """
    up, forward = _unit(mean_up), _unit(mean_forward)
    along_up, along_right, ahead = (float(np.std(centres @ axis)) for axis in (up, np.cross(forward, up), forward))
    is_walk = ahead >= max(along_up, along_right) and float(np.linalg.norm(mean_forward)) < MIN_PARALLEL_LENGTH
    return along_up > MIN_GRID_RATIO * along_right and not is_walk


def _ground_normal(
    points: Float64[np.ndarray, "m 3"], centres: Float64[np.ndarray, "n 3"], up: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, " 3"] | None:
    """Upward normal of the plane with most points, by RANSAC from a fixed seed; None if no plane has enough."""
    if len(points) < MIN_GROUND_POINTS:
        return None
    generator = np.random.Generator(np.random.PCG64(0))
    chosen = points[np.sort(generator.choice(len(points), min(len(points), GROUND_POINTS), replace=False))]
    height = float(np.median(centres @ up) - np.median(chosen @ up))
    corners = chosen[generator.integers(0, len(chosen), (GROUND_SAMPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(lengths, 1e-300)[:, None]
    normals *= np.where(normals @ up < 0.0, -1.0, 1.0)[:, None]
    best, near = 0, np.zeros(len(chosen), dtype=bool)
    for normal, corner in zip(normals, corners[:, 0], strict=True):
        if normal @ up > GROUND_COSINE:
            on_plane = np.abs((chosen - corner) @ normal) < GROUND_THICKNESS * abs(height)
            if int(on_plane.sum()) > best:
                best, near = int(on_plane.sum()), on_plane
    if best < MIN_GROUND_SHARE * len(chosen):
        return None
    ground = chosen[near]
    normal = np.linalg.eigh(np.cov(ground.T))[1][:, 0]
    return np.asarray(normal if normal @ up > 0.0 else -normal)


def _unit(vector: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"]:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-12 else np.array([0.0, 0.0, 1.0])
