"""Determine up, and north where gimbal angles give it, from the cameras' orientations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.geometry.alignment import DirectionPrior
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.geometry.upright import (
    UpEstimate,
    camera_axes,
    display_from_stored,
    enu_from_gimbal,
    mean_rotation,
    rotation_to_up,
    up_from_cameras,
)
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.placing.fitting import Directions
from splatpipe.pipeline.survey.placing.model import SparseModel

MIN_ANGLES = 3
GIMBAL_SIGMA_RAD = math.radians(3.0 * math.sqrt(2.0))  # sigma of each axis; 3° for the rotation about any
GIMBAL_SPREAD_RAD = math.radians(15.0)  # angles that deviate more from the model are in another convention
UP_SIGMA_RAD = math.radians(5.0)


@dataclass(frozen=True)
class Positions:
    """``positions.json``.

    Attributes:
        by_name: Records by photo name.
        orientations: EXIF orientations by photo name where they are not 1.
        wrong: Why a photo's position is unusable, by photo name.
        elsewhere: Metres by which other statements of the positions lie off those used, by source; where they do.
    """

    by_name: Mapping[str, Mapping[str, Any]]
    orientations: Mapping[str, int]
    wrong: Mapping[str, str] = field(default_factory=dict)
    elsewhere: Mapping[str, float] = field(default_factory=dict)


def arbitrary_frame(model: SparseModel, positions: Positions, reason: str) -> Frame:
    """An arbitrary frame: up is +z; scale and position stay the model's."""
    gimbal = gimbal_rotation(model, positions)
    if gimbal is not None:
        similarity, source = Similarity(1.0, gimbal, np.zeros(3)), "the gimbal's angles"
    else:
        upright = upright_cameras(model, positions)
        similarity, source = Similarity(1.0, rotation_to_up(upright.up), np.zeros(3)), upright.source
    return Frame("arbitrary", similarity, note=f"Arbitrary scale: {reason}. Up is from {source}.")


def known_directions(model: SparseModel, positions: Positions) -> Directions:
    """Directions that give the rotation where positions determine it less well, or not at all."""
    gimbal = gimbal_rotation(model, positions)
    if gimbal is not None:
        return Directions(DirectionPrior(gimbal, np.eye(3), GIMBAL_SIGMA_RAD), "the gimbal's angles", of_gimbal=True)
    upright = upright_cameras(model, positions)
    prior = DirectionPrior(upright.up[None], np.array([[0.0, 0.0, 1.0]]), UP_SIGMA_RAD)
    return Directions(prior, upright.source, of_gimbal=False)


def gimbal_rotation(model: SparseModel, positions: Positions) -> Float64[np.ndarray, "3 3"] | None:
    """Rotation from the model to east-north-up by the gimbal's angles; None where these do not agree with the model."""
    keys = ("yaw_deg", "pitch_deg", "roll_deg")
    records = [positions.by_name.get(name, {}) for name in model.names]
    index = [i for i, record in enumerate(records) if all(record.get(key) is not None for key in keys)]
    if len(index) < MIN_ANGLES:
        return None
    yaw, pitch, roll = (np.array([records[i][key] for i in index], dtype=np.float64) for key in keys)
    turns = np.stack([display_from_stored(positions.orientations.get(model.names[i], 1)) for i in index])
    enu_from_model = enu_from_gimbal(yaw, pitch, roll) @ turns @ model.cam_from_model[index]
    rotation, spread = mean_rotation(enu_from_model)
    return rotation if spread <= GIMBAL_SPREAD_RAD else None


def upright_cameras(model: SparseModel, positions: Positions) -> UpEstimate:
    orientations = np.array([positions.orientations.get(name, 1) for name in model.names], dtype=np.int64)
    return up_from_cameras(camera_axes(model.cam_from_model, orientations), model.centres, model.points)
