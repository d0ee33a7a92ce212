"""Decoded photos in a file: each is decoded once, and nothing remains afterwards."""

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from house_site import photo_camera

from splatpipe.pipeline.surface.depths.photo_samples import DistortionGrid, PhotoSource
from splatpipe.pipeline.surface.depths.pixel_file import pixels_on_disk

CAMERA = photo_camera("photo", (0.0, 0.0, 20.0), (0.0, 0.0, 0.0))


def photos(decoded: Counter[int]) -> tuple[list[PhotoSource], list[np.ndarray]]:
    """Three photos whose decodings are counted; the last one is larger than its pinhole."""
    random = np.random.default_rng(1)
    lens = DistortionGrid(301, 199, 120.0, np.zeros((3, 3, 2)))
    pixels = [random.integers(0, 256, (h, w, 3)).astype(np.uint8) for h, w in ((180, 240), (180, 240), (199, 301))]

    def source(number: int) -> PhotoSource:
        def load() -> np.ndarray:
            decoded[number] += 1
            return pixels[number]

        return PhotoSource(CAMERA, load, None, lens if number == 2 else None)

    return [source(number) for number in range(3)], pixels


def test_a_photo_is_decoded_once_and_its_pixels_outlive_the_file(tmp_path: Path) -> None:
    decoded: Counter[int] = Counter()
    sources, pixels = photos(decoded)
    with pixels_on_disk(sources, tmp_path, held_bytes=1000) as mapped:
        assert not decoded
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(lambda k: mapped[k % 3].load(), range(24)))
        assert decoded == Counter({0: 1, 1: 1, 2: 1})
        assert [each.camera for each in mapped] == [each.camera for each in sources]
    for k, each in enumerate(found):
        assert np.array_equal(each, pixels[k % 3])
        assert not each.flags.writeable
    assert list(tmp_path.iterdir()) == []


def test_photos_in_memory_are_unchanged(tmp_path: Path) -> None:
    decoded: Counter[int] = Counter()
    sources, _ = photos(decoded)
    with pixels_on_disk(sources, tmp_path, held_bytes=1 << 20) as mapped:
        assert mapped == sources
    with pixels_on_disk([], tmp_path, held_bytes=0) as none:
        assert none == []


def test_photos_without_disk_space_are_not_stored(tmp_path: Path) -> None:
    vast = PhotoSource(
        CAMERA, lambda: np.zeros((0, 0, 3), np.uint8), None, DistortionGrid(1 << 30, 1 << 30, 8.0, np.zeros((2, 2, 2)))
    )
    with pixels_on_disk([vast], tmp_path, held_bytes=1000) as mapped:
        assert mapped == [vast]


def test_a_photo_that_fails_is_tried_again(tmp_path: Path) -> None:
    decoded: Counter[int] = Counter()
    sources, _ = photos(decoded)
    broken = PhotoSource(CAMERA, lambda: np.zeros((4, 4, 3), np.uint8), None)
    with pixels_on_disk([broken, *sources], tmp_path, held_bytes=1000) as mapped:
        for _ in range(2):
            with pytest.raises(ValueError, match="pixels of"):
                mapped[0].load()
