"""Photos and surveyed points for maps: poses in the CRS, by truth; models that are broken are refused."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hills import placed
from scipy.spatial.transform import Rotation
from webodm_assets import check_control, check_shots, project

from splatpipe.pipeline.app.node.assets.control_points import control_geojson
from splatpipe.pipeline.app.node.assets.earth import Earth, open_earth
from splatpipe.pipeline.app.node.assets.shots import Flight, cameras_json, read_flight, shots_geojson
from splatpipe.pipeline.engine.files.json_file import write_json
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.survey.crs.frames import Frame, Origin

WEST = Origin(52.2, 6.3, 110.0)  # 2.7° west of zone 32's meridian: grid north is 2.1° off
TURN = Similarity(
    3.5, Rotation.from_euler("zyx", [40.0, 10.0, -5.0], degrees=True).as_matrix(), np.array([4.0, 5.0, 6.0])
)
OPENCV = (1700.0, 1690.0, 1010.0, 740.0, -0.1, 0.02, 1e-3, -2e-3)
SIZE = (2000, 1500)
POINTS = np.array([[10.0, -20.0, 2.0], [-15.0, 8.0, 4.0], [30.0, 12.0, -1.0]])  # east, north, up


def earth_of(crs: str = "EPSG:25832") -> Earth:
    frame = placed(crs, "unknown", WEST)
    earth = open_earth(Frame("enu", TURN, frame.origin, "unknown", crs=crs))
    assert earth is not None
    return earth


def poses() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Camera from local and centre of three photos that look down, obliquely."""
    made = {}
    for number, (name, yaw) in enumerate({"a.jpg": 10.0, "b/ü.jpg": 130.0, "c.jpg": 250.0}.items()):
        down = np.diag([1.0, -1.0, -1.0])
        turned = Rotation.from_euler("xz", [15.0, yaw], degrees=True).as_matrix() @ down
        made[name] = (turned, np.array([8.0 * number, -5.0, 90.0]))
    return made


