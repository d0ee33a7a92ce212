"""Lens and flight of the demo capture.

Camera frame: x right, y down, z forward; pixel centres at +0.5; world: east, north, up in metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SEED = 7


@dataclass(frozen=True)
class Lens:
    """COLMAP's SIMPLE_RADIAL: the ray (x, y, 1) is seen at pixel f (1 + k r^2) (x, y) + (cx, cy)."""

    width: int = 1200
    height: int = 900
    f: float = 851.3
    cx: float = 600.0
    cy: float = 450.0
    k: float = -0.052

    def scaled(self, factor: float) -> Lens:
        """The same lens for photos of another size."""
        return Lens(
            round(self.width * factor),
            round(self.height * factor),
            self.f * factor,
            self.cx * factor,
            self.cy * factor,
            self.k,
        )

    def project(self, points_cam: Array) -> Array:
        """Camera-frame points (n, 3), z > 0, to pixels (n, 2)."""
        xy = points_cam[:, :2] / points_cam[:, 2:]
        r2 = (xy**2).sum(axis=1, keepdims=True)
        return np.asarray(self.f * (1 + self.k * r2) * xy + (self.cx, self.cy))


@dataclass(frozen=True)
class Pose:
    """A photo's place.

    Attributes:
        name: File name.
        centre: East, north, up, metres.
        yaw_deg: Heading of the camera (nadir: of the photo's top), clockwise from north.
        pitch_deg: 0 is level, -90 straight down.
        roll_deg: Clockwise.
    """

    name: str
    centre: Array
    yaw_deg: float
    pitch_deg: float
    roll_deg: float

    @property
    def world_from_cam(self) -> Array:
        """(4, 4)."""
        yaw, pitch, roll = np.deg2rad([self.yaw_deg, self.pitch_deg, self.roll_deg])
        forward = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
        level = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
        below = np.cross(forward, level)
        right = np.cos(roll) * level + np.sin(roll) * below
        matrix = np.eye(4)
        matrix[:3] = np.c_[right, np.cross(forward, right), forward, self.centre]
        return matrix

    @property
    def cam_from_world(self) -> Array:
        """(4, 4)."""
        inverse = np.eye(4)
        rotation = self.world_from_cam[:3, :3]
        inverse[:3] = np.c_[rotation.T, -rotation.T @ self.centre]
        return inverse

    def to_camera(self, points: Array) -> Array:
        """World points (n, 3) to camera-frame points (n, 3)."""
        return np.asarray((points - self.centre) @ self.world_from_cam[:3, :3])


@dataclass(frozen=True)
class Orbit:
    """A ring of photos that look at a point above the plot's centre."""

    count: int
    radius_m: float
    height_m: float
    look_at_m: float
    start_deg: float


LOW = Orbit(16, 23.5, 10.5, 3.2, 8.0)
HIGH = Orbit(15, 21.0, 21.0, 2.2, 20.0)
NADIR_HEIGHT_M = 27.0
NADIR_SPACING_M = 4.8
NADIR_STRIPS = ((-4.0, 5), (4.0, 4))  # distance of the strip from the plot's centre, photos
NADIR_HEADING_DEG = 73.0  # along the ridge


def flight() -> list[Pose]:
    """The 40 poses in order of time: low orbit, high orbit, two strips straight down; with a pilot's unsteadiness."""
    rng = np.random.default_rng(SEED)
    poses: list[Pose] = []
    for orbit in (LOW, HIGH):
        for k in range(orbit.count):
            angle = np.deg2rad(orbit.start_deg + 360 * k / orbit.count)
            centre = np.array([orbit.radius_m * np.sin(angle), orbit.radius_m * np.cos(angle), orbit.height_m])
            centre += rng.normal(0, (0.35, 0.35, 0.25))
            ahead = np.array([0, 0, orbit.look_at_m]) + rng.normal(0, 0.4, 3) - centre
            yaw = np.rad2deg(np.arctan2(ahead[0], ahead[1])) % 360
            pitch = np.rad2deg(np.arctan2(ahead[2], np.hypot(*ahead[:2])))
            poses.append(_pose(len(poses), centre, yaw, pitch, rng))
    heading = np.deg2rad(NADIR_HEADING_DEG)
    along, across = np.array([np.sin(heading), np.cos(heading), 0]), np.array([np.cos(heading), -np.sin(heading), 0])
    for number, (offset, count) in enumerate(NADIR_STRIPS):
        sense = -1 if number % 2 else 1
        for k in range(count):
            centre = sense * (k - (count - 1) / 2) * NADIR_SPACING_M * along + offset * across
            centre = centre + np.array([0, 0, NADIR_HEIGHT_M]) + rng.normal(0, 0.25, 3)
            yaw = (NADIR_HEADING_DEG + (180 if sense < 0 else 0) + rng.normal(0, 1.0)) % 360
            poses.append(_pose(len(poses), centre, yaw, -90 + abs(rng.normal(0, 0.3)), rng))
    return poses


def _pose(number: int, centre: Array, yaw: float, pitch: float, rng: np.random.Generator) -> Pose:
    return Pose(f"DJI_{number + 1:04d}.JPG", centre, float(yaw), float(pitch), float(rng.normal(0, 0.25)))
