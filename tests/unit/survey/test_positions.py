"""Photo positions: precedence, accuracies, conventions, datums, flights, and outliers."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.upright import enu_from_gimbal
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.metadata.camera_angles import detect_convention, gimbal_from_nadir
from splatpipe.pipeline.photos.metadata.exif import Exif, Gps
from splatpipe.pipeline.photos.metadata.position_outliers import find_misplaced
from splatpipe.pipeline.survey.positions.photo_positions import Position, PositionList, positions_json, read_positions
from splatpipe.pipeline.survey.positions.stated_positions import read_places

HERE = Gps(47.8412, 13.5127, 512.0)


def photo(
    name: str, gps: Gps | None = HERE, xmp: Mapping[str, str] | None = None, time: str | None = None
) -> CheckedPhoto:
    exif = Exif(make="DJI", model="M3E", gps=gps, time=time)
    return CheckedPhoto(name, Path(name), "0" * 64, 400, 300, name, True, False, None, exif, xmp or {})


def drone(**values: object) -> dict[str, str]:
    return {f"drone-dji:{name}": str(value) for name, value in values.items()}


def one(of: CheckedPhoto, **more: object) -> Position:
    (position,) = read_positions([of], **more).positions  # type: ignore[arg-type]
    return position


def places(tmp_path: Path, text: str, names: list[str]) -> dict[str, object]:
    (tmp_path / "geo.txt").write_text(text)
    return dict(read_places(tmp_path / "geo.txt", names).by_name)


def test_the_file_takes_precedence_over_exif_and_exif_over_xmp(tmp_path: Path) -> None:
    xmp = drone(GpsLatitude=47.0, GpsLongitude=13.0, AbsoluteAltitude=500.0)
    assert (one(photo("a.jpg", None, xmp)).latitude, one(photo("a.jpg", None, xmp)).source) == (47.0, "xmp")
    assert (one(photo("a.jpg", HERE, xmp)).latitude, one(photo("a.jpg", HERE, xmp)).source) == (47.8412, "exif")
    stated = places(tmp_path, "EPSG:4326\nA.JPG 13.6 47.9\n", ["a.jpg"])
    position = one(photo("a.jpg", HERE, xmp), places=stated)
    assert (position.latitude, position.longitude, position.source) == (47.9, 13.6, "file")
    # The file states no altitude, so EXIF's counts.
    assert (position.altitude_m, position.altitude_source) == (512.0, "exif")


def test_xmp_is_used_if_exif_has_no_fix() -> None:
    xmp = drone(GpsLatitude=47.0, GpsLongitude=13.0)
    assert one(photo("a.jpg", Gps(0.0, 0.0), xmp)).source == "xmp"


def test_projected_coordinates_are_brought_to_latitude_and_longitude(tmp_path: Path) -> None:
    """The demo's origin in UTM 33N, by its truth.json."""
    text = "EPSG:32633\na.jpg 388710.51366 5299705.20807 512.012 0 0 0 0.02 0.03\n"
    position = one(photo("a.jpg"), places=places(tmp_path, text, ["a.jpg"]))
    assert position.latitude == pytest.approx(47.8412 - 16.210873 / 111_178.0, abs=2e-7)
    assert position.longitude == pytest.approx(13.5127 - 4.455065 / 74_800.0, abs=2e-7)
    assert (position.altitude_m, position.altitude_source, position.vertical) == (512.012, "file", "unknown")
    assert (position.sigma_horizontal_m, position.sigma_vertical_m, position.sigma_source) == (0.02, 0.03, "file")


@pytest.mark.parametrize(
    ("xmp", "gps", "sigmas"),
    [
        ({}, HERE, ("default", 3.0, 5.0)),
        (drone(RtkFlag=50), HERE, ("default", 0.02, 0.03)),
        (drone(RtkFlag=34), HERE, ("default", 0.5, 1.0)),
        (drone(RtkFlag=49), HERE, ("default", 0.5, 1.0)),
        (drone(RtkFlag=16), HERE, ("default", 3.0, 5.0)),
        (drone(RtkFlag=0), HERE, ("default", 3.0, 5.0)),
        (drone(RtkFlag=50, RtkStdLon=0.011, RtkStdLat=0.013, RtkStdHgt=0.021), HERE, ("xmp", 0.013, 0.021)),
        ({"Camera:GPSXYAccuracy": "1.5", "Camera:GPSZAccuracy": "2.5"}, HERE, ("xmp", 1.5, 2.5)),
        ({"Camera:GPSXYAccuracy": "2"}, HERE, ("xmp", 2.0, 3.0)),
        ({}, Gps(47.8, 13.5, 512.0, horizontal_error_m=4.0), ("exif", 4.0, 6.0)),
    ],
)
def test_accuracies_are_the_stated_ones_or_those_of_the_fix(
    xmp: dict[str, str], gps: Gps, sigmas: tuple[str, float, float]
) -> None:
    found = one(photo("a.jpg", gps, xmp))
    assert (found.sigma_source, found.sigma_horizontal_m, found.sigma_vertical_m) == sigmas


