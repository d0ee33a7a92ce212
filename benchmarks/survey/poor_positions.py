"""Georeference the demo's cameras with poor positions: ``poor_positions [--run OUT] [--seeds 50]``.

The true positions with errors of a known kind, drawn again for each seed, go through georef as photo positions with a
stated accuracy of 3 m (5 m in height); the resulting frame is compared with the truth. For offset (of the cameras'
centroid), north, up (angle between the two verticals) and scale: in how many of the georeferenced seeds the truth lies
within the stated 95 % interval, and the median of the stated standard deviations over the RMS error. Frames whose scale
is known worse than 20 % or a direction worse than 15° are rejected. With a run of the demo its sparse model is used,
otherwise the true cameras.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64
from tables import Row, print_table

from splatpipe.demo import CAPTURE
from splatpipe.pipeline.geometry.similarity import Similarity, fit_similarity, rotation_from_vector, turn_between
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.placing.fitting import FrameUndeterminedError
from splatpipe.pipeline.survey.placing.gps import georeference
from splatpipe.pipeline.survey.placing.level import Positions
from splatpipe.pipeline.survey.placing.model import SparseModel

TRUTH: dict[str, Any] = json.loads((CAPTURE / "truth.json").read_text(encoding="utf-8"))
PLACE = Origin(**TRUTH["frame"]["origin"])
STATED_M = (3.0, 3.0, 5.0)
MODEL_FROM_WORLD = Similarity(0.137, rotation_from_vector(np.array([0.4, -1.1, 2.0])), np.array([0.3, -0.2, 1.4]))
QUANTITIES = ("east", "north", "height", "heading", "up", "scale")


@dataclass(frozen=True)
class PositionError:
    """A kind of error.

    Attributes:
        name: Name in the table.
        noise_m: Standard deviations in east, north, up.
        correlation: Correlation of consecutive positions' errors.
        common_m: Standard deviations of the error common to all positions.
        wrong: Number of positions with an additional error of 500 m.
        gimbal_deg: Error of the gimbal angles about each axis; None for photos without angles.
        photos: First and last photo, in name order.
    """

    name: str
    noise_m: tuple[float, float, float]
    correlation: float = 0.0
    common_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wrong: int = 0
    gimbal_deg: float | None = None
    photos: tuple[int, int] = (0, 1000)


NADIR, LINE = (31, 40), (0, 6)
CASES = (
    PositionError("13 m", (13.0, 13.0, 13.0)),
    PositionError("13 m, ten wrong by 500 m", (13.0, 13.0, 13.0), wrong=10),
    PositionError("13 m, gimbal off by 3°", (13.0, 13.0, 13.0), gimbal_deg=3.0),
    PositionError("13 m, correlated 0.6", (13.0, 13.0, 13.0), correlation=0.6),
    PositionError("13 m, correlated 0.9", (13.0, 13.0, 13.0), correlation=0.9),
    PositionError("3 m, 5 m in height, as stated", STATED_M),
    PositionError("0.5 m, and as stated together", (0.5, 0.5, 0.8), common_m=(2.96, 2.96, 4.94)),
    PositionError("8 m, 20 m in height", (8.0, 8.0, 20.0)),
    PositionError("30 m", (30.0, 30.0, 30.0)),
    PositionError("nadir strips only, 1 m", (1.0, 1.0, 1.0), photos=NADIR),
    PositionError("nadir strips, 3 m, gimbal off by 3°", (3.0, 3.0, 3.0), gimbal_deg=3.0, photos=NADIR),
    PositionError("a sixth of the orbit, 3 m, gimbal off by 3°", (3.0, 3.0, 3.0), gimbal_deg=3.0, photos=LINE),
)


@dataclass(frozen=True)
class SimulatedCameras:
    """The cameras: poses in the model, and true poses."""

    model: SparseModel
    world_from_model: Similarity
    centres: Float64[np.ndarray, "n 3"]
    cam_from_world: Float64[np.ndarray, "n 3 3"]


def true_scene(run: Path | None) -> SimulatedCameras:
    """Load the demo's cameras, from a run's sparse model or from their truth."""
    truth = {photo["name"]: photo for photo in TRUTH["photos"]}
    centres = np.array([photo["centre_m"] for photo in truth.values()])
    turns = np.array([np.array(photo["cam_from_world"])[:3, :3] for photo in truth.values()])
    if run is None:
        source, rotations = MODEL_FROM_WORLD.apply(centres), turns @ MODEL_FROM_WORLD.rotation.T
        places = MODEL_FROM_WORLD.apply(np.random.default_rng(1).uniform(-12.0, 12.0, (500, 3)) * [1.0, 1.0, 0.3])
        model = SparseModel(list(truth), source, rotations, places, (), pycolmap.Reconstruction())
        return SimulatedCameras(model, MODEL_FROM_WORLD.inverse(), centres, turns)
    from splatpipe.pipeline.survey.placing.model import model_of

    folder = next(run.glob("stages/sparse-*/sparse/0"))
    model = model_of(pycolmap.Reconstruction(str(folder)), list(truth))
    centres = np.array([truth[name]["centre_m"] for name in model.names])
    turns = np.array([np.array(truth[name]["cam_from_world"])[:3, :3] for name in model.names])
    scale, rotation, translation = fit_similarity(model.centres, centres, np.ones(len(centres)))
    return SimulatedCameras(model, Similarity(float(scale), rotation, translation), centres, turns)


def only(scene: SimulatedCameras, between: tuple[int, int]) -> SimulatedCameras:
    """Select some of the cameras."""
    model, photos = scene.model, slice(*between)
    part = SparseModel(
        model.names[photos],
        model.centres[photos],
        model.cam_from_model[photos],
        model.points,
        model.image_ids[photos],
        model.reconstruction,
    )
    return SimulatedCameras(part, scene.world_from_model, scene.centres[photos], scene.cam_from_world[photos])


def stated(scene: SimulatedCameras, case: PositionError, seed: int) -> tuple[Positions, list[str]]:
    """Return positions with errors, and the names of the grossly wrong ones."""
    rng = np.random.default_rng(seed)
    count = len(scene.centres)
    errors = rng.normal(size=(count, 3))
    for k in range(1, count):
        errors[k] = case.correlation * errors[k - 1] + math.sqrt(1.0 - case.correlation**2) * errors[k]
    places = scene.centres + errors * case.noise_m + rng.normal(size=3) * case.common_m
    wrong = rng.choice(count, case.wrong, replace=False)
    away = rng.normal(size=(case.wrong, 3))
    places[wrong] += 500.0 * away / np.linalg.norm(away, axis=1, keepdims=True)
    angles: list[Any] = [dict.fromkeys(("yaw_deg", "pitch_deg", "roll_deg"))] * count
    if case.gimbal_deg is not None:
        off = rotation_from_vector(np.radians(case.gimbal_deg) * rng.normal(size=3))
        angles = [gimbal_angles(off @ turn.T) for turn in scene.cam_from_world]
    records: dict[str, Mapping[str, Any]] = {}
    for name, place, turned in zip(scene.model.names, PLACE.geodetic_from_enu(places).tolist(), angles, strict=True):
        record = {"name": name, "latitude": place[0], "longitude": place[1], "altitude_m": place[2], "flight": 0}
        record |= {"sigma_horizontal_m": STATED_M[0], "sigma_vertical_m": STATED_M[2], "relative_altitude_m": None}
        records[name] = record | turned
    return Positions(records, {}), sorted(scene.model.names[k] for k in wrong)


def gimbal_angles(enu_from_cam: Float64[np.ndarray, "3 3"]) -> dict[str, float]:
    """Return a camera's yaw, pitch and roll."""
    right, _, forward = enu_from_cam.T
    pitch = math.asin(float(np.clip(forward[2], -1.0, 1.0)))
    yaw = math.atan2(forward[0], forward[1])
    level_right = np.array([math.cos(yaw), -math.sin(yaw), 0.0])
    roll = math.atan2(float(right @ np.cross(forward, level_right)), float(right @ level_right))
    return {"yaw_deg": math.degrees(yaw), "pitch_deg": math.degrees(pitch), "roll_deg": math.degrees(roll)}


