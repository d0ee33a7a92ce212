"""EXIF's position against XMP's, and what is told of positions that are none, before anything is computed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.metadata.exif import Exif, Gps
from splatpipe.pipeline.survey.plausibility.position_issues import find_position_issues
from splatpipe.pipeline.survey.positions.photo_positions import PositionList, read_positions
from splatpipe.pipeline.survey.positions.stated_positions import FilePlace

ONE = Gps(47.8412, 13.5127, 520.0)


def photo(index: int, gps: Gps | None, xmp: Mapping[str, object] | None = None) -> CheckedPhoto:
    name = f"{index:02d}.jpg"
    tags = {f"drone-dji:{key}": str(value) for key, value in (xmp or {}).items()}
    exif = Exif(make="DJI", model="M3E", gps=gps, time=f"2026-05-01T10:{index:02d}:00")
    return CheckedPhoto(name, Path(name), "0" * 64, 400, 300, name, True, False, None, exif, tags)


def at(index: int, altitude: float | None = 520.0) -> Gps:
    """A loop of 60 m."""
    turn = 0.5 * index
    return Gps(47.8412 + 2.7e-4 * np.cos(turn), 13.5127 + 4e-4 * np.sin(turn), altitude)


def xmp_of(gps: Gps, **more: object) -> dict[str, object]:
    return {"GpsLatitude": gps.latitude, "GpsLongitude": gps.longitude, **more}


def read_with_issues(photos: Sequence[CheckedPhoto]) -> tuple[PositionList, dict[str, str]]:
    positions = read_positions(photos)
    return positions, {issue.code: issue.message for issue in find_position_issues(photos, positions)}


def test_a_sound_flight_is_read_as_it_stands() -> None:
    photos = [photo(k, at(k), xmp_of(at(k), AbsoluteAltitude=520.0, RelativeAltitude=40.0)) for k in range(12)]
    positions, issues = read_with_issues(photos)
    assert issues == {} and len(positions.positions) == 12
    assert {(each.source, each.altitude_source) for each in positions.positions} == {("exif", "exif")}


def test_one_place_is_told() -> None:
    _, issues = read_with_issues([photo(k, ONE) for k in range(10)])
    assert "all 10 photo positions are one and the same" in issues["positions-too-few"].lower()
    assert "neither scale nor georeference" in issues["positions-too-few"]


def test_two_places_and_two_positions_are_told() -> None:
    _, issues = read_with_issues([photo(k, at(k % 2)) for k in range(10)])
    assert "only two different places" in issues["positions-too-few"]
    _, issues = read_with_issues([photo(k, at(k) if k < 2 else None) for k in range(10)])
    assert "Only 2 photos have a position" in issues["positions-too-few"]


def test_a_line_is_noted_and_a_small_loop_is_none() -> None:
    _, issues = read_with_issues([photo(k, Gps(47.8412 + 1e-4 * k, 13.5127, 520.0)) for k in range(10)])
    assert "along a line" in issues["positions-in-line"]
    small = [Gps(47.8412 + 2e-5 * np.cos(k), 13.5127 + 3e-5 * np.sin(k), 520.0) for k in range(12)]
    assert read_with_issues([photo(k, gps) for k, gps in enumerate(small)])[1] == {}


def test_places_closer_than_their_accuracy_are_told() -> None:
    _, issues = read_with_issues(
        [photo(k, Gps(47.8412 + 1e-7 * k, 13.5127 + 1e-7 * (k % 3), 520.0)) for k in range(12)]
    )
    assert "accurate only to 3 m" in issues["positions-too-close"]


def test_xmp_replaces_frozen_exif() -> None:
    photos = [photo(k, ONE, xmp_of(at(k), AbsoluteAltitude=530.0)) for k in range(10)]
    positions, issues = read_with_issues(photos)
    assert {(each.source, each.altitude_m) for each in positions.positions} == {("xmp", 530.0)}
    assert list(issues) == ["position-frozen"]
    frozen_too = [photo(k, ONE, xmp_of(ONE)) for k in range(10)]
    assert "positions-too-few" in read_with_issues(frozen_too)[1]


def test_a_receiver_that_froze_for_most_of_the_flight_keeps_only_its_first_position() -> None:
    photos = [photo(k, at(min(k, 4))) for k in range(12)]
    positions, issues = read_with_issues(photos)
    assert [each.name for each in positions.positions] == [f"{k:02d}.jpg" for k in range(5)]
    assert "repeats the position of 04.jpg" in issues["position-far"]


def test_a_few_photos_from_one_spot_are_sound() -> None:
    photos = [photo(k, at(k if k > 4 else 0)) for k in range(12)]
    assert read_with_issues(photos)[1] == {} and len(read_with_issues(photos)[0].positions) == 12


def test_xmp_precedes_a_position_without_hemisphere() -> None:
    vague = [replace(at(k), longitude=100.0 + 1e-4 * k, hemispheres=False) for k in range(8)]
    west = [replace(gps, longitude=-gps.longitude) for gps in vague]
    positions, issues = read_with_issues([photo(k, vague[k], xmp_of(west[k])) for k in range(8)])
    assert all(each.longitude < 0.0 and each.source == "xmp" for each in positions.positions)
    assert "state no hemisphere" in issues["position-hemisphere"] and "position-contradiction" not in issues
    positions, issues = read_with_issues([photo(k, vague[k]) for k in range(8)])
    assert all(each.longitude > 0.0 for each in positions.positions)
    assert "read as north and east" in issues["position-hemisphere"]


def test_positions_that_are_all_impossible_are_told_with_the_consequence() -> None:
    _, issues = read_with_issues([photo(k, Gps(0.0, 0.0, 520.0)) for k in range(8)])
    assert "neither scale nor georeference" in issues["position-impossible"]


@pytest.mark.parametrize("altitude", [None, -999.0, 9999.0, 0.0])
def test_no_usable_altitude_in_any_photo_is_told(altitude: float | None) -> None:
    positions, issues = read_with_issues([photo(k, at(k, altitude)) for k in range(10)])
    assert {each.altitude_m for each in positions.positions} == {None}
    assert "only horizontal positions are used, and heights are arbitrary" in issues["altitude-missing"]
    if altitude:
        assert f"{altitude:,.0f} m" in issues["altitude-impossible"]


def test_heights_above_takeoff_serve_where_there_is_no_altitude() -> None:
    photos = [photo(k, at(k, None), {"RelativeAltitude": 40.0 + k}) for k in range(10)]
    positions, issues = read_with_issues(photos)
    assert [each.altitude_m for each in positions.positions] == [40.0 + k for k in range(10)]
    assert {each.altitude_source for each in positions.positions} == {"takeoff"}
    assert "from the take-off point" in issues["altitude-missing"]


def test_the_dead_sea_and_everest_are_on_earth() -> None:
    for altitude in (-430.0, 8850.0):
        assert read_with_issues([photo(k, at(k, altitude + k)) for k in range(10)])[1] == {}


def test_the_sign_that_agrees_with_xmp_is_taken() -> None:
    photos = [photo(k, at(k, -520.0 - k), xmp_of(at(k), AbsoluteAltitude=520.0 + k)) for k in range(10)]
    positions, issues = read_with_issues(photos)
    assert [each.altitude_m for each in positions.positions] == [520.0 + k for k in range(10)]
    assert "below the sea" in issues["altitude-sign"] and len(issues) == 1
    other_datum = [photo(k, at(k, -520.0 - k), xmp_of(at(k), AbsoluteAltitude=473.0 + k)) for k in range(10)]
    assert [each.altitude_m for each in read_with_issues(other_datum)[0].positions] == [520.0 + k for k in range(10)]


def test_heights_of_a_datum_below_zero_keep_their_sign() -> None:
    """In Florida the ellipsoid is some 25 m above the sea."""
    photos = [photo(k, at(k, -12.0 + k), xmp_of(at(k), AbsoluteAltitude=13.0 + k)) for k in range(10)]
    positions, issues = read_with_issues(photos)
    assert [each.altitude_m for each in positions.positions] == [-12.0 + k for k in range(10)]
    assert "different datums" in issues["altitude-datums"]


def test_altitudes_too_far_apart_for_datums_are_named_heights_above_takeoff() -> None:
    photos = [photo(k, at(k, 40.0), xmp_of(at(k), AbsoluteAltitude=560.0)) for k in range(10)]
    positions, issues = read_with_issues(photos)
    assert "more than any two datums" in issues["altitude-contradiction"] and "altitude-datums" not in issues
    assert {each.altitude_m for each in positions.positions} == {40.0}
    tested = [photo(k, at(k, 40.0), xmp_of(at(k), AbsoluteAltitude=560.0, RelativeAltitude=40.0)) for k in range(10)]
    positions, issues = read_with_issues(tested)
    assert {(each.altitude_m, each.altitude_source) for each in positions.positions} == {(560.0, "xmp")}
    assert "height above take-off" in issues["altitude-takeoff"]


@pytest.mark.parametrize(
    ("stated", "cause"),
    [
        (lambda rise: 90.0 + rise, None),
        (lambda rise: -90.0 - rise, "if they are above the sea instead of below it, 100% of the altitudes agree"),
        (lambda rise: (90.0 + rise) / 0.3048, "if they are in feet, 100% of the altitudes agree"),
        (lambda rise: 0.3048 * (90.0 + rise), "if they are in metres and read as feet, 100% of the altitudes agree"),
        (lambda rise: 590.0 - rise, "the stated altitude falls by 10.0 m."),  # no place lies at -590 m
        (lambda rise: 90.0 + 6.0 * rise, "the stated altitude climbs by 60.0 m."),
    ],
)
def test_altitudes_climb_as_the_barometer_does(stated: Callable[[float], float], cause: str | None) -> None:
    rises = [10.0 if k % 3 else 27.0 for k in range(12)]
    photos = [photo(k, at(k, stated(rise)), {"RelativeAltitude": rise}) for k, rise in enumerate(rises)]
    _, issues = read_with_issues(photos)
    assert cause in issues["altitude-climbs"] if cause else "altitude-climbs" not in issues


def test_altitudes_of_a_poor_receiver_or_a_level_flight_say_nothing_against_the_barometer() -> None:
    noise = np.random.default_rng(0).normal(0.0, 15.0, 12)
    poor = [photo(k, at(k, 520.0 + noise[k]), {"RelativeAltitude": 40.0 + 12.0 * (k % 2)}) for k in range(12)]
    climbing = [photo(k, at(k, 520.0 + 9.0 * k), {"RelativeAltitude": 40.0}) for k in range(12)]
    for photos in (poor, climbing):
        assert "altitude-climbs" not in read_with_issues(photos)[1]


def test_a_datum_far_from_wgs84_is_told() -> None:
    _, issues = read_with_issues([photo(k, replace(at(k), datum="TOKYO")) for k in range(8)])
    assert "All 8 photos state the datum TOKYO in EXIF" in issues["position-datum"]


@pytest.mark.parametrize(
    ("height", "says"),
    [(522.0, None), (473.0, "lie 47 m below the photos' own."), (8.0, "more than any two datums do")],
)
def test_altitudes_of_a_file_against_the_photos_own(height: float, says: str | None) -> None:
    photos = [photo(k, at(k)) for k in range(8)]
    places = {
        each.name: FilePlace(at(k).latitude, at(k).longitude, height, "unknown", None, (None, None))
        for k, each in enumerate(photos)
    }
    positions = read_positions(photos, places)
    messages = [each.message for each in find_position_issues(photos, positions) if each.code.startswith("altitude")]
    assert (says is None and messages == []) or (says is not None and says in messages[0])


def test_level_flights_whose_altitudes_have_the_wrong_sign_are_told() -> None:
    """The climbs are between the flights; two that start at other heights would say nothing."""
    for rises, says in (((10.0, 21.0, 27.0), True), ((10.0, 27.0), False)):
        photos = []
        for flight, rise in enumerate(rises):
            for k in range(6):
                each = photo(6 * flight + k, at(k, -60.0 - rise), {"RelativeAltitude": rise})
                photos.append(replace(each, exif=replace(each.exif, time=f"2026-05-01T{10 + 2 * flight}:{k:02d}:00")))
        positions, issues = read_with_issues(photos)
        assert len({each.flight for each in positions.positions}) == len(rises)
        assert ("altitude-climbs" in issues) == says
