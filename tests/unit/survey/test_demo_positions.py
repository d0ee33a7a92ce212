"""The demo's photos, placed by their stated positions, against their true cameras."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpipe.demo import capture_path
from splatpipe.pipeline.photos.files.scan import Candidate
from splatpipe.pipeline.photos.intake.check import CheckedPhoto, PictureLimits, check_photo
from splatpipe.pipeline.photos.metadata.exif import Gps
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.crs.geodesy import Origin
from splatpipe.pipeline.survey.placing.gps import georeference
from splatpipe.pipeline.survey.placing.level import Positions
from splatpipe.pipeline.survey.placing.model import read_model
from splatpipe.pipeline.survey.positions.photo_positions import PositionList, positions_json, read_positions
from splatpipe.pipeline.survey.positions.stated_positions import read_places

from .test_georef import Survey, georef

TRUTH = json.loads((Path(capture_path()).parent / "truth.json").read_text())
RTK = json.loads((Path(capture_path()).parent / "rtk.json").read_text())
ORIGIN = Origin(**TRUTH["frame"]["origin"])
POSES = {each["name"]: np.array(each["cam_from_world"])[:3] for each in TRUTH["photos"]}
NAMES = sorted(POSES)
CENTRES = np.array([-POSES[name][:, :3].T @ POSES[name][:, 3] for name in NAMES])
CAMERA_NOISE_M = 0.005  # sigma of SfM's cameras


@pytest.fixture(scope="module")
def photos() -> list[CheckedPhoto]:
    results = [check_photo(Candidate(name, capture_path() / name), PictureLimits(320, 10**8)) for name in NAMES]
    return [result for result in results if isinstance(result, CheckedPhoto)]


def with_rtk(photo: CheckedPhoto) -> CheckedPhoto:
    """Return the photo as an RTK receiver would have tagged it."""
    gps = Gps(*RTK["positions"][photo.name])
    tags = {f"drone-dji:{key}": value for key, value in RTK["xmp"].items()}
    return replace(photo, exif=replace(photo.exif, gps=gps), xmp={**photo.xmp, **tags})


def placed(found: PositionList, tmp_path: Path) -> Frame:
    noise = np.random.default_rng(1).normal(size=CENTRES.shape) * CAMERA_NOISE_M
    rotations = np.stack([POSES[name][:, :3] for name in NAMES])
    return georef(Survey(CENTRES + noise, rotations, list(NAMES), positions_json(found)["positions"]), tmp_path)[0]


def stated(found: PositionList) -> np.ndarray:
    return ORIGIN.enu_from_geodetic(
        np.array([[each.latitude, each.longitude, each.altitude_m] for each in found.positions])
    )


def camera_errors(frame: Frame, found: PositionList) -> np.ndarray:
    """Derived from the frame's residual of each photo: placed camera minus stated position."""
    assert frame.origin is not None
    residuals = np.array([frame.residuals["photos"][name] for name in NAMES])
    own = frame.origin.enu_from_geodetic(ORIGIN.geodetic_from_enu(stated(found))) + residuals
    return np.asarray(ORIGIN.enu_from_geodetic(frame.origin.geodetic_from_enu(own)) - CENTRES)


def independent_rmse(target: np.ndarray) -> tuple[float, float]:
    """Horizontal and vertical, of a plain least-squares similarity (Umeyama 1991) of the true cameras."""
    source, goal = CENTRES - CENTRES.mean(axis=0), target - target.mean(axis=0)
    u, singular, vt = np.linalg.svd(goal.T @ source)
    signs = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    residuals = (singular @ signs / (source**2).sum()) * source @ (u * signs @ vt).T - goal
    return float(np.sqrt((residuals[:, :2] ** 2).sum(axis=1).mean())), float(np.sqrt((residuals[:, 2] ** 2).mean()))


