"""The lens and the flight of the demo capture.

Camera frame: x right, y down, z forward; pixel centres at +0.5; world: east, north, up in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SEED = 7


UNDISTORT_STEPS = 30  # each reduces the error at the corner of the strongest lens here to a third


@dataclass(frozen=True)
class BrownLens:
    """Brown's lens model (COLMAP's FULL_OPENCV without its denominator); with k alone, COLMAP's SIMPLE_RADIAL.

    The ray (x, y, 1) projects to pixel f (x', y') + (cx, cy), with x' = x (1 + k r^2 + k2 r^4 + k3 r^6) + 2 p1 x y
    + p2 (r^2 + 2 x^2) and y' = y (1 + k r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y.
    """

    width: int = 1200
    height: int = 900
    f: float = 851.3
    cx: float = 600.0
    cy: float = 450.0
    k: float = -0.052
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def is_simple(self) -> bool:
        """Whether SIMPLE_RADIAL describes the lens exactly."""
        return not (self.k2 or self.k3 or self.p1 or self.p2)

    def scaled(self, factor: float) -> BrownLens:
        """This lens for photos of another size."""
        return replace(
            self,
            width=round(self.width * factor),
            height=round(self.height * factor),
            f=self.f * factor,
            cx=self.cx * factor,
            cy=self.cy * factor,
        )

    def project(self, points_cam: Array) -> Array:
        """Project camera-frame points (n, 3), z > 0, to pixels (n, 2)."""
        x, y = (points_cam[:, :2] / points_cam[:, 2:]).T
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k + r2 * (self.k2 + r2 * self.k3))
        xd = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        yd = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return np.stack([self.f * xd + self.cx, self.f * yd + self.cy], axis=1)

    def undistort(self, xd: Any, yd: Any) -> tuple[Any, Any]:
        """Undistort (pixel - principal point) / f to (x, y) of the ray by fixed-point iteration; NumPy or Dr.Jit."""
        x, y = xd, yd
        for _ in range(UNDISTORT_STEPS):
            r2 = x * x + y * y
            radial = 1 + r2 * (self.k + r2 * (self.k2 + r2 * self.k3))
            aside_x = 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
            aside_y = self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
            x, y = (xd - aside_x) / radial, (yd - aside_y) / radial
        return x, y

    def colmap(self) -> dict[str, Any]:
        """COLMAP's name of the model, the size and the parameters, as in ``truth.json``."""
        size = {"width": self.width, "height": self.height}
        if self.is_simple:
            return {"model": "SIMPLE_RADIAL", **size, "params": [self.f, self.cx, self.cy, self.k]}
        params = [self.f, self.f, self.cx, self.cy, self.k, self.k2, self.p1, self.p2, self.k3, 0.0, 0.0, 0.0]
        return {"model": "FULL_OPENCV", **size, "params": params}


# The Zenmuse P1 with 35 mm, from Pix4D's camera database: for rays up to 0.6 off the axis.
P1_CORNER, P1_RADIAL, P1_TANGENTIAL = 0.6007, (-0.047957, 0.0205183, -0.0972836), (0.00179669, -0.00139674)
# SIMPLE_RADIAL then errs by 3.8 px RMS and 14 px at most at the demo's size, as for the P1 at its own.
BROWN_TIMES = 2.0
BROWN_OFFSET_PX = (16.0, -12.0)  # principal point from the image's centre: 20 px


def brown_lens(simple: BrownLens | None = None) -> BrownLens:
    """A lens like the P1's for the demo's field of view: the same curve from centre to corner, twice as strong."""
    plain = simple or BrownLens()
    corner = float(np.hypot(plain.width, plain.height)) / 2 / plain.f
    inward = P1_CORNER / corner
    k, k2, k3 = (BROWN_TIMES * value * inward ** (2 * n) for n, value in enumerate(P1_RADIAL, 1))
    p1, p2 = (BROWN_TIMES * value * inward for value in P1_TANGENTIAL)
    dx, dy = BROWN_OFFSET_PX
    return replace(plain, cx=plain.cx + dx, cy=plain.cy + dy, k=k, k2=k2, k3=k3, p1=p1, p2=p2)


LENSES = {"simple": BrownLens, "brown": brown_lens}


@dataclass(frozen=True)
class Pose:
    """A photo's position and orientation.

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
    """A ring of photos aimed at a point above the plot's centre."""

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
    """The 40 poses in order of time: low orbit, high orbit, two nadir strips; with a pilot's unsteadiness."""
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
