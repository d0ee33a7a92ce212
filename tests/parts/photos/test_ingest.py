"""Ingest on realistic folders: all kinds of images, broken ones, masks, positions."""

import hashlib
import io
import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.events import Event
from splatpipe.pipeline.engine.runs.session import Request, open_session
from splatpipe.pipeline.engine.runs.source import open_source
from splatpipe.pipeline.engine.stage import Inputs, Machine, Summary
from splatpipe.pipeline.photos.files.photo_list import (
    Photo,
    decode,
    decode_mask,
    decode_sky_mask,
    load_photo_list,
    photo_root,
)
from splatpipe.pipeline.photos.files.picture_file import LARGE_PIXELS
from splatpipe.pipeline.photos.files.scan import Candidate
from splatpipe.pipeline.photos.intake.camera_groups import focal_prior
from splatpipe.pipeline.photos.intake.check import CheckedPhoto, PictureLimits, check_photo
from splatpipe.pipeline.photos.intake.detail import read_grey
from splatpipe.pipeline.photos.metadata.exif import Exif
from splatpipe.pipeline.photos.options import IngestConfig
from splatpipe.stages.ingest import run
from splatpipe.stages.line import LINE
from splatpipe.stages.options import LineConfig

WIDTH, HEIGHT = 400, 300
JPEG_ERROR = 12  # grey values, of a smooth picture at quality 95


@dataclass
class Notes:
    """A reporter that records."""

    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def progress(self, done: int | float, total: int | float, what: str, unit: str = "") -> None:
        assert 0 <= done <= total

    def metric(self, name: str, value: int | float, step: int | None = None) -> None: ...

    def note(self, message: str) -> None:
        self.notes.append(message)

    def warning(self, message: str, hint: str = "") -> None:
        self.warnings.append(message)


@dataclass
class Result:
    """Return the output of an ingest."""

    summary: Summary
    out: Path
    folder: Path
    warnings: list[str]
    notes: list[str]

    @property
    def photos(self) -> dict[str, Photo]:
        return dict(load_photo_list(self.out / "photos").by_name())

    @property
    def left_out(self) -> dict[str, str]:
        value = json.loads((self.out / "left_out.json").read_text())
        return {entry["name"]: entry["reason"] for entry in value["left_out"]}

    def json(self, name: str) -> dict[str, list[dict[str, object]]]:
        value: dict[str, list[dict[str, object]]] = json.loads((self.out / name).read_text())
        return value

    def pixels(self, name: str) -> np.ndarray:
        return decode(self.photos[name], self.out / "photos", self.folder)

    def mask(self, name: str) -> np.ndarray | None:
        return decode_mask(self.photos[name], self.out / "photos")


def ingest(
    folder: Path,
    threads: int = 2,
    out: str = "out",
    geo: Path | None = None,
    lens: Path | None = None,
    **options: object,
) -> Result:
    target = folder.parent / out
    target.mkdir()
    notes = Notes()
    absent = folder.parent / "no-such-file.txt"
    sources = {"source.geo": geo or absent, "source.lens": lens or absent}
    inputs = Inputs(sources, folder, {}, Machine(threads=threads))
    summary = run(IngestConfig(**options), inputs, target, notes)
    return Result(summary, target, folder, notes.warnings, notes.notes)


def picture(seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Return a smooth image with four different corners, a different one for every seed."""
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    wave = 0.1 * np.sin(6.0 * x * (seed + 1))
    return (np.stack([x, y, 0.5 + wave], axis=-1) * 250).astype(np.uint8)


def save(path: Path, seed: int = 0, size: tuple[int, int] = (WIDTH, HEIGHT), **options: object) -> np.ndarray:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = picture(seed, *size)
    if path.suffix.lower() in (".jpg", ".jpeg"):
        options = {"format": "JPEG", "quality": 95, "subsampling": 0, **options}
    Image.fromarray(pixels).save(path, **options)
    return pixels


def replace_in_silence(path: Path) -> None:
    """Another content of the same size, with the same time of modification, in the same file."""
    before, data = path.stat(), bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    with path.open("r+b") as file:
        file.write(data)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert (path.stat().st_size, path.stat().st_mtime_ns) == (before.st_size, before.st_mtime_ns)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A photo folder with two good photos."""
    photos = tmp_path / "photos"
    save(photos / "a.jpg", 1)
    save(photos / "b.jpg", 2)
    return photos


def test_plain_photos_are_used_in_place(folder: Path) -> None:
    save(folder / "inner" / "c.png", 3)
    Image.fromarray(picture(4)).save(folder / "d.tif")
    Image.fromarray(picture(5)).convert("L").save(folder / "grey.jpg", quality=95)
    result = ingest(folder)
    assert list(result.photos) == ["a.jpg", "b.jpg", "d.tif", "grey.jpg", "inner/c.png"]
    assert all(photo.converted is None and photo.mask is None for photo in result.photos.values())
    assert not (result.out / "photos" / "converted").exists()
    np.testing.assert_array_equal(result.pixels("inner/c.png"), picture(3))
    np.testing.assert_array_equal(result.pixels("d.tif"), picture(4))
    assert np.abs(result.pixels("a.jpg").astype(int) - picture(1)).max() <= JPEG_ERROR
    grey = result.pixels("grey.jpg")
    assert (grey[..., 0] == grey[..., 2]).all()
    assert result.photos["a.jpg"].sha256 == hashlib.sha256((folder / "a.jpg").read_bytes()).hexdigest()
    assert result.summary["photos"] == 5
    assert result.left_out == {}


def deep(seed: int, scale: float, offset: float = 0.0) -> np.ndarray:
    return (picture(seed).astype(np.float64) * scale + offset).astype(np.uint16)


def write_png16(path: Path, pixels: np.ndarray) -> None:
    """A 16-bit RGB or RGBA PNG, which Pillow cannot write."""
    height, width, channels = pixels.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", width, height, 16, {3: 2, 4: 6}[channels], 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    parts = [struct.pack(">I", len(d)) + kind + d + struct.pack(">I", zlib.crc32(kind + d)) for kind, d in chunks]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


def write_tiff16(path: Path, pixels: np.ndarray, orientation: int = 1) -> None:
    """A 16-bit RGB TIFF, which Pillow cannot write either."""
    height, width, _ = pixels.shape
    tags = [(256, 3, 1, width), (257, 3, 1, height), (258, 3, 3, 8 + 2 + 10 * 12 + 4), (259, 3, 1, 1), (262, 3, 1, 2)]
    data_at = 8 + 2 + 10 * 12 + 4 + 6
    tags += [(273, 4, 1, data_at), (274, 3, 1, orientation), (277, 3, 1, 3), (278, 3, 1, height)]
    tags += [(279, 4, 1, pixels.nbytes)]
    body = struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags) + struct.pack("<I", 0)
    path.write_bytes(b"II*\0" + struct.pack("<I", 8) + body + struct.pack("<HHH", 16, 16, 16) + pixels.tobytes())


