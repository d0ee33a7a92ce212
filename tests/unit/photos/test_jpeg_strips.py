"""JPEGs written strip by strip: any reader decodes the pixels of one encoded in one piece."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from splatpipe.pipeline.photos.pixels import jpeg_strips, resampling
from splatpipe.pipeline.photos.pixels.jpeg_strips import OPTIONS, write_jpeg
from splatpipe.pipeline.photos.pixels.resampling import resample, resampled_strips


def picture(height: int, width: int) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    noise = np.random.default_rng(2).normal(0.0, 20.0, (height, width, 3))
    return np.clip(np.stack([x * 200.0 / width, y * 200.0 / height, (x + y) % 90], axis=2) + noise, 0, 255).astype(
        np.uint8
    )


def cut(pixels: np.ndarray, heights: list[int]) -> Iterator[np.ndarray]:
    top, number = 0, 0
    while top < len(pixels):
        yield pixels[top : top + heights[number % len(heights)]]
        top, number = top + heights[number % len(heights)], number + 1


def in_one_piece(pixels: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".jpg", pixels, list(OPTIONS))[1])


@pytest.mark.parametrize(
    ("height", "width", "heights"), [(256, 64, [7]), (333, 61, [50, 3, 1]), (40, 96, [400]), (409, 8, [24])]
)
def test_the_pixels_are_those_of_one_piece(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, height: int, width: int, heights: list[int]
) -> None:
    monkeypatch.setattr(jpeg_strips, "STRIP_PIXELS", 24 * width)  # 14 strips and more: markers begin again after eight
    pixels = picture(height, width)
    write_jpeg(tmp_path / "strips.jpg", cut(pixels, heights), height)
    (tmp_path / "whole.jpg").write_bytes(in_one_piece(pixels))
    readers = (cv2.imread, lambda path: np.array(Image.open(path)))
    for read in readers:
        np.testing.assert_array_equal(*(read(str(tmp_path / name)) for name in ("strips.jpg", "whole.jpg")))
    assert (tmp_path / "strips.jpg").read_bytes() != (tmp_path / "whole.jpg").read_bytes()


def test_a_picture_of_one_strip_is_a_plain_file(tmp_path: Path) -> None:
    pixels = picture(123, 77)
    write_jpeg(tmp_path / "strips.jpg", cut(pixels, [10]), len(pixels))
    assert (tmp_path / "strips.jpg").read_bytes() == in_one_piece(pixels)


@dataclass
class WatchedPhoto:
    """A photo that records requests."""

    pixels: np.ndarray
    asked: list[int] = field(default_factory=list)

    def rows(self, top: int, bottom: int) -> np.ndarray:
        self.asked.append(bottom - top)
        return self.pixels[top:bottom]


def pinhole(width: int, height: int) -> pycolmap.Camera:
    camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[380, 380, width / 2, height / 2])
    camera.camera_id = 1
    return camera


@pytest.mark.parametrize("side", [400, 120])
def test_resampled_strips_read_few_rows_and_have_the_same_bits(monkeypatch: pytest.MonkeyPatch, side: int) -> None:
    """One sample per pixel, and sixteen; barrel distortion bends the rows."""
    source = pycolmap.Camera(model="SIMPLE_RADIAL", width=400, height=400, params=[380, 200, 200, -0.05])
    target = pinhole(400, 400)
    target.rescale(side, side)
    photo = WatchedPhoto(picture(400, 400))
    whole = resample(photo.pixels, source, target)
    monkeypatch.setattr(resampling, "SINGLE_PIXELS", 8 * side)
    monkeypatch.setattr(resampling, "PROJECTED", 3 * side)
    if side == 120:  # strips of several samples are cut where they always were: the maps are stretched by strips
        monkeypatch.setattr(resampling, "STRIP_PIXELS", 1 << 21)
    strips = list(resampled_strips(photo.rows, source, target))
    np.testing.assert_array_equal(np.concatenate(strips), whole)
    if side == 400:
        assert len(strips) == 50 and max(photo.asked) < 40
