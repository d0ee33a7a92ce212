"""Files that other programs put beside photos are told from photos, by name and by pixels."""

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpipe.pipeline.photos.files.companions import DEPTH, MASK, PREVIEW, find_companions
from splatpipe.pipeline.photos.files.scan import Candidate, ExcludedPhoto, scan_folder, with_reason
from splatpipe.pipeline.photos.intake.check import CheckedPhoto, PictureLimits, check_photo
from splatpipe.pipeline.photos.intake.duplicates import split_maps

LIMITS = PictureLimits(min_side=320, max_pixels=10_000_000)


def save(path: Path, pixels: np.ndarray, **options: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)


def noise(seed: int, width: int = 400, height: int = 300) -> np.ndarray:
    return np.random.default_rng(seed).integers(20, 230, (height, width, 3), np.uint8)


def check(folder: Path, name: str) -> CheckedPhoto:
    photo = check_photo(Candidate(name, folder / name), LIMITS)
    assert isinstance(photo, CheckedPhoto)
    return photo


@pytest.mark.parametrize(
    ("name", "kind", "owner"),
    [
        ("DJI_0017_mask.JPG", MASK, "DJI_0017.JPG"),  # OpenDroneMap
        ("dji_0017_MASK.png", MASK, "DJI_0017.JPG"),
        ("DJI_0017.JPG.mask.png", MASK, "DJI_0017.JPG"),  # RealityCapture
        ("mask_DJI_0017.png", MASK, "DJI_0017.JPG"),
        ("mask/DJI_0017.png", MASK, "DJI_0017.JPG"),
        ("thumbnails/DJI_0017.JPG", PREVIEW, "DJI_0017.JPG"),
        ("thumbs/DJI_0017.JPG.jpg", PREVIEW, "DJI_0017.JPG"),
        ("DJI_0017_preview.jpg", PREVIEW, "DJI_0017.JPG"),
        ("DJI_0017.THM", PREVIEW, ""),
        ("DJI_0017_depth.tif", DEPTH, "DJI_0017.JPG"),
        ("depth/DJI_0017.png", DEPTH, "DJI_0017.JPG"),
        ("depth_0003.png", DEPTH, "rgb_0003.png"),
        ("images_4/x.png", PREVIEW, "images/x.png"),
        ("scan/depth/7.png", DEPTH, "scan/rgb/7.jpg"),
    ],
)
def test_companions_are_told_by_their_names(name: str, kind: str, owner: str) -> None:
    photos = ["DJI_0017.JPG", "rgb_0003.png", "images/x.png", "scan/rgb/7.jpg", "other/y.jpg"]
    found = find_companions([*photos, name])
    assert list(found) == [name]
    assert (found[name].kind, found[name].owner) == (kind, owner)


@pytest.mark.parametrize(
    "name",
    ["mask.jpg", "roof_mask.jpg", "depth/a.jpg", "preview/deep/b.jpg", "x/DJI_0017_mask.JPG", "DJI_0017 copy.JPG"],
)
def test_photos_of_such_names_without_another_are_photos(name: str) -> None:
    assert find_companions(["DJI_0017.JPG", "roof.jpg.txt", name]) == {}


def test_a_scan_tells_masks_previews_and_raw_files_from_photos(tmp_path: Path) -> None:
    for name in ("a.JPG", "b.jpg", "a_mask.JPG", "depth/a.png", "a.thm", "._a.JPG"):
        save(tmp_path / name, noise(1), format="PNG" if name.endswith("png") else "JPEG")
    (tmp_path / "a.DNG").write_bytes(b"II*\0" + bytes(60))
    (tmp_path / "alone.cr2").write_bytes(b"II*\0" + bytes(60))
    (tmp_path / "b.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(50))
    (tmp_path / "film.LRV").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(50))
    (tmp_path / "old.bmp").write_bytes(b"BM" + bytes(60))
    scan = scan_folder(tmp_path)
    assert [candidate.name for candidate in scan.candidates] == ["a.JPG", "b.jpg"]
    assert [(mask.name, mask.owner) for mask in scan.masks] == [("a_mask.JPG", "a.JPG")]
    assert scan.left_out == (
        ExcludedPhoto("a.DNG", "is another format of a photo that is used", "companion"),
        ExcludedPhoto("a.thm", "is a preview that a camera wrote", "companion"),
        ExcludedPhoto("alone.cr2", "is a camera's raw file: develop it to JPEG or TIFF"),
        ExcludedPhoto("b.heic", "is another format of a photo that is used", "companion"),
        ExcludedPhoto("depth/a.png", "is a depth map of another photo", "companion"),
        ExcludedPhoto("old.bmp", "is a BMP picture, which is not supported: convert it to JPEG or PNG"),
    )
    assert scan.others == 1


def test_masks_and_depth_maps_of_the_photos_name_are_told_by_their_pixels(tmp_path: Path) -> None:
    black = np.full((300, 400), 255, np.uint8)
    black[:, :90] = 0
    for stem in ("a", "b", "c"):
        save(tmp_path / f"{stem}.jpg", noise(ord(stem)))
    save(tmp_path / "a.png", black)
    save(tmp_path / "b.png", np.arange(120_000, dtype=np.uint16).reshape(300, 400) // 2)
    save(tmp_path / "c.png", noise(7))  # another photo
    save(tmp_path / "d.png", black)  # without a photo: whatever it is, it is not a mask of one
    photos, maps, masks = split_maps([check(tmp_path, path.name) for path in sorted(tmp_path.iterdir())])
    assert [photo.name for photo in photos] == ["a.jpg", "b.jpg", "c.jpg", "c.png", "d.png"]
    assert [entry.name for entry in maps] == ["b.png"]
    assert [(mask.name, mask.owner) for mask in masks] == [("a.png", "a.jpg")]


def test_panoramas_without_metadata_and_maps_are_no_photos(tmp_path: Path) -> None:
    save(tmp_path / "PANO_0001.jpg", noise(1, 800, 400))
    save(tmp_path / "PANO_0002.jpg", noise(2))  # a tile
    save(tmp_path / "panorama road.jpg", noise(3, 700, 400))
    save(
        tmp_path / "odm_orthophoto.tif",
        noise(4),
        tiffinfo={33550: (0.1, 0.1, 0.0), 34735: struct.unpack("4H", bytes(8))},
    )
    found = {path.name: check_photo(Candidate(path.name, path), LIMITS) for path in tmp_path.iterdir()}
    assert {name for name, photo in found.items() if isinstance(photo, CheckedPhoto)} == {
        "PANO_0002.jpg",
        "panorama road.jpg",
    }
    map_ = found["odm_orthophoto.tif"]
    assert isinstance(map_, ExcludedPhoto) and "map (GeoTIFF)" in map_.reason


def test_a_reason_is_a_sentence_for_one_photo_and_for_many() -> None:
    assert with_reason(["x.JPG"], "is truncated") == "x.JPG is truncated"
    assert with_reason(["x.JPG", "y.JPG"], "is truncated") == "x.JPG, y.JPG; each is truncated"
