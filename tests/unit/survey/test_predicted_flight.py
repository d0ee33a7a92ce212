"""What a flight will know of the ground's height is predicted from its metadata."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from accurate_flights import CAMERA, PLACE, SINGLE_M, flight

from splatpipe.pipeline.survey.adjustment.predicted_flight import (
    MAX_PHOTOS,
    FlightCamera,
    PredictedAccuracy,
    predict_accuracy,
)
from splatpipe.pipeline.survey.positions.photo_positions import Position


def predicted(photos: Sequence[Position], camera: FlightCamera = CAMERA) -> PredictedAccuracy | None:
    return predict_accuracy(photos, {each.name: camera for each in photos}, {})


def sure(photos: Sequence[Position], camera: FlightCamera = CAMERA) -> PredictedAccuracy:
    found = predicted(photos, camera)
    assert found is not None
    return found


def test_straight_down_from_one_height_the_focal_length_decides() -> None:
    """The ground is as uncertain as flying height times the relative uncertainty of the focal length."""
    found = sure(flight())
    assert found.straight_down and found.one_height and not found.one_heading and found.angles_stated
    assert found.height_m == pytest.approx(44.0 * 0.01, rel=0.05)
    assert sure(flight(), replace(CAMERA, focal_share=0.003)).height_m == pytest.approx(44.0 * 0.003, rel=0.15)
    assert found.plan_m < 0.03
    assert found.control_3_m < found.control_1_m < 0.05
    assert found.cross_strip_m is not None and found.control_1_m < found.cross_strip_m < 0.1
    assert found.gsd_m == pytest.approx(44.0 / 1950.0, rel=0.01)
    assert found == sure(flight())


@pytest.mark.parametrize(
    "photos", [flight(lift=8.0), flight(pitches=(-90.0, -45.0)), flight(pitches=(-90.0, -84.0, -96.0))]
)
def test_another_height_or_tilts_tell_focal_length_from_height(photos: list[Position]) -> None:
    found = sure(photos)
    assert found.height_m < 3.0 * found.gsd_m
    assert not (found.straight_down and found.one_height) or max(p.pitch_deg or 0.0 for p in photos) == -84.0


def test_a_held_lens_leaves_the_error_of_the_positions() -> None:
    assert sure(flight(), replace(CAMERA, held=True)).height_m < 2.0 * sure(flight()).gsd_m


def test_one_heading_leaves_the_principal_point_unknown() -> None:
    found = sure(flight(yaws=(90.0,)))
    assert found.one_heading and found.plan_m > 10.0 * sure(flight()).plan_m
    assert found.plan_m == pytest.approx(0.02 * 1600 * found.gsd_m, rel=0.1)
    assert sure(flight(yaws=(350.0, 5.0))).one_heading and not sure(flight(yaws=(90.0, 180.0))).one_heading


def test_control_points_are_proposed_where_the_flight_is() -> None:
    photos = flight()
    spots = sure(photos).spots
    assert len({(spot.latitude, spot.longitude) for spot in spots}) == 3
    places = {each.name: each for each in photos}
    for spot in spots:
        away = PLACE.enu_from_geodetic(np.array([[spot.latitude, spot.longitude, 400.0]]))[0]
        near = places[spot.photo]
        above = PLACE.enu_from_geodetic(np.array([[near.latitude, near.longitude, 400.0]]))[0]
        assert -25.0 < away[0] < 73.0 and -25.0 < away[1] < 81.0
        assert np.linalg.norm(away - above) < 20.0


def test_of_a_large_flight_a_part_is_predicted_and_control_surrounds_all_of_it() -> None:
    photos = flight(12, 25)
    found = sure(photos)
    assert (found.photos, found.of_photos) == (MAX_PHOTOS, 300)
    assert found.height_m == pytest.approx(0.44, rel=0.05)
    corners = {"P0000.JPG", "P0024.JPG", "P0275.JPG", "P0299.JPG"}
    assert len({spot.photo for spot in found.spots[1:]} & corners) == 2


def test_the_part_has_the_photos_that_tell_the_focal_length() -> None:
    photos = flight(12, 25)
    photos[280:] = [replace(each, pitch_deg=-45.0) for each in photos[280:]]
    assert sure(photos).height_m < 0.1


def test_a_height_that_is_not_stated_is_guessed_from_the_spacing() -> None:
    found = sure([replace(each, relative_altitude_m=None) for each in flight()])
    assert found.height_guessed and 30.0 < found.flying_height_m < 60.0
    one_strip = [replace(each, relative_altitude_m=None) for each in flight(1, 20)]
    assert predicted(one_strip) is None


def test_without_angles_photos_look_straight_down_along_the_flight() -> None:
    found = sure([replace(each, yaw_deg=None, pitch_deg=None, roll_deg=None) for each in flight()])
    assert not found.angles_stated and found.straight_down and not found.one_heading
    assert found.height_m == pytest.approx(0.44, rel=0.05)


def test_poor_or_few_positions_predict_nothing() -> None:
    assert predicted(flight(sigmas=SINGLE_M)) is None
    assert predicted(flight(1, 7)) is None
    assert predicted([]) is None
    assert predict_accuracy(flight(), {}, {}) is None


Change = Callable[[int, Position], Position]


@pytest.mark.parametrize(
    "change",
    [
        lambda k, p: replace(p, latitude=47.0, longitude=13.0, altitude_m=444.0),
        lambda k, p: replace(p, altitude_m=None),
        lambda k, p: replace(p, altitude_m=math.nan),
        lambda k, p: replace(p, sigma_horizontal_m=math.nan),
        lambda k, p: replace(p, relative_altitude_m=-3.0, latitude=47.0 + 1e-9 * k),
        lambda k, p: replace(p, latitude=90.0, longitude=10.0 * k),
        lambda k, p: replace(p, pitch_deg=90.0),
        lambda k, p: replace(p, latitude=47.0 + k, longitude=13.0 - k),
    ],
)
def test_metadata_that_make_no_flight_predict_nothing(change: Change) -> None:
    assert predicted([change(k, each) for k, each in enumerate(flight())]) is None


@pytest.mark.parametrize(
    "change",
    [
        lambda p: replace(p, altitude_m=20_000.0),
        lambda p: replace(p, altitude_m=-math.inf),
        lambda p: replace(p, latitude=math.nan),
        lambda p: replace(p, longitude=-170.0),
        lambda p: replace(p, yaw_deg=math.nan),
        lambda p: replace(p, pitch_deg=720.0, roll_deg=-1e9, yaw_deg=1e12),
        lambda p: replace(p, relative_altitude_m=math.inf),
        lambda p: replace(p, sigma_vertical_m=1e4),
        lambda p: replace(p, orientation=77),
        lambda p: replace(p, sigma_horizontal_m=0.0),
    ],
)
def test_wrong_metadata_of_one_photo_change_little(change: Callable[[Position], Position]) -> None:
    photos = flight()
    photos[9] = change(photos[9])
    found = sure(photos)
    assert 0.02 < found.height_m < 0.5 and math.isfinite(found.plan_m)


@pytest.mark.parametrize("camera", [FlightCamera(320, 1, 9600.0, 0.01), FlightCamera(40_000, 30_000, 8000.0, 0.3)])
def test_strange_cameras_do_no_harm(camera: FlightCamera) -> None:
    found = predicted(flight(), camera)
    assert found is None or math.isfinite(found.height_m)