def errors_of(frame: Frame, scene: SimulatedCameras) -> Float64[np.ndarray, " 6"]:
    """Return the errors: east, north, height of the cameras' centroid; heading and up in degrees; scale in per cent."""
    assert frame.origin is not None
    placed = PLACE.enu_from_geodetic(frame.origin.geodetic_from_enu(frame.world_from_model.apply(scene.model.centres)))
    off = placed.mean(axis=0) - scene.centres.mean(axis=0)
    turn = turn_between(scene.world_from_model.rotation.T, frame.world_from_model.rotation.T)
    up = frame.world_from_model.rotation @ scene.world_from_model.rotation.T @ np.array([0.0, 0.0, 1.0])
    scale = math.log(frame.world_from_model.scale / scene.world_from_model.scale)
    angles = [math.degrees(turn[2]), math.degrees(math.acos(min(1.0, up[2])))]
    return np.array([*off, *angles, 100.0 * scale])


def row_of(scene: SimulatedCameras, case: PositionError, seeds: int) -> Row:
    """Return a case's row: number georeferenced, coverage of the stated intervals, and accuracy of the sigmas."""
    part = only(scene, case.photos)
    photos: dict[str, Photo] = {}
    errors, sigmas, within, named = [], [], [], 0
    for seed in range(seeds):
        positions, wrong = stated(part, case, seed)
        try:
            frame, _ = georeference(part.model, positions, "auto", photos)
        except FrameUndeterminedError:
            continue
        figures = frame.residuals["uncertainty"]
        keys = ("offset", "north", "up", "scale")
        units = ("m", "deg", "deg", "percent")
        sigma, bound = (
            np.concatenate(
                [np.atleast_1d(figures[f"{key}_{what}_{unit}"]) for key, unit in zip(keys, units, strict=True)]
            )
            for what in ("sigma", "95")
        )
        error = errors_of(frame, part)
        errors.append(error)
        sigmas.append(sigma)
        within.append(np.abs(error) <= bound)
        named += list(frame.left_out) == wrong
    row: Row = {"errors": case.name, "placed": f"{len(errors)}/{seeds}", "named right": f"{named}/{len(errors)}"}
    if errors:
        rms = np.sqrt((np.array(errors) ** 2).mean(axis=0))
        ratio, cover = np.median(sigmas, axis=0) / rms, 100.0 * np.mean(within, axis=0)
        for k, name in enumerate(QUANTITIES):
            row[name] = f"{rms[k]:.2f} · {ratio[k]:.2f} · {cover[k]:.0f} %"
    return row


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, help="a run of the demo, for its sparse model")
    parser.add_argument("--seeds", type=int, default=50)
    options = parser.parse_args()
    scene = true_scene(options.run)
    title = "RMS of the errors (m, degrees, per cent) · stated sigma over it · truth within the stated 95 %"
    columns = {name: name for name in ("errors", "placed", "named right", *QUANTITIES)}
    print_table(title, [row_of(scene, case, options.seeds) for case in CASES], columns)


if __name__ == "__main__":
    main()
