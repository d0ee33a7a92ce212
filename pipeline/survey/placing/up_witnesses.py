"""Is a model placed by its positions the right way up? Positions in a plane cannot tell.

A flight at one height that is stated mirrored (west as east, south as north, latitude and longitude swapped) fits its
model as well as the true one: turned by 180° about a horizontal axis. What does not come from positions tells it: how
the gimbal was pitched and headed, where the pictures' upper edges point, on which side of a flying camera the ground
is, whether the aircraft flies where its nose points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.geometry.upright import camera_axes
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.placing.level import Positions
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.positions.flight_steps import (
    FlightSteps,
    Relation,
    flying_relation,
    heading_vectors,
    relation_of,
    steps_of,
)

MIN_PHOTOS = 3
MIN_SHARE = 0.8  # share of the photos that must agree for a statement
LEVEL_SINE = np.sin(np.radians(15.0))  # views and edges that are closer to level than this say nothing
FLYING_M = 5.0  # above take-off: the ground is below, whatever is being photographed
ABOVE_SHARE = 0.95  # share of points above flying cameras that shows a model upside down: no ground is among them
MIN_VERTICAL_PART = 0.9  # vertical part of the mean view for photos from above; less where the views differ
FLYING = "the direction of flight against the headings"
STOPPING_WITNESSES = 2  # witnesses against a placement with which it stops


@dataclass(frozen=True)
class Witness:
    """What one observation says of a placement.

    Attributes:
        what: The observation, in words.
        against: Whether it shows the model upside down or mirrored; else it confirms the placement.
        of_gimbal: Whether it is the gimbal's statement.
    """

    what: str
    against: bool
    of_gimbal: bool = False


@dataclass(frozen=True)
class UpVerdict:
    """All that is known of a placement's up.

    Attributes:
        against: Observations that contradict it, in words.
        confirming: How many confirm it.
        refuted: Whether the contradictions are enough to give it up.
    """

    against: tuple[str, ...]
    confirming: int
    refuted: bool

    @property
    def doubtful(self) -> bool:
        """Whether a contradiction is not outvoted."""
        return bool(self.against) and (self.refuted or self.confirming < STOPPING_WITNESSES)

    def sentence(self) -> str:
        """What contradicts, a clause."""
        others = f" and {self.against[-1]}" if len(self.against) > 1 else ""
        listed = ", ".join(self.against[:-1] or self.against) + others
        return f"this contradicts {listed}"


def check_up(placed: Similarity, model: SparseModel, positions: Positions, photos: Mapping[str, Photo]) -> UpVerdict:
    """Hold a placement against everything that tells up without positions.

    Args:
        placed: From the model to east, north, up.
        model: The sparse model.
        positions: The photos' records.
        photos: All photos of the capture by name; their times give the direction of flight.
    """
    witnesses = up_witnesses(placed, model, positions, photos)
    against = [witness for witness in witnesses if witness.against]
    confirming = len(witnesses) - len(against)
    independent = any(not witness.of_gimbal for witness in against) or confirming == 0
    refuted = len(against) >= STOPPING_WITNESSES and len(against) > confirming and independent
    return UpVerdict(tuple(witness.what for witness in against), confirming, refuted)


def up_witnesses(
    placed: Similarity, model: SparseModel, positions: Positions, photos: Mapping[str, Photo]
) -> list[Witness]:
    """The observations that say something about a placement's up."""
    orientations = np.array([positions.orientations.get(name, 1) for name in model.names], dtype=np.int64)
    axes = camera_axes(model.cam_from_model, orientations)
    right, up, forward = (vectors @ placed.rotation.T for vectors in (axes.right, axes.up, axes.forward))
    records = [positions.by_name.get(name, {}) for name in model.names]
    pitch, height = (values_of(records, key) for key in ("pitch_deg", "relative_altitude_m"))
    gimbal, nose = (values_of(records, key) for key in ("yaw_deg", "flight_yaw_deg"))
    yaw = gimbal if np.isfinite(gimbal).any() else nose  # without a gimbal, the camera turns with the aircraft
    steps = steps_of(model.names, positions.by_name, photos)
    sines = np.sin(np.radians(pitch))
    looking = np.abs(sines) > LEVEL_SINE
    edges = np.abs(up[:, 2]) > LEVEL_SINE
    found = [
        _by_photos("the gimbal's pitch", (forward[:, 2] * sines < 0.0)[looking], of_gimbal=True),
        _by_photos("the pictures' upper edges", (up[:, 2] < 0.0)[edges]),
        _by_heading(right, yaw),
        _by_ground(placed, model, height, forward),
        _by_flying(_flying(placed.apply(model.centres), nose, gimbal, steps)),
    ]
    return [witness for witness in found if witness is not None]


