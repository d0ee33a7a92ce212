"""The demo capture is consistent: photos, metadata, cameras, marks and surface agree with each other."""

from __future__ import annotations

import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections import defaultdict
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image
from pyproj import Transformer
from rays import first_hits

from splatpipe.demo import CAPTURE, capture_path
from splatpipe.demo.photography.cameras import BrownLens, brown_lens, flight
from splatpipe.demo.photography.metadata import read_dji, write_rtk_variant
from splatpipe.pipeline.sfm.lenses.lens_model import apart_px, simplest

Array = NDArray[np.float64]
MAX_BYTES = 8_000_000
DJI = "{http://www.dji.com/drone-dji/1.0/}"


@cache
def truth() -> dict[str, Any]:
    content: dict[str, Any] = json.loads((CAPTURE / "truth.json").read_text("utf-8"))
    return content


@cache
def cam_from_world() -> dict[str, Array]:
    return {photo["name"]: np.array(photo["cam_from_world"]) for photo in truth()["photos"]}


def project(name: str, points: Array) -> Array:
    """World points (n, 3) to pixels (n, 2) of a photo, by pycolmap's camera model."""
    camera = pycolmap.Camera(**{k: truth()["camera"][k] for k in ("model", "width", "height", "params")})
    matrix = cam_from_world()[name]
    return np.asarray(camera.img_from_cam(points @ matrix[:3, :3].T + matrix[:3, 3]))


def enu(geodetic: Array) -> Array:
    """Latitude, longitude, height (n, 3) to east, north, up about the capture's origin, by COLMAP's own conversion."""
    origin = truth()["frame"]["origin"]
    transform = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    return np.asarray(transform.ellipsoid_to_enu(geodetic, origin["latitude"], origin["longitude"], origin["height_m"]))


def exif_position(photo: Image.Image) -> tuple[float, float, float]:
    gps = photo.getexif().get_ifd(0x8825)
    latitude, longitude = (sum(float(x) / 60**k for k, x in enumerate(gps[tag])) for tag in (2, 4))
    return latitude, longitude, float(gps[6])


def errors_of(folder: Path) -> Array:
    """Receiver positions minus true camera centres, east, north, up (n, 3)."""
    fixes = []
    for entry in truth()["photos"]:
        with Image.open(folder / entry["name"]) as photo:
            fixes.append(exif_position(photo))
    return enu(np.array(fixes)) - np.array([entry["centre_m"] for entry in truth()["photos"]])


@dataclass(frozen=True)
class Mark:
    point: str
    photo: str
    utm: Array
    pixel: Array


@cache
def marks() -> list[Mark]:
    lines = (CAPTURE / "gcp_list.txt").read_text("utf-8").splitlines()
    assert lines[0] == truth()["frame"]["projected_crs"]
    fields = [line.split() for line in lines[1:]]
    return [Mark(f[6], f[5], np.array(f[:3], float), np.array(f[3:5], float)) for f in fields]


