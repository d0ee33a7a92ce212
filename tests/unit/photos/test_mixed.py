"""Several cameras, focal lengths, sizes and orientations in one capture."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from surveyed import HEIGHT, LENS, TRUTH, WIDTH, true_model

from splatpipe.pipeline.photos.intake import camera_groups as ingest_cameras
from splatpipe.pipeline.photos.intake.camera_groups import CameraGroup, describe_cameras, group_cameras
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.metadata.exif import Exif
from splatpipe.pipeline.sfm.by_camera import camera_rows, report_cameras, reset_underdetermined_focals
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph


class Notes:
    """A reporter that records."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def progress(self, done: int | float, total: int | float, what: str, unit: str = "") -> None: ...

    def metric(self, name: str, value: int | float, step: int | None = None) -> None: ...

    def note(self, message: str) -> None:
        self.notes.append(message)

    def warning(self, message: str, hint: str = "") -> None: ...


def photo(name: str, size: tuple[int, int] = (4000, 3000), **exif: object) -> CheckedPhoto:
    """A photo of a compact camera."""
    tags: dict[str, object] = {"make": "Canon", "model": "Canon PowerShot A3300 IS", "focal_mm": 5.0}
    tags_read = Exif(**{**tags, **exif})  # type: ignore[arg-type]
    return CheckedPhoto(name, Path(name), "0" * 64, *size, name, True, False, None, tags_read, {})


def grouped(*photos: CheckedPhoto) -> tuple[list[CameraGroup], list[list[str]]]:
    groups, index = group_cameras(photos)
    return groups, [[name for name, number in index.items() if number == k] for k in range(len(groups))]


def test_similar_zoom_steps_share_a_camera() -> None:
    """Most at 5 mm, their neighbours within 1 % with them; 20 mm and its neighbour; 11 mm between them is separate."""
    steps = [5.0, 5.0, 5.0, 4.97, 5.04, 20.0, 20.0, 20.15, 11.0]
    _, names = grouped(*(photo(f"{k}.jpg", focal_mm=step) for k, step in enumerate(steps)))
    assert names == [["0.jpg", "1.jpg", "2.jpg", "3.jpg", "4.jpg"], ["5.jpg", "6.jpg", "7.jpg"], ["8.jpg"]]


def test_digital_zoom_and_another_body_are_separate_cameras() -> None:
    _, names = grouped(
        photo("a.jpg", focal_35mm=28.0, serial="1"),
        photo("b.jpg", focal_35mm=29.0, serial="1"),
        photo("c.jpg", focal_35mm=56.0, serial="1"),
        photo("d.jpg", focal_35mm=28.0, serial="2"),
    )
    assert names == [["a.jpg", "b.jpg"], ["c.jpg"], ["d.jpg"]]


def test_portrait_photos_have_the_same_camera_by_exif_and_the_same_lens_if_pixels_are_rotated() -> None:
    groups, names = grouped(
        photo("a.jpg"), photo("b.jpg", orientation=6), photo("c.jpg", (3000, 4000)), photo("d.jpg", (1600, 1200))
    )
    assert names == [["a.jpg", "b.jpg"], ["c.jpg"], ["d.jpg"]]
    assert groups[1].focal_px == pytest.approx(groups[0].focal_px)
    assert groups[2].focal_px == pytest.approx(0.4 * groups[0].focal_px)
    assert groups[1].params[1:3] == (1500.0, 2000.0)


def test_exif_for_another_size_is_scaled_with_a_note() -> None:
    """As for photos that were resized or cropped without updating their EXIF."""
    plane = {"model": "unheard of", "focal_plane_px_per_mm": 1000.0, "width": 4000, "height": 3000}
    photos = [photo("a.jpg", (1600, 1200), **plane), photo("b.jpg", (1600, 900), **plane), photo("c.jpg", **plane)]
    groups, index = group_cameras(photos)
    assert [(group.focal_px, group.focal_source) for group in groups] == [
        (2000.0, "focal-plane-resolution-resized"),
        (1920.0, "guess"),
        (5000.0, "focal-plane-resolution"),
    ]
    rows = describe_cameras(photos, groups, index)
    assert [(row["exif_size"], row["cropped"]) for row in rows] == [
        ([4000, 3000], False),
        ([4000, 3000], True),
        (None, False),
    ]
    notes = Notes()
    ingest_cameras.report_cameras(rows, notes)
    assert any(
        "1600 × 1200 pixels" in note and "4000 × 3000" in note and "scaled by 0.4" in note for note in notes.notes
    )
    assert any("1600 × 900" in note and "cropped" in note for note in notes.notes)