@pytest.mark.parametrize("receiver", ["gps_m", "rtk_m"])
def test_residuals_are_the_receivers_noise_and_cameras_are_nearer_to_the_truth(
    photos: list[CheckedPhoto], tmp_path: Path, receiver: str
) -> None:
    found = read_positions(photos if receiver == "gps_m" else [with_rtk(photo) for photo in photos])
    assert {each.flight for each in found.positions} == {0}
    frame = placed(found, tmp_path)
    sigma = np.array(TRUTH["sigmas"][receiver])
    horizontal, vertical = frame.residuals["rmse_horizontal_m"], frame.residuals["rmse_vertical_m"]
    assert horizontal == pytest.approx(np.hypot(sigma[0], sigma[1]), rel=0.2)
    assert vertical == pytest.approx(sigma[2], rel=0.2)
    # Robust weights against none.
    assert (horizontal, vertical) == pytest.approx(independent_rmse(stated(found)), rel=0.03)
    errors = camera_errors(frame, found)
    assert (np.sqrt((errors**2).mean(axis=0)) <= 0.5 * sigma + CAMERA_NOISE_M).all()
    assert frame.left_out == ()


def test_rtk_declares_the_datum_and_consumer_gps_none(photos: list[CheckedPhoto], tmp_path: Path) -> None:
    rtk = read_positions([with_rtk(photo) for photo in photos])
    assert {(each.rtk, each.vertical, each.sigma_horizontal_m) for each in rtk.positions} == {
        ("fixed", "ellipsoidal", 0.02)
    }
    assert placed(rtk, tmp_path).vertical_datum == "ellipsoidal"
    assert {each.vertical for each in read_positions(photos).positions} == {"unknown"}


def test_corrected_positions_in_geo_txt_place_the_cameras_as_rtk_does(
    photos: list[CheckedPhoto], tmp_path: Path
) -> None:
    rows = [f"{name} {lon!r} {lat!r} {up!r} 0 0 0 0.02 0.03\n" for name, (lat, lon, up) in RTK["positions"].items()]
    (tmp_path / "geo.txt").write_text("EPSG:4979\n" + "".join(rows))
    found = read_positions(photos, read_places(tmp_path / "geo.txt", NAMES).by_name)
    frame = placed(found, tmp_path)
    assert frame.vertical_datum == "ellipsoidal"
    assert (np.sqrt((camera_errors(frame, found) ** 2).mean(axis=0)) <= [0.011, 0.011, 0.016]).all()


def test_photos_with_wrong_gps_are_reported_and_the_others_are_placed(
    photos: list[CheckedPhoto], tmp_path: Path
) -> None:
    def at(photo: CheckedPhoto, gps: Gps) -> CheckedPhoto:
        return replace(photo, exif=replace(photo.exif, gps=gps), xmp={})

    right = photos[4].exif.gps
    assert right is not None
    odd = list(photos)
    odd[2] = at(photos[2], Gps(0.0, 0.0, 0.0))
    odd[4] = at(photos[4], Gps(right.longitude, right.latitude, right.altitude_m))
    odd[6] = at(photos[6], Gps(right.latitude + 0.03, right.longitude, right.altitude_m))
    odd[8] = at(photos[8], Gps(right.latitude + 0.0005, right.longitude, right.altitude_m))  # 56 m: the fit finds it
    found = read_positions(odd)
    assert set(found.wrong) == {NAMES[2], NAMES[4], NAMES[6]}
    rotations = np.stack([POSES[name][:, :3] for name in NAMES])
    scene = Survey(CENTRES, rotations, list(NAMES), positions_json(found)["positions"])
    frame, summary, warnings = georef(scene, tmp_path)
    assert frame.kind == "enu"
    assert frame.left_out == (NAMES[8],)
    assert any(NAMES[8] in warning for warning in warnings)
    assert summary["positions_used"] == 36
    model = read_model(tmp_path / "model", NAMES)
    by_name = {str(record["name"]): record for record in scene.positions}
    named, _ = georeference(model, Positions(by_name, {}, found.wrong), 10.0, {})
    assert named.left_out == (NAMES[2], NAMES[4], NAMES[6], NAMES[8])