def values_of(records: Sequence[Mapping[str, Any]], key: str) -> Float64[np.ndarray, " n"]:
    """A number of each photo's record; NaN where it is unknown."""
    stated = [record.get(key) for record in records]
    return np.array([np.nan if value is None else value for value in stated], dtype=np.float64)


def _by_photos(what: str, against: Bool[np.ndarray, " k"], *, of_gimbal: bool = False) -> Witness | None:
    """A statement if nearly all photos that say something agree."""
    if len(against) < MIN_PHOTOS:
        return None
    share = float(against.mean())
    return Witness(what, share >= MIN_SHARE, of_gimbal) if share >= MIN_SHARE or share <= 1.0 - MIN_SHARE else None


def _by_heading(right: Float64[np.ndarray, "n 3"], yaw_deg: Float64[np.ndarray, " n"]) -> Witness | None:
    """Headings that differ: as stated they turn the same way in the placed model, mirrored the other way.

    A constant difference (magnetic north, a convention) does not count. A gimbal keeps the picture's right edge level,
    at 90° clockwise of its yaw.
    """
    known = np.isfinite(yaw_deg) & (np.hypot(right[:, 0], right[:, 1]) > 0.5)
    if known.sum() < MIN_PHOTOS:
        return None
    placed = right[known, 0] + 1j * right[known, 1]
    relation, _ = relation_of(placed / np.abs(placed), -1j * heading_vectors(yaw_deg[known]))
    if relation not in ("same", "mirrored"):
        return None
    return Witness("the gimbal's headings", relation == "mirrored", of_gimbal=True)


def _flying(
    places: Float64[np.ndarray, "n 3"],
    nose_deg: Float64[np.ndarray, " n"],
    gimbal_deg: Float64[np.ndarray, " n"],
    steps: FlightSteps,
) -> Relation | None:
    """How the flight leads, by the nose or, without, by the camera, which may look askew in a sound flight."""
    if np.isfinite(nose_deg).any():
        return flying_relation(places, nose_deg, steps)[0]
    relation, _ = flying_relation(places, gimbal_deg, steps)
    return None if relation == "askew" else relation


def _by_flying(relation: Relation | None) -> Witness | None:
    """The aircraft flies where its nose points, or always at the same angle to it; mirrored, it turns the other way.

    Strips to and fro do not turn. Those that lead ahead say nothing: mirrored along their own axis, they lead ahead,
    too.
    """
    if relation not in ("same", "mirrored", "backwards", "askew"):
        return None
    return Witness(FLYING, relation != "same")


def _by_ground(
    placed: Similarity, model: SparseModel, height_m: Float64[np.ndarray, " n"], forward: Float64[np.ndarray, "n 3"]
) -> Witness | None:
    """The ground is below cameras that fly, and before a survey's parallel vertical views (few survey a ceiling)."""
    mean = forward.mean(axis=0)
    cameras = placed.apply(model.centres)[:, 2]
    points = placed.apply(model.points)[:, 2]
    if len(points) == 0:
        return None
    flying = height_m > FLYING_M
    vertical = abs(float(mean[2])) > MIN_VERTICAL_PART and abs(float(np.median(cameras) - np.median(points))) > FLYING_M
    flying |= vertical and not np.isfinite(height_m).any()
    if flying.sum() < MIN_PHOTOS:
        return None
    above = float((points > np.median(cameras[flying])).mean())
    if above >= ABOVE_SHARE or above <= 1.0 - ABOVE_SHARE:
        return Witness("the ground's side of the cameras", above >= ABOVE_SHARE)
    return None