@cache
def surface() -> trimesh.Trimesh:
    mesh = trimesh.load(CAPTURE / "surface.ply", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def test_capture_is_complete_and_small() -> None:
    photos = sorted(path.name for path in capture_path().iterdir())
    assert photos == [entry["name"] for entry in truth()["photos"]]
    assert len(photos) == 40
    assert sum(path.stat().st_size for path in CAPTURE.rglob("*") if path.is_file()) <= MAX_BYTES
    for name in photos:
        with Image.open(capture_path() / name) as photo:
            photo.load()
            assert (photo.format, photo.mode, photo.size) == ("JPEG", "RGB", (1200, 900))


def test_import_costs_no_renderer() -> None:
    code = "import sys, splatpipe.demo; sys.exit(any(m in sys.modules for m in ('mitsuba', 'drjit', 'numpy')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_exif_reads_like_a_drone_photo() -> None:
    times = []
    for entry in truth()["photos"]:
        with Image.open(capture_path() / entry["name"]) as photo:
            exif = photo.getexif()
            detail = exif.get_ifd(0x8769)
        assert (exif[0x010F], exif[0x0110], exif[0x0112]) == ("DJI", "M3E", 1)
        assert float(detail[0x920A]) == pytest.approx(12.29)
        assert (detail[0xA405], detail[0xA002], detail[0xA003]) == (24, 1200, 900)
        ev = np.log2(float(detail[0x829A]) * 640)
        assert ev == pytest.approx(entry["exposure_ev"], abs=1e-3)
        times.append(detail[0x9003])
    assert times == sorted(set(times))
    assert np.std([entry["exposure_ev"] for entry in truth()["photos"]]) == pytest.approx(0.1, abs=0.01)


def test_xmp_is_well_formed_and_agrees_with_exif_and_truth() -> None:
    for entry in truth()["photos"]:
        path = capture_path() / entry["name"]
        with Image.open(path) as photo:
            packet = photo.info["xmp"]
            latitude, longitude, altitude = exif_position(photo)
        description = next(ET.fromstring(packet).iter("{http://www.w3.org/1999/02/22-rdf-syntax-ns#}Description"))
        values = {key.removeprefix(DJI): value for key, value in description.attrib.items() if key.startswith(DJI)}
        assert values == read_dji(path.read_bytes())
        assert float(values["GpsLatitude"]) == pytest.approx(latitude, abs=2e-9)
        assert float(values["GpsLongitude"]) == pytest.approx(longitude, abs=2e-9)
        assert float(values["AbsoluteAltitude"]) == pytest.approx(altitude, abs=1e-3)
        assert float(values["RelativeAltitude"]) == pytest.approx(entry["centre_m"][2], abs=0.6)
        assert float(values["CalibratedFocalLength"]) == pytest.approx(truth()["camera"]["params"][0], rel=0.005)
        assert "RtkFlag" not in values


def test_gimbal_angles_agree_with_the_cameras() -> None:
    """Level and facing north the camera's axes are east, down, north; yaw turns clockwise, pitch up, roll clockwise."""
    level = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float)  # world from camera
    for entry in truth()["photos"]:
        values = read_dji((capture_path() / entry["name"]).read_bytes())
        yaw, pitch, roll = (np.deg2rad(float(values[f"Gimbal{a}Degree"])) for a in ("Yaw", "Pitch", "Roll"))
        about_up, _ = cv2.Rodrigues(np.array([0, 0, -yaw]))
        about_right, _ = cv2.Rodrigues(np.array([pitch, 0, 0]))
        about_forward, _ = cv2.Rodrigues(np.array([0, 0, roll]))
        world_from_cam = about_up @ level @ about_right @ about_forward
        between = world_from_cam @ cam_from_world()[entry["name"]][:3, :3]
        assert np.rad2deg(np.linalg.norm(cv2.Rodrigues(between)[0])) < 1.2  # the gimbal's own error is 0.2 per axis


def test_gps_errors_have_the_stated_size_and_no_bias() -> None:
    errors = errors_of(capture_path())
    assert np.allclose(errors.mean(axis=0), 0, atol=0.01)
    assert np.allclose(np.sqrt((errors**2).mean(axis=0)), (1.5, 1.5, 3.0), atol=0.01)


def test_rtk_variant_has_the_same_pixels_and_centimetre_positions(tmp_path: Path) -> None:
    folder = write_rtk_variant(tmp_path / "rtk photos")
    errors = errors_of(folder)
    assert np.allclose(errors.mean(axis=0), 0, atol=0.001)
    assert np.allclose(np.sqrt((errors**2).mean(axis=0)), (0.02, 0.02, 0.03), atol=0.001)
    for entry in truth()["photos"]:
        values = read_dji((folder / entry["name"]).read_bytes())
        assert (values["RtkFlag"], float(values["RtkStdLon"]), float(values["RtkStdHgt"])) == ("50", 0.02, 0.03)
    name = truth()["photos"][3]["name"]
    with Image.open(folder / name) as ours, Image.open(capture_path() / name) as theirs:
        assert np.array_equal(np.asarray(ours), np.asarray(theirs))
        assert ours.getexif().get_ifd(0x8769) == theirs.getexif().get_ifd(0x8769)


def test_truth_is_the_generators_flight() -> None:
    lens = BrownLens()
    assert truth()["camera"]["params"] == [lens.f, lens.cx, lens.cy, lens.k]
    rng = np.random.default_rng(0)
    for pose in flight():
        assert np.allclose(pose.cam_from_world, cam_from_world()[pose.name], atol=1e-9)
        points = np.array([0, 0, 3]) + rng.normal(0, 3, (20, 3))
        assert np.allclose(lens.project(pose.to_camera(points)), project(pose.name, points), atol=1e-6)


@pytest.mark.parametrize("lens", [BrownLens(), brown_lens(), brown_lens().scaled(0.25)])
def test_the_generators_lenses_are_colmaps_and_undone(lens: BrownLens) -> None:
    """The generator's pixel rays are the inverse of COLMAP's projection; truth.json names COLMAP's model."""
    camera = pycolmap.Camera(**lens.colmap())
    x, y = np.meshgrid(np.linspace(0.0, lens.width, 13), np.linspace(0.0, lens.height, 10))
    rays = lens.undistort((x.ravel() - lens.cx) / lens.f, (y.ravel() - lens.cy) / lens.f)
    points = 7.0 * np.stack([*rays, np.ones(x.size)], axis=1)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    assert np.allclose(lens.project(points), pixels, atol=1e-6)
    assert np.allclose(camera.img_from_cam(points), pixels, atol=1e-6)


