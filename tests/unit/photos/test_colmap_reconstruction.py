"""COLMAP models from others: counts, lengths and values are checked before pycolmap fills the memory with them."""

import math
import struct
import tempfile
from collections.abc import Callable
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


def rewrite(path: Path, change: Callable[[bytes], bytes]) -> None:
    path.write_bytes(change(path.read_bytes()))


def names_of(folder: Path) -> list[str]:
    return sorted(image.name for image in read_reconstruction(folder).images.values())


@pytest.mark.parametrize("name", ["flight 1/a.jpg", "a copy (1).jpg", "flight 1\\DJI 0001.JPG", "Höhe 3.jpg", "a  b"])
def test_names_with_blanks_in_text_are_read_whole(tmp_path: Path, name: str) -> None:
    folder = write_model(tmp_path / "model", text=True)
    rewrite(folder / "images.txt", lambda text: text.replace(b"a.jpg", name.encode()))
    assert names_of(folder) == sorted([name, "b.jpg"])


def test_a_name_in_windows_code_page_is_read(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "model", text=True)
    rewrite(folder / "images.txt", lambda text: text.replace(b"a.jpg", "Höhe 1.jpg".encode("cp1252")))
    assert names_of(folder) == ["Höhe 1.jpg", "b.jpg"]


@pytest.mark.parametrize("file", ["cameras.txt", "images.txt", "points3D.txt", "frames.txt"])
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_text_with_a_byte_order_mark_and_windows_line_ends_is_read(tmp_path: Path, file: str, encoding: str) -> None:
    folder = write_model(tmp_path / "model", text=True)
    rewrite(folder / "images.txt", lambda text: text.replace(b"a.jpg", b"a 1.jpg"))
    rewrite(folder / file, lambda text: text.replace(b"\n", b"\r\n").decode().encode(encoding))
    model = read_reconstruction(folder)
    assert (model.num_reg_images(), model.num_points3D()) == (2, 3)
    assert names_of(folder) == ["a 1.jpg", "b.jpg"]
    assert not list(Path(tempfile.gettempdir()).glob("splatpipe-colmap-*"))


def without_keypoints(text: bytes, lines: int) -> bytes:
    """images.txt whose photos have one line, or two of which the second is empty."""
    photos = [line for line in text.split(b"\n") if line.endswith(b".jpg")]
    return b"".join(line + b"\n" * lines for line in photos)


def test_photos_without_keypoints_are_read_if_each_has_two_lines_and_else_refused(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "model", text=True)
    (folder / "points3D.txt").write_text("")
    text = (folder / "images.txt").read_bytes()
    for end in (b"", b"\n", b"\n\n", b"\n\n\n"):
        (folder / "images.txt").write_bytes(without_keypoints(text, 2).rstrip(b"\n") + end)
        assert names_of(folder) == ["a.jpg", "b.jpg"]
    (folder / "images.txt").write_bytes(without_keypoints(text, 1))
    with pytest.raises(SplatpipeError, match=r"images.txt, line 2: a photo where the keypoints"):
        read_reconstruction(folder)


@pytest.mark.parametrize("name", ["7", "1e5", "nan"])
def test_a_photo_whose_name_is_a_number_is_not_taken_for_keypoints(tmp_path: Path, name: str) -> None:
    folder = write_model(tmp_path / "model", text=True)
    lines = without_keypoints((folder / "images.txt").read_bytes(), 1).replace(b"b.jpg", name.encode())
    (folder / "images.txt").write_bytes(lines)
    with pytest.raises(SplatpipeError, match=r"line 2: a photo where the keypoints"):
        read_reconstruction(folder)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"1 1 0 0 0 0 0 0 1\n\n", "line 1: not IMAGE_ID"),
        (b"x 1 0 0 0 0 0 0 1 a.jpg\n\n", "line 1: not IMAGE_ID"),
        ("² 1 0 0 0 0 0 0 1 a.jpg\n\n".encode(), "line 1: not IMAGE_ID"),
        (b"1 1 0 0 0 0 0 0 1 " + b"a" * 5000 + b"\n\n", "a name of 5000 characters"),
        (b"9" * 5000 + b" 1 0 0 0 0 0 0 1 a.jpg\n\n", "cannot be read"),
        (b"\xff\xfe" + b"\x00\xd8" * 9, "cannot be read"),
        (b"\0" * 5000, "cannot be read"),
    ],
)
def test_broken_lines_of_photos_are_refused_by_number(tmp_path: Path, text: bytes, words: str) -> None:
    folder = write_model(tmp_path / "model", text=True)
    (folder / "images.txt").write_bytes(text)
    with pytest.raises(SplatpipeError, match=words):
        read_reconstruction(folder)


def test_a_line_without_an_end_is_refused_before_it_fills_the_memory(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "model", text=True)
    with (folder / "images.txt").open("r+b") as file:
        file.truncate(1 << 40)
    with pytest.raises(SplatpipeError, match=r"images.txt has a line of more than 64 million characters"):
        read_reconstruction(folder)


@pytest.mark.parametrize("camera", [b"7", b"x" * 5000])
def test_a_camera_that_is_not_there_is_named_with_its_photo(tmp_path: Path, camera: bytes) -> None:
    folder = write_model(tmp_path / "model", text=True)
    rewrite(folder / "images.txt", lambda text: text.replace(b" 2 b.jpg", b" " + camera + b" b.jpg"))
    with pytest.raises(SplatpipeError, match=r"b.jpg has camera (7|x{20}), which is not in cameras.txt"):
        read_reconstruction(folder)


@pytest.mark.parametrize("text", [True, False])
def test_a_missing_file_is_named(tmp_path: Path, text: bool) -> None:
    folder = write_model(tmp_path / "model", text=text)
    name = f"points3D.{'txt' if text else 'bin'}"
    (folder / name).unlink()
    with pytest.raises(SplatpipeError, match=f"{name} is missing"):
        read_reconstruction(folder)


@pytest.mark.parametrize("text", [True, False])
def test_keypoints_of_points_that_were_thinned_out_have_none(tmp_path: Path, text: bool) -> None:
    model = pycolmap.Reconstruction(write_model(tmp_path / "model"))
    folder = tmp_path / "thin"
    folder.mkdir()
    model.write_text(folder) if text else model.write_binary(folder)
    model.delete_point3D(2)
    thin = tmp_path / "without"
    thin.mkdir()
    model.write_text(thin) if text else model.write_binary(thin)
    name = f"points3D.{'txt' if text else 'bin'}"
    (thin / name).replace(folder / name)
    read = read_reconstruction(folder)
    assert read.compute_num_observations() == 4
    assert all(
        read.exists_point3D(point.point3D_id)
        for image in read.images.values()
        for point in image.get_observation_points2D()
    )