@pytest.mark.parametrize(
    ("xmp", "vertical"),
    [
        ({}, "unknown"),
        (drone(AltitudeType="RtkAlt", RtkFlag=50), "ellipsoidal"),
        (drone(AltitudeType="RtkAlt", RtkFlag=16), "unknown"),
        (drone(AltitudeType="GpsFusionAlt", RtkFlag=50), "unknown"),
        ({"Camera:VertCS": "ellipsoidal"}, "ellipsoidal"),
        ({"Camera:VertCS": "EPSG:5773"}, "EPSG:5773"),
        ({"Camera:VertCS": "EPSG:4326"}, "unknown"),
        ({"Camera:VertCS": "somewhere" * 50}, "unknown"),
    ],
)
def test_the_vertical_datum_is_what_is_declared(xmp: dict[str, str], vertical: str) -> None:
    assert one(photo("a.jpg", HERE, xmp)).vertical == vertical


def test_a_file_with_heights_in_its_crs_declares_their_datum(tmp_path: Path) -> None:
    for crs, vertical in (("EPSG:4979", "ellipsoidal"), ("EPSG:32633+5773", "EPSG:5773")):
        row = "13.5127 47.8412" if crs == "EPSG:4979" else "388710.5 5299705.2"
        stated = places(tmp_path, f"{crs}\na.jpg {row} 512.0\n", ["a.jpg"])
        assert one(photo("a.jpg"), places=stated).vertical == vertical


def test_a_file_of_another_capture_is_refused_and_unknown_names_are_reported(tmp_path: Path) -> None:
    with pytest.raises(SplatpipeError, match=r"geo.txt lists no photo of this capture: x.jpg, y.jpg"):
        places(tmp_path, "EPSG:4326\nx.jpg 13.5 47.8\ny.jpg 13.5 47.8\n", ["a.jpg"])
    (tmp_path / "geo.txt").write_text("EPSG:4326\na.jpg 13.5 47.8\nx.jpg 13.5 47.8\n")
    assert read_places(tmp_path / "geo.txt", ["a.jpg"]).unknown == ("x.jpg",)


@pytest.mark.parametrize(
    ("row", "cause"),
    [
        ("388710.5 5299705.2", ""),
        ("5299705.2 388710.5", "swapped"),
        ("33388710.5 5299705.2", "zone number in front of the eastings (33)"),
        ("1275297.6 17387484.9", "in feet"),
        ("88710.5 99705.2", "leading digits"),
    ],
)
def test_a_file_far_from_the_photos_own_positions_is_told_how_to_be_read(tmp_path: Path, row: str, cause: str) -> None:
    (tmp_path / "geo.txt").write_text(f"EPSG:32633\na.jpg {row} 512.0\n")
    try:
        hint = read_places(tmp_path / "geo.txt", ["a.jpg"], {"a.jpg": (HERE.latitude, HERE.longitude)}).better
    except SplatpipeError as error:
        assert error.message.startswith("geo.txt: ")
        hint = error.hint
    assert cause in hint and bool(hint) == bool(cause)


@pytest.mark.parametrize("angles", [(30.0, 0.0, 0.0), (120.0, 25.0, 0.0), (-80.0, 10.0, 5.0), (10.0, 80.0, -3.0)])
def test_nadir_angles_are_the_same_view_as_a_gimbal(angles: tuple[float, float, float]) -> None:
    """Against the definition: nose, right wing and belly of an aircraft turned by yaw, then pitch, then roll."""
    yaw, pitch, roll = np.radians(angles)
    nose = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
    level_wing = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
    level_belly = np.cross(nose, level_wing)
    wing = np.cos(roll) * level_wing + np.sin(roll) * level_belly
    belly = np.cross(nose, wing)
    camera = np.stack([wing, -nose, belly], axis=1)  # right, down and into the picture
    found = enu_from_gimbal(*(np.array([angle]) for angle in gimbal_from_nadir(*angles)))[0]
    np.testing.assert_allclose(found, camera, atol=1e-12)