def test_the_brown_lens_is_as_far_from_simple_as_the_p1s() -> None:
    lens = brown_lens()
    assert np.hypot(lens.cx - 600.0, lens.cy - 450.0) == pytest.approx(20.0)
    true = pycolmap.Camera(camera_id=1, **lens.colmap())
    model, params = simplest(true)
    near = pycolmap.Camera(camera_id=1, model=model, width=lens.width, height=lens.height, params=list(params))
    assert 3.0 < np.sqrt(np.mean(apart_px(near, true, turn=True) ** 2)) < 4.5


def test_points_are_on_ground_walls_and_roof_and_each_is_seen_four_times() -> None:
    points = {point["name"]: point for point in truth()["points"]}
    assert len(points) >= 12
    assert {point["where"] for point in points.values()} == {"ground", "wall", "roof"}
    seen = defaultdict(set)
    for mark in marks():
        seen[mark.point].add(mark.photo)
    assert seen.keys() == points.keys()
    assert min(map(len, seen.values())) >= 4
    _, distances, _ = trimesh.proximity.closest_point_naive(surface(), np.array([p["xyz_m"] for p in points.values()]))
    assert distances.max() < 1e-4


def test_control_coordinates_are_the_points() -> None:
    points = {point["name"]: np.array(point["xyz_m"]) for point in truth()["points"]}
    utm = np.stack([mark.utm for mark in marks()])
    to_degrees = Transformer.from_crs(truth()["frame"]["projected_crs"], "EPSG:4326", always_xy=True)
    longitude, latitude = to_degrees.transform(utm[:, 0], utm[:, 1])
    expected = np.stack([points[mark.point] for mark in marks()])
    assert np.allclose(enu(np.stack([latitude, longitude, utm[:, 2]], axis=1)), expected, atol=1e-3)


def test_marks_are_the_projections_with_a_third_of_a_pixel() -> None:
    points = {point["name"]: point for point in truth()["points"]}
    residuals = []
    for mark in marks():
        exact = project(mark.photo, np.array([points[mark.point]["xyz_m"]]))[0]
        assert np.allclose(exact, points[mark.point]["seen_px"][mark.photo], atol=1e-3)
        residuals.append(mark.pixel - exact)
    rms = np.sqrt((np.array(residuals) ** 2).mean(axis=0))
    assert np.all((rms > 0.26) & (rms < 0.34))
    assert np.abs(residuals).max() < 5 * 0.3


def test_targets_in_the_photos_are_at_their_projections() -> None:
    """The corner that OpenCV finds in the pixels is the projection: lens, poses and pixel convention are right."""
    gaps = []
    for point in truth()["points"]:
        for name, pixel in list(point["seen_px"].items())[::4]:
            grey = cv2.imread(str(capture_path() / name), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
            assert grey is not None
            at = np.array([[pixel]], np.float32) - 0.5  # OpenCV's first pixel centre is 0
            patch = grey[int(at[0, 0, 1]) - 3 : int(at[0, 0, 1]) + 5, int(at[0, 0, 0]) - 3 : int(at[0, 0, 0]) + 5]
            if np.ptp(patch) < 60:  # far away or in the shade: nothing that a person would mark to a third of a pixel
                continue
            found = cv2.cornerSubPix(grey, at.copy(), (3, 3), (-1, -1), (3, 50, 1e-3))
            gaps.append(found[0, 0] - at[0, 0])
    assert len(gaps) > 40
    assert np.abs(np.median(gaps, axis=0)).max() < 0.04
    assert np.median(np.linalg.norm(gaps, axis=1)) < 0.15


def test_marked_points_are_not_hidden() -> None:
    points = {point["name"]: np.array(point["xyz_m"]) for point in truth()["points"]}
    corners = np.asarray(surface().triangles, dtype=np.float64)
    by_photo = defaultdict(list)
    for mark in marks():
        by_photo[mark.photo].append(points[mark.point])
    for entry in truth()["photos"][::3]:
        origin = np.array(entry["centre_m"])
        ahead = np.array(by_photo[entry["name"]]) - origin
        distance = np.linalg.norm(ahead, axis=1)
        assert np.allclose(first_hits(origin, ahead / distance[:, None], corners), distance, atol=0.03)


def test_surface_is_the_house_and_its_plot() -> None:
    mesh = surface()
    assert len(mesh.faces) > 10_000
    low, high = mesh.bounds
    assert low[2] > -2
    assert np.all(high[:2] - low[:2] > 500)
    house = mesh.vertices[(np.abs(mesh.vertices[:, :2]) < 8).all(axis=1)]
    assert 8.8 < house[:, 2].max() < 11.5