def test_deep_photos_that_use_their_range_keep_their_brightness(folder: Path) -> None:
    write_png16(folder / "p.png", deep(3, 257.0))
    write_tiff16(folder / "t.tif", deep(4, 257.0))
    Image.fromarray(deep(5, 257.0)[..., 0]).save(folder / "g.png")
    result = ingest(folder)
    np.testing.assert_array_equal(result.pixels("p.png"), picture(3))
    np.testing.assert_array_equal(result.pixels("t.tif"), picture(4))
    np.testing.assert_array_equal(result.pixels("g.png")[..., 1], picture(5)[..., 0])
    assert result.photos["p.png"].converted == "converted/p.png.png"


def test_photos_of_few_bits_are_scaled_equally(folder: Path) -> None:
    """12 bits in a 16-bit file, as thermal and machine-vision cameras write: one scale for all photos of the camera."""
    Image.fromarray(deep(5, 4.0, 7000.0)[..., 0]).save(folder / "cold.png")
    Image.fromarray(deep(5, 4.0, 7500.0)[..., 0]).save(folder / "warm.png")
    result = ingest(folder)
    cold, warm = (result.pixels(name)[..., 0].astype(int) for name in ("cold.png", "warm.png"))
    assert cold.min() == 0
    assert warm.max() == 255
    expected = 500.0 / (1000.0 + 500.0) * 255.0
    assert np.median(warm - cold) == pytest.approx(expected, abs=2.0)


def test_turned_tiffs_stay_in_the_stored_grid(folder: Path) -> None:
    for orientation in (3, 6, 8):
        exif = Image.Exif()
        exif[274] = orientation
        Image.fromarray(picture(10 + orientation)).save(folder / f"t{orientation}.tif", exif=exif)
        write_tiff16(folder / f"d{orientation}.tif", deep(20 + orientation, 257.0), orientation)
    result = ingest(folder)
    for orientation in (3, 6, 8):
        for name, seed in ((f"t{orientation}.tif", 10 + orientation), (f"d{orientation}.tif", 20 + orientation)):
            np.testing.assert_array_equal(result.pixels(name), picture(seed))
            assert result.photos[name].orientation == orientation
            assert (result.photos[name].width, result.photos[name].height) == (WIDTH, HEIGHT)


def test_turned_jpegs_stay_in_the_stored_grid(folder: Path) -> None:
    exif = Image.Exif()
    exif[274] = 6
    save(folder / "turned.jpg", 7, exif=exif)
    result = ingest(folder)
    assert np.abs(result.pixels("turned.jpg").astype(int) - picture(7)).max() <= JPEG_ERROR
    assert result.photos["turned.jpg"].orientation == 6
    assert result.json("positions.json")["orientations"] == {"turned.jpg": 6}


def test_colour_kinds_become_rgb(folder: Path) -> None:
    Image.fromarray(picture(3)).convert("CMYK").save(folder / "cmyk.jpg", quality=98)
    Image.fromarray(picture(4)).convert("RGBA").save(folder / "opaque.png")
    Image.fromarray(picture(5)).quantize(256).save(folder / "palette.png")
    Image.fromarray(picture(6)[..., 0] > 99).save(folder / "bits.png")
    result = ingest(folder)
    assert np.abs(result.pixels("cmyk.jpg").astype(int) - picture(3)).max() <= 2 * JPEG_ERROR
    np.testing.assert_array_equal(result.pixels("opaque.png"), picture(4))
    assert np.abs(result.pixels("palette.png").astype(int) - picture(5)).mean() < 10
    np.testing.assert_array_equal(result.pixels("bits.png")[..., 0] > 99, picture(6)[..., 0] > 99)
    assert result.photos["opaque.png"].mask is None
    assert all(result.photos[name].converted for name in ("cmyk.jpg", "opaque.png", "palette.png", "bits.png"))


def test_transparent_pixels_are_masked(folder: Path) -> None:
    rgba = np.dstack([picture(4), np.full((HEIGHT, WIDTH), 255, np.uint8)])
    rgba[:100, :, 3] = 0
    Image.fromarray(rgba).save(folder / "cut.png")
    sixteen = rgba.astype(np.uint16) * 257
    write_png16(folder / "cut16.png", sixteen)
    result = ingest(folder)
    for name in ("cut.png", "cut16.png"):
        mask = result.mask(name)
        assert mask is not None
        assert (mask[:100] == 0).all()
        assert (mask[100:] == 255).all()
        np.testing.assert_array_equal(result.pixels(name)[100:], picture(4)[100:])