def test_the_convention_is_recognised_by_the_views_of_a_camera() -> None:
    assert detect_convention([-90.0, -89.5, -45.0]) == "gimbal"
    assert detect_convention([0.0, 1.5, -2.0, 45.0]) == "nadir"
    assert detect_convention([270.0]) == "gimbal"
    assert detect_convention([]) == "nadir"


def test_camera_angles_count_where_there_is_no_gimbal() -> None:
    tags = {"Camera:Yaw": "40", "Camera:Pitch": "20", "Camera:Roll": "0"}
    position = one(photo("a.jpg", HERE, tags))
    assert (position.yaw_deg, position.pitch_deg) == (pytest.approx(40.0), pytest.approx(-70.0))
    straight = {"Camera:Yaw": "40", "Camera:Pitch": "-90", "Camera:Roll": "0"}
    assert one(photo("a.jpg", HERE, straight)).pitch_deg == -90.0
    both = tags | drone(GimbalYawDegree=10, GimbalPitchDegree=-30, GimbalRollDegree=0)
    assert (one(photo("a.jpg", HERE, both)).yaw_deg, one(photo("a.jpg", HERE, both)).pitch_deg) == (10.0, -30.0)


def near(index: int) -> Gps:
    return Gps(47.8412 + 1e-5 * index, 13.5127 + 2e-5 * (index % 7), 512.0)


def listed(**odd: Gps) -> PositionList:
    photos = [photo(f"{index:02d}.jpg", near(index)) for index in range(12)]
    photos += [photo(f"{name}.jpg", gps) for name, gps in sorted(odd.items())]
    return read_positions(photos)


def test_impossible_positions_are_reported_with_the_reason() -> None:
    found = listed(far=Gps(47.8692, 13.5127, 512.0), swapped=Gps(13.5127, 47.8412, 512.0), zero=Gps(0.0, 0.0, 0.0))
    assert len(found.positions) == 12
    assert set(found.wrong) == {"far.jpg", "swapped.jpg", "zero.jpg"}
    assert found.wrong["far.jpg"] == "is stated 3.1 km from the others"
    assert found.wrong["swapped.jpg"] == "has latitude and longitude swapped"
    assert found.impossible == ("zero.jpg",)
    assert positions_json(found)["wrong"] == dict(found.wrong)
    assert "wrong" not in positions_json(listed())


def test_long_captures_and_the_date_line_are_not_wrong() -> None:
    corridor = {str(index): (47.0 + 0.001 * index, 13.0) for index in range(100)}  # 11 km
    assert find_misplaced(corridor) == {}
    assert find_misplaced({"a": (10.0, 179.9999), "b": (10.0, -179.9999), "c": (10.0, 180.0)}) == {}
    assert set(
        find_misplaced({"a": (10.0, 179.9999), "b": (10.0, -179.9999), "c": (10.0, 180.0), "d": (11.0, 180.0)})
    ) == {"d"}
    assert find_misplaced({"a": (10.0, 0.0), "b": (40.0, 0.0)}) == {}


def test_flights_are_numbered_by_time_aircraft_and_source(tmp_path: Path) -> None:
    photos = [photo(f"{index:02d}.jpg", near(index), time=f"2026-05-01T10:{index:02d}:00") for index in range(6)]
    photos += [photo(f"{index:02d}.jpg", near(index), time=f"2026-05-01T12:{index:02d}:00") for index in range(6, 12)]
    assert [position.flight for position in read_positions(photos).positions] == [0] * 6 + [1] * 6
    other = drone(DroneSerialNumber="X")
    mixed = [photo(f"{index:02d}.jpg", near(index), other if index % 2 else {}) for index in range(6)]
    assert [position.flight for position in read_positions(mixed).positions] == [0, 1] * 3
    rows = "".join(f"{index:02d}.jpg 13.5127 47.8412 512\n" for index in range(3))
    stated = places(tmp_path, "EPSG:4326\n" + rows, [each.name for each in mixed])
    single = [photo(f"{index:02d}.jpg", near(index)) for index in range(6)]
    assert [position.flight for position in read_positions(single, stated).positions] == [0] * 3 + [1] * 3  # type: ignore[arg-type]
