"""Mirrored positions, positions without altitudes and degenerate ones, on models of known cameras."""

from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap
import pytest

from splatpipe.pipeline.geometry.similarity import Similarity, rotation_from_vector
from splatpipe.pipeline.geometry.upright import enu_from_gimbal
from splatpipe.pipeline.survey.control.accuracy import GeoreferencedModel, accuracy_json
from splatpipe.pipeline.survey.control.local_survey import LocalSurvey, Targets, stations_of
from splatpipe.pipeline.survey.crs.frames import Frame, Origin
from splatpipe.pipeline.survey.placing.assumed_heights import with_assumed_heights
from splatpipe.pipeline.survey.placing.fitting import FrameUndeterminedError
from splatpipe.pipeline.survey.placing.gps import georeference
from splatpipe.pipeline.survey.placing.level import Positions
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.placing.up_witnesses import check_up
from splatpipe.pipeline.survey.plausibility.last_look import Placed, report_contradictions

PLACE = Origin(46.84266, -91.994, 199.0)
TRUTH = Similarity(6.5, rotation_from_vector(np.array([1.9, -0.7, 0.4])), np.array([12.0, -7.0, 3.0]))
COUNT = 16
TURNS = np.linspace(0.0, 2.0 * np.pi, COUNT, endpoint=False)
RING = np.stack([30.0 * np.sin(TURNS), 25.0 * np.cos(TURNS), np.full(COUNT, 40.0)], axis=1)
INWARDS_DEG = np.degrees(TURNS) + 180.0
GROUND = np.random.default_rng(1).uniform(-40.0, 40.0, (300, 3)) * [1.0, 1.0, 0.01]
ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")


def scene(
    centres: np.ndarray = RING, pitch: float = -55.0, mirrored: bool = False, noise: float = 0.3, **fields: Any
) -> tuple[SparseModel, Positions]:
    """Cameras that look inwards, and their positions; mirrored in longitude if asked for."""
    count = len(centres)
    yaw = INWARDS_DEG[:count]
    cam_from_world = np.swapaxes(enu_from_gimbal(yaw, np.full(count, pitch), np.zeros(count)), 1, 2)
    names = [f"{k:02d}.jpg" for k in range(count)]
    model_from_world = TRUTH.inverse()
    model = SparseModel(
        names,
        model_from_world.apply(centres),
        cam_from_world @ TRUTH.rotation,
        model_from_world.apply(GROUND),
        tuple(range(count)),
        pycolmap.Reconstruction(),
    )
    measured = centres + np.random.default_rng(0).normal(size=centres.shape) * noise
    records = {}
    for k, (latitude, longitude, height) in enumerate(PLACE.geodetic_from_enu(measured).tolist()):
        records[names[k]] = {
            "name": names[k],
            "latitude": latitude,
            "longitude": -longitude if mirrored else longitude,
            "altitude_m": height,
            "sigma_horizontal_m": 3.0,
            "sigma_vertical_m": 5.0,
            "relative_altitude_m": 40.0,
            **dict(zip(ANGLES, (float(yaw[k]), pitch, 0.0), strict=True)),
            **fields,
        }
    return model, Positions(records, {})


def up_of(frame: Frame) -> float:
    """The z component of true up in a frame."""
    return float((frame.world_from_model.rotation @ TRUTH.rotation.T @ [0.0, 0.0, 1.0])[2])


@pytest.mark.parametrize("pitch", [-90.0, -55.0, -20.0, 20.0])
def test_every_witness_confirms_a_sound_placement(pitch: float) -> None:
    model, positions = scene(pitch=pitch)
    verdict = check_up(TRUTH, model, positions, {})
    assert verdict.against == () and verdict.confirming >= 3 and not verdict.doubtful
    frame, _ = georeference(model, positions, "auto", {})
    assert up_of(frame) > 0.99


@pytest.mark.parametrize("pitch", [-90.0, -55.0])
def test_mirrored_positions_at_one_height_do_not_place_a_model(pitch: float) -> None:
    model, positions = scene(pitch=pitch, mirrored=True)
    with pytest.raises(FrameUndeterminedError, match=r"upside down or mirrored: this contradicts the gimbal's pitch, "):
        georeference(model, positions, "auto", {})


def test_edges_and_ground_alone_stop_mirrored_positions() -> None:
    model, positions = scene(mirrored=True, **dict.fromkeys(ANGLES))
    with pytest.raises(FrameUndeterminedError, match="edges and the ground's side of the cameras"):
        georeference(model, positions, "auto", {})


