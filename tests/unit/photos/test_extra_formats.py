"""HEIC and DNG photos: with a reader they are photos like others, without one the message says what to do.

The readers (pi-heif, rawpy) are stood in for by modules of their interface, as they are an extra.
"""

import io
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Self

import cv2
import numpy as np
import pytest
from PIL import Image
from scenes import raw_photo

from splatpipe.pipeline.photos.files.scan import ExcludedPhoto, scan_folder
from splatpipe.pipeline.photos.intake.check import CheckedPhoto, PictureLimits, check_photo
from splatpipe.pipeline.photos.intake.convert import read_8bit

HEAD = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"
LIMITS = PictureLimits(320, 500_000_000)


def module(monkeypatch: pytest.MonkeyPatch, name: str) -> ModuleType:
    made = ModuleType(name)
    made.__spec__ = ModuleSpec(name, None)
    monkeypatch.setitem(sys.modules, name, made)
    return made


@pytest.fixture
def without(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("pi_heif", "rawpy"):
        monkeypatch.setitem(sys.modules, name, None)


@pytest.fixture
def heif(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader that finds a JPEG behind the head."""

    def opened(source: io.BytesIO) -> Image.Image:
        data = source.read()[len(HEAD) :]
        if not data:
            raise ValueError("Invalid input: Unexpected end of file")
        picture = Image.open(io.BytesIO(data))
        picture.format = "HEIF"
        return picture

    module(monkeypatch, "pi_heif").HeifImageFile = opened  # type: ignore[attr-defined]


class Raw:
    """A raw file that a reader opened."""

    sizes = SimpleNamespace(width=raw_photo.WIDTH, height=raw_photo.HEIGHT)

    def __init__(self, data: bytes) -> None:
        self._data = data

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def postprocess(self, **settings: object) -> np.ndarray:
        assert settings["user_flip"] == 0 and settings["no_auto_bright"]
        if len(self._data) < len(raw_photo.dng()):
            raise RuntimeError(b"Input/output error")
        return np.full((raw_photo.HEIGHT, raw_photo.WIDTH, 3), 90, np.uint8)


@pytest.fixture
def raw(monkeypatch: pytest.MonkeyPatch) -> None:
    made = module(monkeypatch, "rawpy")
    made.LibRawError = RuntimeError  # type: ignore[attr-defined]
    made.imread = lambda source: Raw(source.read())  # type: ignore[attr-defined]


def jpeg() -> bytes:
    exif = Image.Exif()
    exif[271], exif[272] = "Apple", "iPhone 15"
    exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 50.0, 28.3), 3: "E", 4: (13.0, 30.0, 45.7)})
    stream = io.BytesIO()
    Image.new("RGB", (640, 480), (200, 100, 50)).save(stream, "JPEG", exif=exif.tobytes())
    return stream.getvalue()


@pytest.mark.usefixtures("without")
def test_without_a_reader_the_message_says_how_to_convert_or_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "a.HEIC").write_bytes(HEAD + jpeg())
    (tmp_path / "b.DNG").write_bytes(raw_photo.dng())
    (tmp_path / "c.CR2").write_bytes(raw_photo.dng())
    scan = scan_folder(tmp_path)
    assert scan.candidates == ()
    first, second, third = (entry.reason for entry in scan.left_out)
    assert "convert it to JPEG" in first and "pip install pi-heif" in first
    assert "develop it to JPEG or TIFF" in second and "pip install rawpy" in second
    assert third == "is a camera's raw file: develop it to JPEG or TIFF"


@pytest.mark.usefixtures("heif")
def test_a_heic_picture_is_a_photo_with_its_exif(tmp_path: Path) -> None:
    (tmp_path / "a.HEIC").write_bytes(HEAD + jpeg())
    (candidate,) = scan_folder(tmp_path).candidates
    photo = check_photo(candidate, LIMITS)
    assert isinstance(photo, CheckedPhoto) and not photo.plain
    assert (photo.width, photo.height, photo.exif.model) == (640, 480, "iPhone 15")
    assert photo.exif.gps is not None and photo.exif.gps.latitude == pytest.approx(47.841194, abs=1e-6)
    assert read_8bit(photo, None)[0].mean(axis=(0, 1)) == pytest.approx([200, 100, 50], abs=3)
    (tmp_path / "a.HEIC").write_bytes(HEAD)
    broken = check_photo(candidate, LIMITS)
    assert isinstance(broken, ExcludedPhoto) and "damaged" in broken.reason


@pytest.mark.usefixtures("raw")
def test_a_raw_file_is_developed_in_its_stored_grid(tmp_path: Path) -> None:
    (tmp_path / "a.DNG").write_bytes(raw_photo.dng())
    (candidate,) = scan_folder(tmp_path).candidates
    photo = check_photo(candidate, LIMITS)
    assert isinstance(photo, CheckedPhoto) and not photo.plain
    assert (photo.exif.make, photo.exif.model, photo.exif.orientation) == ("DJI", "FC9", raw_photo.ORIENTATION)
    assert read_8bit(photo, None)[0].shape == (raw_photo.HEIGHT, raw_photo.WIDTH, 3)
    (tmp_path / "a.DNG").write_bytes(raw_photo.dng()[:100_000])
    broken = check_photo(candidate, LIMITS)
    assert isinstance(broken, ExcludedPhoto) and "truncated" in broken.reason


@pytest.mark.usefixtures("heif", "raw")
def test_other_formats_of_a_photo_are_left_out_whatever_is_installed(tmp_path: Path) -> None:
    (tmp_path / "a.JPG").write_bytes(jpeg())
    (tmp_path / "b.HEIC").write_bytes(HEAD + jpeg())
    for name in ("a.DNG", "b.DNG"):
        (tmp_path / name).write_bytes(raw_photo.dng())
    scan = scan_folder(tmp_path)
    assert [candidate.name for candidate in scan.candidates] == ["a.JPG", "b.HEIC"]
    assert {(entry.name, entry.kind) for entry in scan.left_out} == {("a.DNG", "companion"), ("b.DNG", "companion")}


def test_a_colour_tiff_of_floats_is_not_only_called_damaged(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "reflectance.tif"), np.full((400, 500, 3), 0.5, np.float32))
    [candidate] = scan_folder(tmp_path).candidates
    left_out = check_photo(candidate, LIMITS)
    assert isinstance(left_out, ExcludedPhoto) and "8 or 16 bits for each colour" in left_out.reason