def bad_files(folder: Path) -> dict[str, str]:
    """Write files that pretend to be photos; return a word of each one's reason."""
    good = (folder / "a.jpg").read_bytes()
    png = io.BytesIO()
    Image.fromarray(picture(9)).save(png, "PNG")
    (folder / "half.jpg").write_bytes(good[: len(good) // 2])
    (folder / "half.png").write_bytes(png.getvalue()[: len(png.getvalue()) // 2])
    (folder / "text.jpg").write_text("I am a photo")
    (folder / "empty.png").write_bytes(b"")
    (folder / "header.jpg").write_bytes(good[:3])
    (folder / "tiny.jpg").write_bytes(b"")
    save(folder / "tiny.jpg", 1, (160, 120))
    (folder / "phone.heic").write_bytes(b"\0\0\0\x18ftypheic" + b"\0" * 50)
    (folder / "web.jpg").write_bytes(b"RIFF\x10\0\0\0WEBPVP8 " + b"\0" * 50)
    (folder / "raw.dng").write_bytes(b"II*\0" + b"\0" * 50)
    os.mkfifo(folder / "pipe.jpg")
    (folder / "dangling.jpg").symlink_to(folder / "nothing")
    width, height = struct.pack(">I", 60_000), struct.pack(">I", 60_000)
    header = b"IHDR" + width + height + b"\x08\x02\0\0\0"
    head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    (folder / "bomb.png").write_bytes(head + struct.pack(">I", 1000) + b"IDAT" + zlib.compress(b"\0" * 10**6))
    return {
        "half.jpg": "is truncated",
        "half.png": "is truncated",
        "text.jpg": "no JPEG",
        "empty.png": "is empty",
        "header.jpg": "damaged",
        "tiny.jpg": "160 × 120",
        "phone.heic": "HEIC",
        "web.jpg": "WebP",
        "raw.dng": "raw file",
        "pipe.jpg": "not a regular file",
        "dangling.jpg": "cannot be read",
        "bomb.png": "60000 × 60000",
    }


def test_bad_files_are_left_out_and_named_with_reasons(folder: Path) -> None:
    expected = bad_files(folder)
    for other in ("notes.txt", ".hidden.jpg", "flight.srt", "Thumbs.db"):
        (folder / other).write_text("no photo, and does not pretend")
    result = ingest(folder)
    assert set(result.photos) == {"a.jpg", "b.jpg"}
    assert set(result.left_out) == set(expected)
    for name, word in expected.items():
        assert word in result.left_out[name], (name, result.left_out[name])
        assert any(name in warning for warning in result.warnings)


def test_photos_are_recognised_by_content_and_not_by_suffix(folder: Path) -> None:
    shutil.move(folder / "a.jpg", folder / "a.dat")
    buffer = io.BytesIO()
    Image.fromarray(picture(3)).save(buffer, "PNG")
    (folder / "png.jpg").write_bytes(buffer.getvalue())
    result = ingest(folder)
    assert set(result.photos) == {"a.dat", "b.jpg", "png.jpg"}
    np.testing.assert_array_equal(result.pixels("png.jpg"), picture(3))


def test_pictures_with_a_second_one_inside_are_read_and_panoramas_and_raws_are_not(folder: Path) -> None:
    second = Image.fromarray(picture(4))
    Image.fromarray(picture(3)).save(folder / "pages.tif", save_all=True, append_images=[second])
    Image.fromarray(picture(3)).save(folder / "pair.jpg", "MPO", save_all=True, append_images=[second], quality=95)
    pano = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><a GPano:ProjectionType="equirectangular"/></x:xmpmeta>'
    save(folder / "pano.jpg", 5, (800, 400), xmp=pano)
    tags = ImageFileDirectory_v2()
    tags[50706] = b"\x01\x04\0\0"
    Image.fromarray(picture(3)).save(folder / "raw.tif", tiffinfo=tags)
    result = ingest(folder)
    assert set(result.photos) == {"a.jpg", "b.jpg", "pair.jpg", "pages.tif"}
    np.testing.assert_array_equal(result.pixels("pages.tif"), picture(3))
    assert np.abs(result.pixels("pair.jpg").astype(int) - picture(3)).max() <= 2 * JPEG_ERROR
    assert "panorama" in result.left_out["pano.jpg"]
    assert "raw file" in result.left_out["raw.tif"]


def test_decoding_detects_that_a_photo_has_changed(folder: Path) -> None:
    result = ingest(folder)
    save(folder / "a.jpg", 1, (WIDTH, WIDTH))
    with pytest.raises(SplatpipeError, match=r"a\.jpg has changed since"):
        result.pixels("a.jpg")
    replace_in_silence(folder / "b.jpg")
    with pytest.raises(SplatpipeError, match=r"b\.jpg has changed since the photos were checked: it was rep"):
        result.pixels("b.jpg")
    (folder / "b.jpg").unlink()
    with pytest.raises(SplatpipeError, match=r"b\.jpg has changed since"):
        result.pixels("b.jpg")


def test_photo_replaced_unnoticed_is_refused_by_the_stage_that_reads_it(folder: Path, tmp_path: Path) -> None:
    """A photo replaced after ingest and before features: the keypoints would not match the key."""
    save(folder / "c.png", 3)

    def meddle(event: Event) -> None:
        if (event.kind, event.stage) == ("stage_started", "features"):
            replace_in_silence(folder / "b.jpg")

    request = Request(LINE, LineConfig(), folder, tmp_path / "run", Machine("cpu", 1))
    with pytest.raises(SplatpipeError, match=r"b\.jpg has changed since"), open_session(request, meddle) as runner:
        runner.walk(until="features")
    assert runner.outcome.ran == ["ingest"] and runner.outcome.failed == "features"
    with open_session(request, lambda event: None) as again:
        again.walk(until="ingest")
    assert again.outcome.ran == ["ingest"]  # size and times are unchanged, and the replacement is detected nevertheless


def test_duplicates_are_left_out(folder: Path) -> None:
    for name in ("copy of a.jpg", "a(1).jpg", "a - Copy.jpg"):  # "(" and " " come before "."
        shutil.copy(folder / "a.jpg", folder / name)
    exif = Image.Exif()
    exif[271] = "edited"
    save(folder / "a2.png", 5)
    save(folder / "a3.png", 5, exif=exif)
    segment = exif.tobytes()
    jpeg = (folder / "b.jpg").read_bytes()
    app1 = b"\xff\xe1" + struct.pack(">H", 2 + len(segment)) + segment
    (folder / "b2.jpg").write_bytes(jpeg[:2] + app1 + jpeg[2:])
    result = ingest(folder)
    assert set(result.photos) == {"a.jpg", "b.jpg", "a2.png"}
    assert result.left_out == {
        **dict.fromkeys(("copy of a.jpg", "a(1).jpg", "a - Copy.jpg"), "is the same file as a.jpg"),
        "a3.png": "has the same pixels as a2.png",
        "b2.jpg": "has the same pixels as b.jpg",
    }


def test_strange_names_work(folder: Path) -> None:
    names = ["mit Leer zeichen.jpg", "фото №1.jpg", "写真/家.jpg", "quote'\".jpg", "-rf.jpg", "ö.JPG"]
    for seed, name in enumerate(names):
        save(folder / name, seed + 3)
    (Path(os.fsdecode(os.fsencode(folder) + b"/bad\xff.jpg"))).write_bytes((folder / "a.jpg").read_bytes())
    result = ingest(folder)
    assert set(result.photos) == {"a.jpg", "b.jpg", *names}
    assert np.abs(result.pixels("写真/家.jpg").astype(int) - picture(5)).max() <= JPEG_ERROR
    assert result.left_out == {"bad\\xff.jpg": "has a name that is not UTF-8: rename it"}
    assert all("\n" not in warning for warning in result.warnings)


@pytest.mark.parametrize("sign", ["\n", "\r", "\t", "\x1b", "\x85", "\u2028", "\u2029"])
def test_names_with_control_characters_are_left_out_and_named(folder: Path, sign: str) -> None:
    save(folder / f"x{sign}y" / "c.jpg", 3)
    save(folder / f"d{sign}.jpg", 4)
    result = ingest(folder)
    assert set(result.photos) == {"a.jpg", "b.jpg"}
    assert len(result.left_out) == 2
    assert set(result.left_out.values()) == {"has a line break or another control character in its name: rename it"}
    assert repr(sign)[1:-1] in result.warnings[0] and sign not in result.warnings[0]


def test_a_photo_list_with_such_a_name_is_refused(folder: Path) -> None:
    part = ingest(folder).out / "photos"
    path = part / "photos.json"
    path.write_text(path.read_text().replace("a.jpg", "a\\u2028.jpg"))
    with pytest.raises(SplatpipeError, match=r"a\\u2028.jpg has a control character"):
        load_photo_list(part)


def hollow_png(path: Path, width: int, height: int, bits: int = 1, colour: int = 0) -> None:
    """Write a PNG that claims this size; its pixels are missing, as nobody should get to them."""
    head = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    chunks = [(b"IHDR", head), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")]
    path.parent.mkdir(parents=True, exist_ok=True)
    chunks.insert(1, (b"juNk", bytes(1_000_000)))
    packed = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(packed))


@pytest.fixture
def never_large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail if a large picture is decoded."""
    load = PngImageFile.load

    def checked(picture: PngImageFile) -> object:
        assert picture.width * picture.height <= LARGE_PIXELS
        return load(picture)

    monkeypatch.setattr(PngImageFile, "load", checked)


@pytest.mark.usefixtures("never_large")
@pytest.mark.parametrize(("bits", "colour"), [(1, 0), (16, 0), (8, 2), (16, 2)])
def test_large_photos_without_content_are_refused_before_they_are_decoded(folder: Path, bits: int, colour: int) -> None:
    hollow_png(folder / "c.png", 7000, 6000, bits, colour)
    assert "claims 7000 × 6000 pixels in only" in ingest(folder).left_out["c.png"]


def test_large_photos_that_cannot_be_reduced_while_decoding_are_examined_at_a_part_of_their_size(folder: Path) -> None:
    coarse = np.random.default_rng(0).integers(0, 256, (750, 1000), np.uint8)
    Image.fromarray(np.kron(coarse, np.ones((8, 8), np.uint8))).save(folder / "c.png", compress_level=1)
    limits = PictureLimits(320, 500_000_000)
    photo = check_photo(Candidate("c.png", folder / "c.png"), limits)
    assert isinstance(photo, CheckedPhoto) and (photo.width, photo.height) == (8000, 6000)
    assert read_grey(photo).tolist() == np.kron(coarse, np.ones((2, 2), np.uint8)).tolist()


@pytest.mark.usefixtures("never_large")
@pytest.mark.parametrize(
    ("size", "said"),
    [((7000, 7000), "another aspect ratio (7000 × 7000)"), ((8000, 6000), "far larger (8000 × 6000)")],
)
@pytest.mark.parametrize("bits", [1, 16])
def test_large_masks_are_refused_before_they_are_decoded(
    folder: Path, size: tuple[int, int], said: str, bits: int
) -> None:
    hollow_png(folder / "masks" / "a.jpg.png", *size, bits)
    result = ingest(folder)
    assert said in result.warnings[0]
    assert result.photos["a.jpg"].mask is None


def test_links_to_folders_are_named_and_not_followed(folder: Path) -> None:
    (folder / "loop").symlink_to(folder)
    result = ingest(folder)
    assert set(result.photos) == {"a.jpg", "b.jpg"}
    assert "not followed" in result.left_out["loop"]


def test_links_to_devices_pipes_and_pseudo_files_are_named_and_never_opened(folder: Path) -> None:
    targets = {"c.jpg": "/proc/kmsg", "d.jpg": "/dev/zero", "f.bin": "/proc/kmsg", "g.tif": "/dev/tty"}
    os.mkfifo(folder.parent / "pipe")
    targets["e.png"] = str(folder.parent / "pipe")
    for name, target in targets.items():
        (folder / name).symlink_to(target)
    os.mkfifo(folder / "h.jpg")
    (folder / "masks").mkdir()
    (folder / "masks/a.png").symlink_to("/proc/kmsg")
    result = ingest(folder)
    assert set(result.photos) == {"a.jpg", "b.jpg"}
    assert result.left_out == dict.fromkeys([*targets, "h.jpg"], "is not a regular file")


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (lambda path: None, ["is empty"]),
        (lambda path: (path / "notes.txt").write_text("hello"), ["no photos", "1 other file"]),
        (lambda path: (path / "f.mkv").write_bytes(b"film"), ["no photos", "f.mkv is a film in a container"]),
        (
            lambda path: save(path / "odm_dem/dsm.tif"),
            ["no photos in", "odm_dem is a folder of OpenDroneMap's products"],
        ),
        (lambda path: (path / "f.zip").write_bytes(b"PK"), ["no photos", "f.zip is an archive"]),
        (lambda path: (path / "x.jpg").write_text("hello"), ["None of the 1 pictures", "x.jpg", "no JPEG"]),
        (lambda path: save(path / "x.jpg"), ["only one usable photo", "x.jpg"]),
        (
            lambda path: (save(path / "x.jpg"), shutil.copy(path / "x.jpg", path / "y.jpg")),
            ["only one usable", "y.jpg is the same file as x.jpg"],
        ),
    ],
)
def test_too_few_photos_end_with_a_hint(tmp_path: Path, prepare: Callable[[Path], object], words: list[str]) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    prepare(photos)
    with pytest.raises(SplatpipeError) as caught:
        ingest(photos)
    assert caught.value.hint
    assert all(word in caught.value.message for word in words), caught.value.message


def test_parts_are_the_same_bits_elsewhere_and_with_more_threads(folder: Path, tmp_path: Path) -> None:
    bad_files(folder)
    write_png16(folder / "p.png", deep(3, 257.0))
    save(folder / "masks" / "a.png", 3)
    elsewhere = tmp_path / "some where" / "else"
    shutil.copytree(folder, elsewhere, symlinks=True, ignore=shutil.ignore_patterns("pipe*"))
    (folder / "pipe.jpg").unlink()
    first, second = ingest(folder, threads=1), ingest(elsewhere, threads=4, out="result")
    trees = [
        {path.relative_to(r.out).as_posix(): path.read_bytes() for path in r.out.rglob("*") if path.is_file()}
        for r in (first, second)
    ]
    assert trees[0] == trees[1]
    assert "photos/photos.json" in trees[0]
    assert "photos/masks/a.jpg.png" in trees[0]


def half_black(width: int, height: int) -> Image.Image:
    """Return a mask that is black in the left half of the stored image."""
    mask = np.full((height, width), 255, np.uint8)
    mask[:, : width // 2] = 0
    return Image.fromarray(mask)


def assert_left_half(mask: np.ndarray | None) -> None:
    assert mask is not None
    assert mask.shape == (HEIGHT, WIDTH)
    assert (mask[:, : WIDTH // 2] == 0).all()
    assert (mask[:, WIDTH // 2 :] == 255).all()


@pytest.mark.parametrize("place", ["photos/masks/a.png", "masks/a.png", "photos/masks/a.jpg.png", "masks/a.tif"])
@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (WIDTH // 2, HEIGHT // 2), (WIDTH * 2, HEIGHT * 2)])
def test_masks_are_found_by_name_and_brought_to_size(folder: Path, place: str, size: tuple[int, int]) -> None:
    path = folder.parent / place
    path.parent.mkdir()
    half_black(*size).save(path)
    result = ingest(folder)
    assert_left_half(result.mask("a.jpg"))
    assert result.mask("b.jpg") is None
    assert result.summary["masks"] == 1
    assert result.warnings == ["The focal length of 2 photos is unknown; it must be calibrated from scratch."]


def test_masks_of_inner_folders_are_found(folder: Path) -> None:
    save(folder / "one" / "x.jpg", 5)
    save(folder / "two" / "x.jpg", 6)
    (folder / "masks" / "one").mkdir(parents=True)
    (folder / "two" / "masks").mkdir()
    half_black(WIDTH, HEIGHT).save(folder / "masks" / "one" / "x.png")
    half_black(WIDTH, HEIGHT).save(folder / "two" / "masks" / "x.png")
    result = ingest(folder)
    assert_left_half(result.mask("one/x.jpg"))
    assert_left_half(result.mask("two/x.jpg"))


@pytest.mark.parametrize("orientation", [6, 8])
def test_masks_in_the_turned_grid_are_turned_back(folder: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[274] = orientation
    save(folder / "turned.jpg", 7, exif=exif)
    (folder / "masks").mkdir()
    turn = {6: Image.Transpose.ROTATE_270, 8: Image.Transpose.ROTATE_90}[orientation]
    half_black(WIDTH, HEIGHT).transpose(turn).save(folder / "masks" / "turned.png")
    assert_left_half(ingest(folder).mask("turned.jpg"))


def test_masks_with_the_photos_own_orientation_are_stored_ones(folder: Path) -> None:
    exif = Image.Exif()
    exif[274] = 6
    save(folder / "turned.jpg", 7, exif=exif)
    (folder / "masks").mkdir()
    half_black(WIDTH, HEIGHT).save(folder / "masks" / "turned.png", exif=exif)
    assert_left_half(ingest(folder).mask("turned.jpg"))


def test_masks_of_labels_and_of_sloppy_jpegs_work(folder: Path) -> None:
    (folder / "masks").mkdir()
    Image.fromarray(np.asarray(half_black(WIDTH, HEIGHT)) // 255).save(folder / "masks" / "a.png")
    half_black(WIDTH, HEIGHT).save(folder / "masks" / "b.jpg", quality=60)
    result = ingest(folder)
    assert_left_half(result.mask("a.jpg"))
    mask = result.mask("b.jpg")
    assert mask is not None
    assert np.mean(mask == 0) == pytest.approx(0.5, abs=0.01)


def test_masks_that_do_not_fit_are_named(folder: Path) -> None:
    (folder / "masks").mkdir()
    half_black(300, 300).save(folder / "masks" / "a.png")
    half_black(WIDTH, HEIGHT).save(folder / "masks" / "nobody.png")
    (folder / "masks" / "b.png").write_text("no mask")
    save(folder / "c.jpg", 3)
    (folder / "masks" / "c.png").touch()
    result = ingest(folder)
    assert result.summary["masks"] == 0
    assert any("masks/c.png is empty" in warning for warning in result.warnings)
    assert not any(str(folder.parent) in warning for warning in result.warnings)
    assert any("masks/a.png has another aspect ratio" in warning for warning in result.warnings)
    assert any("masks/nobody.png" in warning for warning in result.warnings)
    assert any("masks/b.png cannot be read" in warning for warning in result.warnings)


def test_masks_with_one_fault_are_named_together(folder: Path) -> None:
    (folder / "masks").mkdir()
    for name in ("a.png", "b.png"):
        half_black(300, 300).save(folder / "masks" / name)
    (warning,) = [warning for warning in ingest(folder).warnings if "mask" in warning]
    assert "masks/a.png, masks/b.png; each has another aspect ratio (300 × 300) than its photo" in warning


def test_masks_that_leave_nothing_are_reported(folder: Path) -> None:
    (folder / "masks").mkdir()
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(folder / "masks" / "a.png")
    result = ingest(folder)
    assert any("The mask of a.jpg hides almost the whole photo" in warning for warning in result.warnings)


def test_masks_beside_images_are_found_without_a_model(folder: Path) -> None:
    save(folder / "images" / "c.jpg", 3)
    save(folder / "images" / "a.jpg", 4)
    (folder / "masks").mkdir()
    for name in ("a.png", "c.jpg.png"):
        half_black(WIDTH, HEIGHT).save(folder / "masks" / name)
    result = ingest(folder)
    assert_left_half(result.mask("images/c.jpg"))
    assert_left_half(result.mask("a.jpg"))
    assert result.mask("images/a.jpg") is None  # the mask belongs to the other photo
    assert not any("mask" in warning for warning in result.warnings)


@pytest.mark.parametrize("place", ["photos/sky_masks/a.png", "sky_masks/a.jpg.png"])
def test_sky_masks_are_found_in_the_same_way_and_are_no_photos(folder: Path, place: str) -> None:
    path = folder.parent / place
    path.parent.mkdir()
    half_black(WIDTH, HEIGHT).save(path)
    result = ingest(folder)
    assert sorted(result.photos) == ["a.jpg", "b.jpg"]
    assert_left_half(decode_sky_mask(result.photos["a.jpg"], result.out / "photos"))
    assert decode_sky_mask(result.photos["b.jpg"], result.out / "photos") is None
    assert result.mask("a.jpg") is None
    assert (result.summary["masks"], result.summary["sky_masks"]) == (0, 1)
    assert ingest(folder, out="off", masks=False).summary["sky_masks"] == 0


def test_both_masks_of_a_photo_are_kept_apart_and_a_black_sky_mask_means_no_sky(folder: Path) -> None:
    for name in ("masks", "sky_masks"):
        (folder / name).mkdir()
    half_black(WIDTH, HEIGHT).save(folder / "masks" / "a.png")
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(folder / "sky_masks" / "a.png")
    result = ingest(folder)
    assert_left_half(result.mask("a.jpg"))
    sky = decode_sky_mask(result.photos["a.jpg"], result.out / "photos")
    assert sky is not None and not sky.any()
    assert not any("mask" in warning for warning in result.warnings)


def test_a_run_depends_on_masks_beside_the_photos(folder: Path) -> None:
    for name in ("masks", "sky_masks"):
        (folder.parent / name).mkdir()
        half_black(WIDTH, HEIGHT).save(folder.parent / name / "a.png")
    files = open_source(folder, folder.parent / "out").part_files["source.photos"]
    assert {"../masks/a.png", "../sky_masks/a.png", "a.jpg"} <= set(files)


def test_masks_can_be_switched_off(folder: Path) -> None:
    (folder / "masks").mkdir()
    half_black(WIDTH, HEIGHT).save(folder / "masks" / "a.png")
    assert ingest(folder, masks=False).mask("a.jpg") is None


def test_products_of_other_programs_and_earlier_runs_are_left_out_in_a_line(folder: Path) -> None:
    (folder / "images").mkdir()
    for name in ("a.jpg", "b.jpg"):
        (folder / name).rename(folder / "images" / name)
    for number, name in enumerate(("odm_orthophoto/odm_orthophoto.tif", "opensfm/undistorted/images/a.jpg.tif"), 5):
        save(folder / name, number)
    save(folder / "old run/stages/undistort-1/dataset/images/a.jpg", 7)
    (folder / "old run/stages/format.json").write_text("{}")
    result = ingest(folder)
    assert set(result.photos) == {"images/a.jpg", "images/b.jpg"}
    assert not any("uplicate" in warning or "same" in warning for warning in result.warnings)
    assert result.notes == [
        "Left out: odm_orthophoto, opensfm; each is a folder of OpenDroneMap's products.",
        "Left out: old run is a folder of splatpipe's products.",
    ]


def test_colmap_folder_is_looked_for_photos_in_images(tmp_path: Path) -> None:
    for name in ("a", "b"):
        save(tmp_path / "c" / "images" / f"{name}.jpg", ord(name))
    save(tmp_path / "c" / "preview.jpg", 3)
    (tmp_path / "c" / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "c" / "sparse" / "0" / "cameras.bin").write_bytes(b"")
    (tmp_path / "c" / "masks").mkdir()
    half_black(WIDTH, HEIGHT).save(tmp_path / "c" / "masks" / "a.jpg.png")
    result = ingest(tmp_path / "c")
    assert photo_root(tmp_path / "c") == tmp_path / "c" / "images"
    assert set(result.photos) == {"a.jpg", "b.jpg"}
    assert result.warnings == []
    assert_left_half(result.mask("a.jpg"))
    assert result.pixels("b.jpg").shape == (HEIGHT, WIDTH, 3)


def drone_exif(gps: dict[int, object] | None = None, detail: dict[int, object] | None = None) -> Image.Exif:
    exif = Image.Exif()
    exif[271], exif[272] = "DJI\0\0", "FC330\0"
    exif.get_ifd(0x8769).update(
        {0x920A: IFDRational(361, 100), 0xA405: 20, 0xA002: 4000, 0xA003: 3000} | (detail or {})
    )
    if gps is not None:
        exif.get_ifd(0x8825).update(gps)
    return exif


def gps_of(latitude: float, longitude: float, altitude: float) -> dict[int, object]:
    return {
        1: "N" if latitude >= 0 else "S",
        2: (abs(latitude), 0.0, 0.0),
        3: "E" if longitude >= 0 else "W",
        4: (abs(longitude), 0.0, 0.0),
        5: b"\0",
        6: altitude,
    }


def xmp_of(**values: object) -> bytes:
    attributes = " ".join(f'drone-dji:{name}="{value}"' for name, value in values.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {attributes}/></rdf:RDF></x:xmpmeta>'
    ).encode()


def test_positions_angles_and_sigmas_are_read(folder: Path) -> None:
    angles = {"GimbalYawDegree": "+45.0", "GimbalPitchDegree": "-89.9", "GimbalRollDegree": "+0.0"}
    rtk = {"RtkFlag": 50, "RtkStdLon": "0.011", "RtkStdLat": "0.013", "RtkStdHgt": "0.021"}
    save(folder / "plain.jpg", 3, exif=drone_exif(gps_of(46.5, -91.5, 198.5)))
    save(
        folder / "rtk.jpg",
        4,
        exif=drone_exif(gps_of(46.5, -91.5, 198.5)),
        xmp=xmp_of(RelativeAltitude="+39.80", FlightYawDegree="46", **angles, **rtk),
    )
    save(folder / "xmp.jpg", 5, xmp=xmp_of(GpsLatitude="46.5", GpsLongtitude="-91.5", AbsoluteAltitude="+200.5"))
    save(folder / "float.jpg", 6, exif=drone_exif(gps_of(46.5, -91.5, 198.5)), xmp=xmp_of(RtkFlag=34))
    result = ingest(folder)
    found = {str(record["name"]): record for record in result.json("positions.json")["positions"]}
    assert set(found) == {"plain.jpg", "rtk.jpg", "xmp.jpg", "float.jpg"}
    plain, exact = found["plain.jpg"], found["rtk.jpg"]
    assert (plain["latitude"], plain["longitude"], plain["altitude_m"]) == (46.5, -91.5, 198.5)
    assert (plain["sigma_horizontal_m"], plain["sigma_vertical_m"], plain["rtk"]) == (3.0, 5.0, None)
    assert (exact["sigma_horizontal_m"], exact["sigma_vertical_m"], exact["rtk"]) == (0.013, 0.021, "fixed")
    assert (exact["yaw_deg"], exact["pitch_deg"], exact["roll_deg"]) == (45.0, -89.9, 0.0)
    assert (exact["flight_yaw_deg"], exact["relative_altitude_m"]) == (46.0, 39.8)
    assert (found["xmp.jpg"]["altitude_m"], found["xmp.jpg"]["altitude_source"]) == (200.5, "xmp")
    assert (found["float.jpg"]["rtk"], found["float.jpg"]["sigma_horizontal_m"]) == ("float", 0.5)


def test_the_position_file_takes_precedence_and_says_so(folder: Path, tmp_path: Path) -> None:
    save(folder / "c.jpg", 3, exif=drone_exif(gps_of(46.5, -91.5, 198.5)))
    geo = tmp_path / "geo.txt"
    geo.write_text("EPSG:4326\na.jpg -91.5001 46.5001 199 0 0 0 0.02 0.03\nz.jpg -91.5 46.5 199\n")
    result = ingest(folder, geo=geo)
    found = {str(record["name"]): record for record in result.json("positions.json")["positions"]}
    assert (found["a.jpg"]["source"], found["c.jpg"]["source"]) == ("file", "exif")
    assert found["a.jpg"]["flight"] != found["c.jpg"]["flight"]
    assert (found["a.jpg"]["latitude"], found["a.jpg"]["sigma_horizontal_m"]) == (pytest.approx(46.5001), 0.02)
    assert (result.summary["position_sources"], result.summary["sigma_sources"]) == (
        ["exif", "file"],
        ["default", "file"],
    )
    assert any("missing, or names them twice: z.jpg" in warning for warning in result.warnings)
    assert any("does not name c.jpg" in warning for warning in result.warnings)


def test_a_file_in_another_zone_is_reported(folder: Path, tmp_path: Path) -> None:
    """46.5° N: a zone of UTM, 6°, is 459 km wide there."""
    for seed, name in enumerate("cde"):
        save(folder / f"{name}.jpg", seed + 3, exif=drone_exif(gps_of(46.5, -91.5, 198.5)))
    geo = tmp_path / "geo.txt"
    rows = "".join(f"{name}.jpg 615097.16 5150696.35 199\n" for name in "cde")  # coordinates of UTM zone 15, by PROJ
    for zone, is_reported in ((15, False), (16, True)):
        geo.write_text(f"EPSG:326{zone}\n{rows}")
        warnings = ingest(folder, geo=geo, out=f"out{zone}").warnings
        assert any("geo.txt places the photos 459." in warning for warning in warnings) == is_reported


def test_impossible_positions_are_left_out_and_named(folder: Path) -> None:
    save(folder / "zero.jpg", 3, exif=drone_exif(gps_of(0.0, 0.0, 0.0)))
    save(folder / "north.jpg", 4, exif=drone_exif(gps_of(91.0, 10.0, 0.0)))
    nothing = (IFDRational(0, 0), IFDRational(0, 0), IFDRational(0, 0))
    save(folder / "nan.jpg", 5, exif=drone_exif(gps_of(1.0, 1.0, 0.0) | {2: nothing}))
    save(folder / "void.jpg", 6, exif=drone_exif(gps_of(46.5, -91.5, 198.5) | {9: "V"}))
    save(folder / "high.jpg", 7, exif=drone_exif(gps_of(46.5, -91.5, 1e6)))
    result = ingest(folder)
    positions = result.json("positions.json")["positions"]
    assert [(record["name"], record["altitude_m"]) for record in positions] == [("high.jpg", None)]
    assert any("nan.jpg, north.jpg, zero.jpg" in warning for warning in result.warnings)
    assert len(result.photos) == 7


def test_altitudes_of_two_datums_are_reported(folder: Path) -> None:
    for seed, name in enumerate("cde"):
        exif = drone_exif(gps_of(46.5, -91.5, 198.5))
        save(folder / f"{name}.jpg", seed + 3, exif=exif, xmp=xmp_of(AbsoluteAltitude="165.5"))
    assert any("33.0 m" in warning for warning in ingest(folder).warnings)


def test_cameras_are_grouped_by_make_model_size_and_focal_length(folder: Path) -> None:
    save(folder / "c.jpg", 3, exif=drone_exif())
    save(folder / "d.jpg", 4, exif=drone_exif())
    save(folder / "e.jpg", 5, exif=drone_exif(detail={0x920A: IFDRational(5, 1)}))
    save(folder / "f.jpg", 6, (WIDTH, 225), exif=drone_exif())
    result = ingest(folder)
    cameras = {name: photo.camera for name, photo in result.photos.items()}
    assert cameras == {"a.jpg": 0, "b.jpg": 0, "c.jpg": 1, "d.jpg": 1, "e.jpg": 2, "f.jpg": 3}
    groups = result.json("cameras.json")["cameras"]
    assert (groups[0]["has_prior"], groups[0]["focal_px"]) == (False, 480.0)
    assert (groups[1]["make"], groups[1]["model_name"], groups[1]["has_prior"]) == ("DJI", "FC330", True)
    assert groups[1]["focal_px"] == pytest.approx(3.61 / 6.17 * WIDTH)
    assert groups[1]["params"] == [groups[1]["focal_px"], 200.0, 150.0, 0.0]


def test_dewarped_photos_are_another_camera_and_a_false_calibration_is_reported(folder: Path) -> None:
    for seed, (name, values) in enumerate(
        {
            "c.jpg": {"DewarpFlag": 0},
            "d.jpg": {"DewarpFlag": 1},
            "e.jpg": {},
            "f.jpg": {"CalibratedFocalLength": "3600"},
        }.items()
    ):
        save(folder / name, seed + 3, exif=drone_exif(), xmp=xmp_of(**values))
    result = ingest(folder)
    cameras = {name: photo.camera for name, photo in result.photos.items()}
    assert cameras["c.jpg"] == cameras["e.jpg"] == cameras["f.jpg"] != cameras["d.jpg"]
    assert any("calibrated focal length in f.jpg is far" in warning for warning in result.warnings)


DEWARP = "2018-03-13;2359.78,2353.17,-7.71,45.9,-0.069478,0.025681,-0.0000875619,-0.000306177,-0.0057628"


def test_a_dewarp_calibration_is_a_stated_lens_unless_the_drone_has_applied_it(folder: Path) -> None:
    for name, values in {"c.jpg": {"DewarpFlag": 0}, "d.jpg": {"DewarpFlag": 1}}.items():
        exif = drone_exif()
        save(folder / name, 3 + (name == "d.jpg"), exif=exif, xmp=xmp_of(DewarpData=DEWARP, **values))
    result = ingest(folder)
    lenses = result.json("lenses.json")["lenses"]
    photos, groups = result.photos, result.json("cameras.json")["cameras"]
    lens, group = lenses[photos["c.jpg"].camera], groups[photos["c.jpg"].camera]
    assert lenses[photos["a.jpg"].camera] is None and lenses[photos["d.jpg"].camera] is None
    assert (lens["model"], lens["source"], lens["width"], lens["height"]) == ("FULL_OPENCV", "xmp-dewarp", 400, 300)
    scale = group["focal_px"] / (0.5 * (2359.78 + 2353.17))
    assert lens["params"][:4] == pytest.approx(
        [scale * 2359.78, scale * 2353.17, 200 - scale * 7.71, 150 + scale * 45.9]
    )
    assert lens["params"][4:] == [-0.069478, 0.025681, -0.0000875619, -0.000306177, -0.0057628, 0.0, 0.0, 0.0]
    assert (group["focal_source"], group["has_prior"], group["model"]) == ("xmp-dewarp", True, "SIMPLE_RADIAL")


@pytest.mark.parametrize(
    "text", ["", "x", "2018;1,2,3", DEWARP.replace("2359.78", "nan"), DEWARP.replace("-7.71", "1e9")]
)
def test_a_broken_dewarp_calibration_is_ignored(folder: Path, text: str) -> None:
    save(folder / "c.jpg", 3, exif=drone_exif(), xmp=xmp_of(DewarpFlag=0, DewarpData=text))
    assert set(map(str, ingest(folder).json("lenses.json")["lenses"])) == {"None"}


def test_a_given_lens_is_scaled_to_the_photos_and_refused_for_others(folder: Path) -> None:
    path = folder.parent / "lens.txt"
    path.write_text("1 OPENCV 4000 3000 3600 3600 2010 1490 -0.1 0.02 0.001 -0.002\n")
    result = ingest(folder, lens=path)
    lens, group = (result.json(f"{name}.json")[name][0] for name in ("lenses", "cameras"))
    assert lens["params"] == [360.0, 360.0, 201.0, 149.0, -0.1, 0.02, 0.001, -0.002]
    assert (group["focal_px"], group["focal_source"]) == (360.0, "lens-file")
    path.write_text("1 OPENCV 4000 2000 3600 3600 2010 1000 -0.1 0.02 0.001 -0.002\n")
    with pytest.raises(SplatpipeError, match=r"4000 × 2000.*400 × 300"):
        ingest(folder, out="other", lens=path)
    path.write_text("1 PINHOLE 400 300 360 360 200 150\n2 PINHOLE 400 300 380 380 200 150\n")
    with pytest.raises(SplatpipeError, match="2 lenses"):
        ingest(folder, out="two", lens=path)


def test_a_given_lens_is_not_used_for_another_camera_of_the_same_shape(folder: Path) -> None:
    for seed, name in enumerate(("c.jpg", "d.jpg")):
        save(folder / name, 7 + seed, exif=drone_exif())
    path = folder.parent / "lens.txt"
    path.write_text("1 OPENCV 4000 3000 9000 9000 2010 1490 -0.1 0.02 0.001 -0.002\n")
    result = ingest(folder, lens=path)
    lenses, groups = result.json("lenses.json")["lenses"], result.json("cameras.json")["cameras"]
    drone, other = (result.photos[name].camera for name in ("c.jpg", "a.jpg"))
    assert lenses[drone] is None and groups[drone]["focal_source"] != "lens-file"
    assert lenses[other] is not None and groups[other]["focal_px"] == 900.0


CALIBRATED = {"drone-dji:CalibratedFocalLength": "2300.0"}
DRONE = Exif(make="DJI", model="FC330", focal_mm=3.61, focal_35mm=20.0, width=4000, height=3000)


@pytest.mark.parametrize(
    ("exif", "xmp", "size", "source", "focal"),
    [
        (DRONE, CALIBRATED, (4000, 3000), "xmp-calibrated", 2300.0),
        (DRONE, CALIBRATED, (2000, 1500), "xmp-calibrated", 1150.0),
        (DRONE, CALIBRATED, (1500, 2000), "xmp-calibrated", 1150.0),
        (DRONE, {"drone-dji:CalibratedFocalLength": "3.6"}, (4000, 3000), "sensor-table", 2340.4),
        (DRONE, {"drone-dji:CalibratedFocalLength": "3600"}, (4000, 3000), "sensor-table", 2340.4),
        (DRONE, {}, (2000, 1500), "sensor-table", 1170.2),
        (
            Exif(focal_mm=30.0, focal_plane_px_per_mm=191.5, width=4272, height=2848),
            {},
            (4272, 2848),
            "focal-plane-resolution",
            5745.0,
        ),
        (
            Exif(focal_mm=30.0, focal_plane_px_per_mm=191.5, width=4272, height=2848),
            {},
            (2136, 1424),
            "focal-plane-resolution-resized",
            2872.5,
        ),
        (
            Exif(focal_mm=30.0, focal_35mm=36.0, focal_plane_px_per_mm=100.0, width=600, height=400),
            {},
            (300, 200),
            "35mm-equivalent",
            300.0,
        ),
        (Exif(focal_35mm=35.0, width=2832, height=2128), {}, (2832, 2128), "35mm-equivalent", 2865.6),
        (Exif(focal_35mm=20.0, width=4000, height=2250), {}, (4000, 2250), "35mm-equivalent", 2311.2),
        (Exif(), {}, (2000, 1500), "guess", 2400.0),
        (Exif(focal_35mm=20.0, width=4000, height=3000), {}, (1000, 1000), "guess", 1200.0),  # cropped
        (Exif(focal_35mm=20.0), {}, (6000, 1000), "guess", 7200.0),  # stitched
        (Exif(focal_mm=5000.0, focal_plane_px_per_mm=1e5), {}, (2000, 1500), "guess", 2400.0),
    ],
)
def test_focal_length_is_taken_from_the_most_trusted_source(
    exif: Exif, xmp: dict[str, str], size: tuple[int, int], source: str, focal: float
) -> None:
    found = focal_prior(exif, xmp, *size)
    assert (found.source, found.has_prior) == (source, source != "guess")
    assert found.px == pytest.approx(focal, abs=0.1)


@pytest.mark.parametrize(("kind", "value"), [(2, "six"), (12, float("nan")), (3, 60_000)])
def test_tiffs_with_an_impossible_orientation_are_taken_as_stored(folder: Path, kind: int, value: object) -> None:
    tags = ImageFileDirectory_v2()
    tags.tagtype[274] = kind
    tags[274] = value
    Image.fromarray(picture(3)).save(folder / "odd.tif", tiffinfo=tags)
    result = ingest(folder)
    assert result.photos["odd.tif"].width == WIDTH
    assert (result.pixels("odd.tif") == picture(3)).all()


@pytest.mark.parametrize("count", [0, 2])
def test_tiffs_with_none_or_several_orientations_are_taken(folder: Path, count: int) -> None:
    Image.fromarray(picture(3)).save(folder / "odd.tif", tiffinfo={274: 6})
    data = (folder / "odd.tif").read_bytes()
    good = struct.pack("<HHIHH", 274, 3, 1, 6, 0)
    assert data.count(good) == 1
    (folder / "odd.tif").write_bytes(data.replace(good, struct.pack("<HHIHH", 274, 3, count, 6, 6)))
    result = ingest(folder)
    assert (result.pixels("odd.tif") == picture(3)).all()


def test_photos_with_odd_tags_are_accepted(folder: Path) -> None:
    """Pillow warns of such tags, and warnings are errors here."""
    tags = ImageFileDirectory_v2()
    tags[271] = "Acme"
    tags.tagtype[33550] = 12
    tags[33550] = (1.0, 2.0, 3.0)
    Image.fromarray(picture(3)).save(folder / "geo.tif", tiffinfo=tags)
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + struct.pack("<HHII", 271, 2, 2**31, 9)
    save(folder / "exif.jpg", 4, exif=exif)
    assert {"geo.tif", "exif.jpg"} < set(ingest(folder).photos)


def test_masks_beside_their_photos_are_used_and_are_no_photos(folder: Path) -> None:
    """As OpenDroneMap wants them."""
    half_black(WIDTH, HEIGHT).convert("RGB").save(folder / "a_mask.JPG", quality=90)
    half_black(WIDTH, HEIGHT).save(folder / "b.png")  # a mask by the photo's own name
    half_black(300, 300).save(folder / "b_mask.png")
    result = ingest(folder)
    assert list(result.photos) == ["a.jpg", "b.jpg"]
    mask = result.mask("a.jpg")
    assert mask is not None and np.mean(mask == 0) == pytest.approx(0.5, abs=0.01)
    assert result.left_out == {}
    assert any("b_mask.png has another aspect ratio" in warning for warning in result.warnings)
    assert ingest(folder, out="off", masks=False).summary["masks"] == 0


def test_a_mask_in_the_folder_of_masks_goes_before_one_beside_the_photo(folder: Path) -> None:
    (folder / "masks").mkdir()
    half_black(WIDTH, HEIGHT).save(folder / "masks" / "a_mask.png")
    Image.fromarray(np.full((HEIGHT, WIDTH), 255, np.uint8)).save(folder / "a_mask.png")
    result = ingest(folder)
    assert_left_half(result.mask("a.jpg"))
    assert not any("mask" in warning for warning in result.warnings)


def test_the_bands_of_a_shot_are_no_photos_of_their_own(folder: Path) -> None:
    for number, band in enumerate(("Green", "NIR"), 1):
        packet = f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><a Camera:BandName="{band}"/></x:xmpmeta>'
        tags = ImageFileDirectory_v2()
        tags[700] = packet.encode()
        for stem in "ab":
            Image.fromarray(deep(9 * number + ord(stem), 257.0)[..., 2]).save(
                folder / f"{stem}{number}.tif", tiffinfo=tags
            )
    result = ingest(folder)
    assert list(result.photos) == ["a.jpg", "b.jpg"]
    assert result.left_out["a2.tif"] == "shows the band near infrared, and colour is used"
    near = ingest(folder, out="near", bands="nir")
    assert list(near.photos) == ["a2.tif", "b2.tif"]
    assert all(photo.converted for photo in near.photos.values())
    assert len(ingest(folder, out="all", bands="all").photos) == 6