def test_a_survey_without_angles_and_heights_above_takeoff_still_knows_its_ground() -> None:
    """Only the parallel views straight down speak: enough to warn, not to stop."""
    unknown = {"relative_altitude_m": None, **dict.fromkeys(ANGLES)}
    model, positions = scene(pitch=-90.0, **unknown)
    assert check_up(TRUTH, model, positions, {}).confirming == 1
    model, positions = scene(pitch=-90.0, mirrored=True, **unknown)
    frame, _ = georeference(model, positions, "auto", {})
    verdict = check_up(frame.world_from_model, model, positions, {})
    assert verdict.against == ("the ground's side of the cameras",) and verdict.doubtful and not verdict.refuted


class Warnings(list[str]):
    """A reporter that records warnings."""

    def progress(self, done: int | float, total: int | float, what: str, unit: str = "") -> None: ...

    def metric(self, name: str, value: int | float, step: int | None = None) -> None: ...

    def note(self, message: str) -> None: ...

    def warning(self, message: str, hint: str = "") -> None:
        self.append(message)


def test_one_witness_against_warns() -> None:
    model, positions = scene(mirrored=True, relative_altitude_m=None, **dict.fromkeys(ANGLES))
    frame, _ = georeference(model, positions, "auto", {})
    warnings = Warnings()
    report_contradictions(Placed(frame, model, positions, {}), warnings)
    assert any("upside down or mirrored: this contradicts the pictures' upper edges" in text for text in warnings)


def test_a_camera_mounted_upside_down_is_outvoted() -> None:
    model, positions = scene()
    turned = Positions(positions.by_name, dict.fromkeys(model.names, 3))
    verdict = check_up(TRUTH, model, turned, {})
    assert "the pictures' upper edges" in verdict.against and not verdict.refuted


def test_horizontal_positions_alone_place_a_model_with_arbitrary_heights() -> None:
    model, positions = scene(altitude_m=None)
    assumed = with_assumed_heights(model, positions)
    frame, fit = georeference(model, assumed, "auto", {})
    assert up_of(frame) > np.cos(np.radians(3.0))
    assert frame.world_from_model.scale == pytest.approx(TRUTH.scale, rel=0.02)
    assert frame.origin is not None
    placed = frame.origin.geodetic_from_enu(frame.world_from_model.apply(model.centres))
    assert np.abs((PLACE.enu_from_geodetic(placed) - RING)[:, :2]).max() < 2.0
    assert "heights are arbitrary" in frame.note and "horizontal positions" in frame.note
    assert np.degrees(fit.uncertainty.up_rad) > 3.0
    stations = stations_of(model, assumed, frame)
    nothing = Targets(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
    site = LocalSurvey(frame.origin, nothing, stations, frame.origin.enu_from_geodetic(stations.geodetic))
    table = accuracy_json(None, site, GeoreferencedModel(model, frame.world_from_model, np.zeros((1, 3))), None)[
        "tables"
    ]
    assert table["gps"]["rmse_horizontal_m"] is not None and table["gps"]["rmse_up_m"] is None


def test_stated_altitudes_are_kept() -> None:
    model, positions = scene()
    assert with_assumed_heights(model, positions) is positions


LINE = np.stack([np.zeros(COUNT), 6.0 * np.arange(COUNT), np.full(COUNT, 40.0)], axis=1)


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("fields", [{}, {"altitude_m": None}])
@pytest.mark.parametrize("centres", [RING[:3], RING[:4], LINE, LINE[:3], RING * [0.0, 0.0, 1.0], RING * 1e-9])
def test_degenerate_sets_place_a_model_upright_or_not_at_all(
    centres: np.ndarray, fields: dict[str, Any], noise: float
) -> None:
    model, positions = scene(centres, noise=noise, **fields)
    try:
        frame, _ = georeference(model, with_assumed_heights(model, positions), "auto", {})
    except FrameUndeterminedError:
        return
    assert up_of(frame) > np.cos(np.radians(15.0))


@pytest.mark.parametrize(("places", "reason"), [(1, "are one and the same"), (2, "are only two different places")])
@pytest.mark.parametrize("altitude", [{}, {"altitude_m": None}])
def test_a_moving_camera_at_one_or_two_stated_places_has_a_clear_reason(
    places: int, reason: str, altitude: dict[str, Any]
) -> None:
    model, positions = scene(**altitude)
    of = [positions.by_name[name] for name in model.names[:places]]
    kept = ("latitude", "longitude", "altitude_m")
    stuck = {
        name: {**record, **{key: of[k % places][key] for key in kept}}
        for k, (name, record) in enumerate(positions.by_name.items())
    }
    with pytest.raises(FrameUndeterminedError, match=reason):
        georeference(model, with_assumed_heights(model, replace(positions, by_name=stuck)), "auto", {})
