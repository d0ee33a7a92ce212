"""COLMAP models from others: counts, lengths and values are checked before pycolmap fills the memory with them."""

import math
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.photos.colmap.colmap_reconstruction import read_reconstruction

BINARY = ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")
HUGE = struct.pack("<Q", 1 << 61)
NAN, INFINITE = struct.pack("<d", math.nan), struct.pack("<d", math.inf)
IMAGE_AT = 8  # after the count
NAME_AT = IMAGE_AT + 64
KEYPOINTS_AT = NAME_AT + len("a.jpg") + 1
POINT_AT = 8
TRACK_AT = POINT_AT + 43


def write_model(folder: Path, *, legacy: bool = False, text: bool = False) -> Path:
    """Two photos of one rig of two cameras, and points."""
    model = pycolmap.Reconstruction()
    for number, (kind, more) in enumerate((("PINHOLE", 0), ("OPENCV", 4)), start=1):
        params = [50.0, 51.0, 19.0, 16.0, *[0.0] * more]
        model.add_camera(pycolmap.Camera(camera_id=number, model=kind, width=40, height=30, params=params))
    first, second = (pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number) for number in (1, 2))
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(first)
    rig.add_sensor(second, pycolmap.Rigid3d())
    model.add_rig(rig)
    frame = pycolmap.Frame(frame_id=1, rig_id=1)
    frame.add_data_id(pycolmap.data_t(first, 1))
    frame.add_data_id(pycolmap.data_t(second, 2))
    frame.rig_from_world = pycolmap.Rigid3d()
    model.add_frame(frame)
    for number, name in ((1, "a.jpg"), (2, "b.jpg")):
        image = pycolmap.Image(name, np.full((5, 2), 3.0), number, number)
        image.frame_id = 1
        model.add_image(image)
    for index in range(3):
        track = pycolmap.Track([pycolmap.TrackElement(1, index), pycolmap.TrackElement(2, index)])
        model.add_point3D(np.array([0.1, 0.2, 3.0]), track, np.zeros(3, np.uint8))
    folder.mkdir()
    model.write_text(folder) if text else model.write_binary(folder)
    if legacy:
        for path in (folder / "rigs.bin", folder / "frames.bin"):
            path.unlink()
    return folder


def put(path: Path, at: int, data: bytes) -> None:
    whole = bytearray(path.read_bytes())
    whole[at : at + len(data)] = data
    path.write_bytes(whole)


@pytest.mark.parametrize("kind", [{}, {"legacy": True}, {"text": True}])
def test_a_sound_model_is_read(tmp_path: Path, kind: dict[str, bool]) -> None:
    model = read_reconstruction(write_model(tmp_path / "model", **kind))
    assert (model.num_reg_images(), model.num_points3D()) == (2, 3)


@pytest.mark.parametrize("name", BINARY)
@pytest.mark.parametrize("lost", [1, 9, 30])
def test_a_truncated_file_is_refused(tmp_path: Path, name: str, lost: int) -> None:
    path = write_model(tmp_path / "model") / name
    path.write_bytes(path.read_bytes()[:-lost])
    with pytest.raises(SplatpipeError, match=name):
        read_reconstruction(path.parent)


@pytest.mark.parametrize(
    ("name", "at"),
    [*((name, 0) for name in BINARY), ("images.bin", KEYPOINTS_AT), ("points3D.bin", TRACK_AT)],
)
def test_a_count_beyond_the_files_end_is_refused(tmp_path: Path, name: str, at: int) -> None:
    folder = write_model(tmp_path / "model")
    put(folder / name, at, HUGE)
    with pytest.raises(SplatpipeError, match=rf"{name} (claims|ends)"):
        read_reconstruction(folder)


@pytest.mark.parametrize(("name", "at"), [("rigs.bin", 12), ("frames.bin", 72)])
def test_a_count_of_sensors_beyond_the_files_end_is_refused(tmp_path: Path, name: str, at: int) -> None:
    folder = write_model(tmp_path / "model")
    put(folder / name, at, struct.pack("<I", 1 << 31))
    with pytest.raises(SplatpipeError, match=f"{name} ends too early"):
        read_reconstruction(folder)


def test_a_name_without_an_end_is_refused(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "model")
    put(folder / "images.bin", NAME_AT, b"a" * 100_000)
    with pytest.raises(SplatpipeError, match=r"images.bin has a name without an end"):
        read_reconstruction(folder)


def test_a_camera_of_an_unknown_model_is_refused(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "model")
    put(folder / "cameras.bin", 12, struct.pack("<i", 99))
    with pytest.raises(SplatpipeError, match=r"unknown model \(99\)"):
        read_reconstruction(folder)


@pytest.mark.parametrize("value", [NAN, INFINITE])
@pytest.mark.parametrize(
    ("name", "at", "said"),
    [
        ("cameras.bin", 32, "camera 1 has a parameter that is not finite"),
        ("images.bin", IMAGE_AT + 4, "the pose of a.jpg is zero or not finite"),
        ("images.bin", IMAGE_AT + 36, "the pose of a.jpg is zero or not finite"),
        ("images.bin", KEYPOINTS_AT + 8, "a keypoint of a.jpg is not finite"),
        ("points3D.bin", POINT_AT + 8, "a point whose position is not finite"),
    ],
)
def test_numbers_that_are_not_finite_are_refused(tmp_path: Path, value: bytes, name: str, at: int, said: str) -> None:
    folder = write_model(tmp_path / "model", legacy=True)
    put(folder / name, at, value)
    with pytest.raises(SplatpipeError, match=said):
        read_reconstruction(folder)


def test_a_zero_quaternion_is_refused(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "model", legacy=True)
    put(folder / "images.bin", IMAGE_AT + 4, bytes(32))
    with pytest.raises(SplatpipeError, match=r"the pose of a.jpg is zero"):
        read_reconstruction(folder)


def test_a_zero_quaternion_in_a_text_model_is_refused(tmp_path: Path) -> None:
    path = write_model(tmp_path / "model", text=True) / "frames.txt"
    path.write_text(path.read_text().replace("1 1 1 0 0 0 0 0 0 2", "1 1 0 0 0 0 0 0 0 2"))
    with pytest.raises(SplatpipeError, match=r"the pose of [ab].jpg is zero"):
        read_reconstruction(path.parent)


def test_a_number_of_a_text_model_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    path = write_model(tmp_path / "model", text=True) / "points3D.txt"
    path.write_text(path.read_text().replace(" 0.2", " nan").replace(" 0.20000000000000001", " nan"))
    with pytest.raises(SplatpipeError, match="cannot be read"):
        read_reconstruction(path.parent)
