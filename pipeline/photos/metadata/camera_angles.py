"""Convert the conventions of a camera's yaw, pitch and roll to that of gimbals: pitch -90 is straight down."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal

from scipy.spatial.transform import Rotation

Convention = Literal["gimbal", "nadir"]
DOWNWARD_DEG = -60.0  # a lower pitch is counted from the horizon: counted from nadir, it would look far backwards
LOCKED = 1e-6  # cosine of the pitch: below it, gimbal lock, as yaw and roll turn about the same axis


def detect_convention(pitches_deg: Iterable[float]) -> Convention:
    """Detect what pitch 0 means in a camera's photos: the horizon (``gimbal``) or straight down (``nadir``).

    Pix4D's ``Camera:`` tags count from nadir, but some makers write the gimbal's angle there. Some mapping photos
    always look down: -90 counted from the horizon, 0 counted from nadir, where -60 or less would look far backwards.
    """
    pitches = [(pitch + 180.0) % 360.0 - 180.0 for pitch in pitches_deg]
    return "gimbal" if pitches and min(pitches) <= DOWNWARD_DEG else "nadir"


def gimbal_from_nadir(yaw_deg: float, pitch_deg: float, roll_deg: float) -> tuple[float, float, float]:
    """Convert the angles of an aircraft whose camera looks straight down to those of a gimbal.

    Args:
        yaw_deg: Of the top of the image, clockwise from north.
        pitch_deg: Nose up, so that the camera looks forward.
        roll_deg: Right wing down.

    Returns:
        Yaw, pitch (-90 straight down) and roll of the same view, degrees.
    """
    aircraft = Rotation.from_euler("ZYX", (yaw_deg, pitch_deg, roll_deg), degrees=True)
    turned = (aircraft * Rotation.from_euler("Y", -90.0, degrees=True)).as_matrix()
    cosine = math.hypot(turned[0, 0], turned[1, 0])
    down = math.degrees(math.atan2(-turned[2, 0], cosine))
    if cosine < LOCKED:
        return math.degrees(math.atan2(-turned[0, 1], turned[1, 1])), down, 0.0
    heading = math.degrees(math.atan2(turned[1, 0], turned[0, 0]))
    return heading, down, math.degrees(math.atan2(turned[2, 1], turned[2, 2]))