def write_model(folder: Path, kind: int = 4, parameters: tuple[float, ...] = OPENCV) -> Path:
    """Write a COLMAP model with one camera and the photos, whose keypoints are of no interest."""
    folder.mkdir(exist_ok=True)
    camera = struct.pack("<QIiQQ", 1, 7, kind, *SIZE) + struct.pack(f"<{len(parameters)}d", *parameters)
    (folder / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", len(poses()))
    for number, (name, (cam_from_local, centre)) in enumerate(reversed(poses().items())):
        rotation = cam_from_local @ TURN.rotation  # camera from model
        model_centre = TURN.rotation.T @ (centre - TURN.translation) / TURN.scale
        quaternion = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
        images += struct.pack("<I7dI", number + 1, *quaternion, *(-rotation @ model_centre), 7) + name.encode() + b"\0"
        images += struct.pack("<Q", 2) + struct.pack("<2dq", 1.0, 2.0, -1) * 2
    (folder / "images.bin").write_bytes(images)
    return folder


def marks(point: np.ndarray) -> dict[str, np.ndarray]:
    """Where photos see a point, by COLMAP's documentation of its model OPENCV; pixels."""
    fx, fy, cx, cy, k1, k2, p1, p2 = OPENCV
    seen = {}
    for name, (cam_from_local, centre) in poses().items():
        x, y, z = cam_from_local @ (point - centre)
        x, y = x / z, y / z
        r2 = x * x + y * y
        radial = k1 * r2 + k2 * r2 * r2
        u = x + x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        v = y + y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
        seen[name] = np.array([fx * u + cx, fy * v + cy])
    return seen


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    return read_flight(write_model(tmp_path_factory.mktemp("model")))


@pytest.mark.parametrize("crs", ["EPSG:25832", "EPSG:28992"])
def test_points_of_the_crs_project_to_the_pixels_that_see_them(flight: Flight, crs: str) -> None:
    earth = earth_of(crs)
    shots = {
        each["properties"]["filename"]: each["properties"] for each in shots_geojson(flight, earth, [])["features"]
    }
    lenses = cameras_json(flight)
    for point in POINTS:
        there = earth.crs.crs_from_local(point[None])[0]
        for name, pixel in marks(point).items():
            found = project(shots[name], lenses[shots[name]["camera"]], there)
            assert np.linalg.norm(found - pixel) < 0.2, (name, found, pixel)  # the grid's scale is 3e-4 off


def test_centres_are_where_the_photos_were(flight: Flight, tmp_path: Path) -> None:
    earth = earth_of()
    made = shots_geojson(
        flight, earth, [{"name": "a.jpg", "time": "2026-06-18T13:42:05"}, {"name": "c.jpg", "time": "?"}]
    )
    assert [each["properties"]["filename"] for each in made["features"]] == ["a.jpg", "b/ü.jpg", "c.jpg"]
    for each in made["features"]:
        _, centre = poses()[each["properties"]["filename"]]
        np.testing.assert_allclose(
            each["properties"]["translation"], earth.crs.crs_from_local(centre[None])[0], atol=1e-4
        )
    first = made["features"][0]["properties"]
    assert first["capture_time"] == 1781790125.0 and "capture_time" not in made["features"][2]["properties"]
    assert (first["width"], first["height"], first["focal"]) == (2000, 1500, 0.85)
    write_json(tmp_path / "shots.geojson", made)
    assert all(check.met for check in check_shots(tmp_path / "shots.geojson", tmp_path, None))


def point(name: str, role: str, local: np.ndarray, **changes: object) -> dict:
    seen = marks(local)
    listed = [
        {"photo": photo, "pixel": (pixel - [0.3, 0.4]).tolist(), "residual_px": [0.3, 0.4], "used": True}
        for photo, pixel in seen.items()
    ]
    base = {"name": name, "role": role, "surveyed_m": local.tolist(), "estimated_m": (local + 0.01).tolist()}
    return {**base, "residual_m": [0.01] * 3, "observations": listed, **changes}


def test_surveyed_points_have_errors_marks_and_the_name_of_check_points(flight: Flight) -> None:
    control = {
        "points": [
            point("P1", "control", POINTS[0]),
            point("P2", "check", POINTS[1]),
            point("P3", "left_out", POINTS[2]),
            point("P4", "control", POINTS[2], surveyed_m=[30.0, 12.0, None], residual_m=[0.01, 0.01, None]),
            point("P5", "control", POINTS[2], estimated_m=None),
        ]
    }
    made = control_geojson(control, earth_of(), flight.sizes())
    assert made is not None
    assert [each["properties"]["id"] for each in made["features"]] == ["P1", "CHK-P2", "P4"]
    first, plan = made["features"][0], made["features"][2]
    assert first["properties"]["error"] == [0.01] * 3 and plan["properties"]["error"] == [0.01, 0.01, 0.0]
    lon, lat, alt = first["geometry"]["coordinates"]
    assert alt == pytest.approx(112.0, abs=1e-3) and (lon, lat) == pytest.approx((6.3, 52.2), abs=1e-3)
    seen = first["properties"]["observations"][0]
    assert np.array(seen["reprojected"]) * SIZE == pytest.approx(marks(POINTS[0])[seen["shot_id"]], abs=1e-3)
    assert np.array(seen["annotated"]) * SIZE == pytest.approx(marks(POINTS[0])[seen["shot_id"]] - [0.3, 0.4], abs=1e-3)
    assert control_geojson({"points": []}, earth_of(), flight.sizes()) is None


def test_marks_in_photos_that_are_not_placed_are_left_out(flight: Flight) -> None:
    made = control_geojson({"points": [point("P1", "control", POINTS[0])]}, earth_of(), {"a.jpg": SIZE})
    assert made is not None
    assert [each["shot_id"] for each in made["features"][0]["properties"]["observations"]] == ["a.jpg"]


@pytest.mark.parametrize(
    ("kind", "parameters", "expected"),
    [
        (0, (1700.0, 1000.0, 750.0), {"projection_type": "brown", "focal_x": 0.85, "k1": 0.0}),
        (3, (1700.0, 1020.0, 750.0, -0.1, 0.02), {"c_x": 0.01, "k1": -0.1, "k2": 0.02}),
        (
            5,
            (900.0, 910.0, 1000.0, 760.0, 0.1, 0.2, 0.3, 0.4),
            {"projection_type": "fisheye_opencv", "k4": 0.4, "c_y": 0.005},
        ),
    ],
)
def test_lenses_have_the_names_of_opensfm(
    tmp_path: Path, kind: int, parameters: tuple[float, ...], expected: dict
) -> None:
    (lens,) = cameras_json(read_flight(write_model(tmp_path / "model", kind, parameters))).values()
    assert {name: lens[name] for name in expected} == pytest.approx(expected)


def test_a_lens_without_a_model_there_is_left_out(tmp_path: Path) -> None:
    rational = (*OPENCV, 0.1, 0.2, 0.0, 0.0)
    assert cameras_json(read_flight(write_model(tmp_path / "model", 6, rational))) == {}


@pytest.mark.parametrize("cut", [4, 40, 90, 140])
def test_a_broken_model_is_refused(tmp_path: Path, cut: int) -> None:
    folder = write_model(tmp_path / "model")
    (folder / "images.bin").write_bytes((folder / "images.bin").read_bytes()[:cut])
    with pytest.raises(ValueError):  # each says where it ends
        read_flight(folder)


def test_an_unknown_camera_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="model 99"):
        read_flight(write_model(tmp_path / "model", 99))


def test_the_stand_in_for_webodm_finds_points_where_they_are_marked(flight: Flight, tmp_path: Path) -> None:
    earth = earth_of()
    (tmp_path / "odm_report").mkdir()
    write_json(tmp_path / "odm_report/shots.geojson", shots_geojson(flight, earth, []))
    write_json(tmp_path / "cameras.json", cameras_json(flight))
    points = {"points": [point("P1", "control", POINTS[0]), point("P2", "check", POINTS[1])]}
    write_json(tmp_path / "points.geojson", control_geojson(points, earth, flight.sizes()))
    import pyproj
    from webodm_assets import Map

    x, y, _ = earth.crs.crs_from_local(np.zeros((1, 3)))[0]
    base = Map(pyproj.CRS("EPSG:25832"), np.array([x - 90.0, y - 90.0, x + 90.0, y + 90.0]), 0.1)
    checks = list(check_control(tmp_path / "points.geojson", tmp_path, base))
    assert len(checks) == 4 and all(check.met for check in checks), checks
    assert all(check.met for check in check_shots(tmp_path / "odm_report/shots.geojson", tmp_path, base))
