"""Flights with positions worse than stated."""

import json
import math
from typing import Any

import numpy as np
import pycolmap

from splatpipe.demo import CAPTURE
from splatpipe.pipeline.geometry.similarity import Similarity, rotation_from_vector, turn_between
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.placing.fitting import PositionFit
from splatpipe.pipeline.survey.placing.gps import georeference
from splatpipe.pipeline.survey.placing.level import Positions
from splatpipe.pipeline.survey.placing.model import SparseModel

TRUTH: dict[str, Any] = json.loads((CAPTURE / "truth.json").read_text(encoding="utf-8"))

PLACE = Origin(**TRUTH["frame"]["origin"])

NAMES = [photo["name"] for photo in TRUTH["photos"]]

CENTRES = np.array([photo["centre_m"] for photo in TRUTH["photos"]])

TURNS = np.array([np.array(photo["cam_from_world"])[:3, :3] for photo in TRUTH["photos"]])

MODEL_FROM_WORLD = Similarity(0.137, rotation_from_vector(np.array([0.4, -1.1, 2.0])), np.array([0.3, -0.2, 1.4]))


def cameras(centres: np.ndarray = CENTRES, turns: np.ndarray = TURNS) -> SparseModel:
    """True cameras in a frame of their own."""
    names = NAMES if len(centres) == len(NAMES) else [f"{k:03d}.jpg" for k in range(len(centres))]
    source, rotations = MODEL_FROM_WORLD.apply(centres), turns @ MODEL_FROM_WORLD.rotation.T
    return SparseModel(names, source, rotations, source, (), pycolmap.Reconstruction())


def stated(model: SparseModel, places: np.ndarray) -> Positions:
    """Positions that claim 3 m, 5 m in height."""
    records = {}
    for name, (latitude, longitude, height) in zip(model.names, PLACE.geodetic_from_enu(places), strict=True):
        record = {"name": name, "latitude": latitude, "longitude": longitude, "altitude_m": height, "flight": 0}
        record |= {"sigma_horizontal_m": 3.0, "sigma_vertical_m": 5.0, "relative_altitude_m": None}
        records[name] = record | dict.fromkeys(("yaw_deg", "pitch_deg", "roll_deg"))
    return Positions(records, {})


def placed(model: SparseModel, places: np.ndarray) -> tuple[Frame, PositionFit]:
    return georeference(model, stated(model, places), "auto", {})


def errors_of(frame: Frame, model: SparseModel) -> dict[str, float]:
    """Return the errors, under the frame's names for them."""
    assert frame.origin is not None
    found = PLACE.enu_from_geodetic(frame.origin.geodetic_from_enu(frame.world_from_model.apply(model.centres)))
    off = found.mean(axis=0) - MODEL_FROM_WORLD.inverse().apply(model.centres).mean(axis=0)
    turn = frame.world_from_model.rotation @ MODEL_FROM_WORLD.rotation
    heading = turn_between(np.eye(3), turn.T)[2]
    scale = math.log(frame.world_from_model.scale * MODEL_FROM_WORLD.scale)
    return {
        "east": off[0],
        "height": off[2],
        "north": math.degrees(heading),
        "up": math.degrees(math.acos(min(1.0, turn[2, 2]))),
        "scale": 100.0 * scale,
    }


def stated_of(frame: Frame, what: str) -> dict[str, float]:
    uncertainty = frame.residuals["uncertainty"]
    offset = uncertainty[f"offset_{what}_m"]
    angles = {name: uncertainty[f"{name}_{what}_deg"] for name in ("north", "up")}
    return {"east": offset[0], "height": offset[2], **angles, "scale": uncertainty[f"scale_{what}_percent"]}