def two_cameras(alone: float) -> tuple[pycolmap.Reconstruction, ViewGraph, list[dict[str, object]]]:
    """The demo's cameras, the last photo by the same body at half the size, its focal length wrong by a factor."""
    source = true_model(points=400)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(source.cameras[1])
    half = pycolmap.Camera.create_from_model_name(2, "SIMPLE_RADIAL", LENS[0] / 2, WIDTH // 2, HEIGHT // 2)
    half.params = [LENS[0] / 2 * alone, LENS[1] / 2, LENS[2] / 2, LENS[3]]
    model.add_camera_with_trivial_rig(half)
    numbers = sorted(source.reg_image_ids())
    keypoints = {}
    for number in numbers:
        old, last = source.images[number], number == numbers[-1]
        places = np.array([point.xy for point in old.points2D]) * (0.5 if last else 1.0)
        keypoints[number] = places.astype(np.float32)
        model.add_image_with_trivial_frame(
            pycolmap.Image(old.name, places, 2 if last else 1, number), old.cam_from_world()
        )
    for point in source.points3D.values():
        model.add_point3D(point.xyz, point.track, point.color)
    model.update_point_3d_errors()
    camera_of = {number: 2 if number == numbers[-1] else 1 for number in numbers}
    priors = {number: pycolmap.Camera(model.cameras[number].todict()) for number in (1, 2)}
    for number, prior in priors.items():  # the body is 3 % longer than its metadata say
        prior.params = [LENS[0] / 1.03 / number, *model.cameras[number].params[1:]]
        prior.has_prior_focal_length = True
    names = {number: TRUTH["photos"][number - 1]["name"] for number in numbers}
    body = {"make": "DJI", "model_name": "FC330", "focal_source": "sensor-table"}
    groups = [body | {"width": WIDTH // k, "height": HEIGHT // k, "focal_px": LENS[0] / 1.03 / k} for k in (1, 2)]
    return model, ViewGraph(names, camera_of, priors, keypoints, {}), groups


def test_a_single_photos_focal_length_is_that_of_its_body() -> None:
    model, verified, groups = two_cameras(1.4)
    assert reset_underdetermined_focals(model, verified, groups) == [2]
    assert model.cameras[2].mean_focal_length() == pytest.approx(LENS[0] / 2, rel=0.021)
    assert model.cameras[1].mean_focal_length() == pytest.approx(LENS[0], rel=0.01)
    assert model.compute_mean_reprojection_error() < 0.6


def test_sound_cameras_are_unchanged_bit_for_bit() -> None:
    model, verified, groups = two_cameras(1.01)
    before = [np.asarray(image.cam_from_world().matrix()) for image in model.images.values()]
    assert reset_underdetermined_focals(model, verified, groups) == []
    after = [np.asarray(image.cam_from_world().matrix()) for image in model.images.values()]
    assert all((a == b).all() for a, b in zip(before, after, strict=True))


def test_every_camera_is_reported_with_its_photos_focal_length_and_error() -> None:
    model, verified, groups = two_cameras(1.0)
    rows = camera_rows(model, verified, groups)
    assert [(row["name"], row["photos"], row["placed"]) for row in rows] == [("DJI FC330", 39, 39), ("DJI FC330", 1, 1)]
    assert rows[0]["error_px"] == pytest.approx(0.37, abs=0.05)  # mean distance of 0.3 px noise in each coordinate
    assert rows[1]["error_px"] == pytest.approx(rows[0]["error_px"] / 2, rel=0.3)
    notes = Notes()
    report_cameras(rows, notes)
    assert len(notes.notes) == 2
    assert "39 of 39 photos" in notes.notes[0]
