"""Photos reduced for viewing: the same images as an area filter over all their pixels, at a fraction of the cost."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.photos.pixels.images import reduced_view
from splatpipe.pipeline.photos.pixels.small_views import read_small, small_view

WIDTH, HEIGHT = 1603, 1205  # nothing divides them


def view_of(folder: Path, pixels: np.ndarray, suffix: str = ".jpg", mask: np.ndarray | None = None) -> View:
    path = folder / f"photo{suffix}"
    cv2.imwrite(str(path), pixels[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 97])
    mask_path = None if mask is None else folder / "mask.png"
    if mask_path is not None:
        cv2.imwrite(str(mask_path), np.where(mask, 255, 0).astype(np.uint8))
    height, width = pixels.shape[:2]
    camera = Camera(path.name, width, height, 1000.0, 1000.0, width / 2, height / 2, np.eye(4))
    return View(camera, path, mask_path)


def textured(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Bumps of some ten pixels and noise, in three colours."""
    y, x = np.mgrid[:height, :width]
    bumps = [np.sin(x / period) * np.cos(y / (period + 3)) for period in (9.0, 14.0, 23.0)]
    noise = np.random.default_rng(4).normal(0.0, 12.0, (height, width, 3))
    return np.clip(128 + 80 * np.stack(bumps, axis=2) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("megapixels", "factor"), [(0.1, 2), (0.02, 4), (0.006, 8)])
def test_a_large_jpeg_is_decoded_small_and_shows_the_same(tmp_path: Path, megapixels: float, factor: int) -> None:
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:100, 300:] = False
    view = view_of(tmp_path, textured(), mask=mask)
    camera, pixels, counts = small_view(view, megapixels)
    expected_camera, expected, expected_counts = reduced_view(view, megapixels)
    size = (view.camera.width, view.camera.height)
    assert read_small(view.image_path, size, (camera.width, camera.height))[0] == factor
    assert camera == expected_camera and pixels.shape == expected.shape
    assert counts is not None and np.array_equal(counts, expected_counts)
    # Rounding of the small decode, and the frequencies that the blocks' own filter lets through.
    difference = pixels.astype(float) - expected
    assert np.abs(difference).mean() < 1.5 and np.abs(difference).max() < 12.0


def test_nothing_is_shifted_where_the_size_is_no_multiple(tmp_path: Path) -> None:
    ramp = np.broadcast_to((np.arange(WIDTH) * 250.0 / WIDTH)[None, :, None], (HEIGHT, WIDTH, 3)).astype(np.uint8)
    camera, pixels, _ = small_view(view_of(tmp_path, ramp), 0.006)
    centres = (np.arange(camera.width) + 0.5) * 250.0 / camera.width - 0.5  # rounded down on the way
    np.testing.assert_allclose(pixels[5, :, 0], centres, atol=1.0)  # a pixel is 2.8 wide


@pytest.mark.parametrize(("suffix", "megapixels"), [(".jpg", 0.3), (".jpg", 5.0), (".png", 0.006)])
def test_other_formats_are_decoded_completely_with_the_same_bits(
    tmp_path: Path, suffix: str, megapixels: float
) -> None:
    view = view_of(tmp_path, textured(), suffix)
    camera, pixels, mask = small_view(view, megapixels)
    expected = reduced_view(view, megapixels)
    assert camera == expected[0] and mask is None
    np.testing.assert_array_equal(pixels, expected[1])


def test_a_photos_format_is_that_of_its_content_not_its_name(tmp_path: Path) -> None:
    view = view_of(tmp_path, textured(), ".png")
    named = View(view.camera, view.image_path.rename(tmp_path / "photo.JPG"), None)
    np.testing.assert_array_equal(small_view(named, 0.02)[1], reduced_view(named, 0.02)[1])


def test_a_photo_of_another_size_than_its_camera_is_refused(tmp_path: Path) -> None:
    view = view_of(tmp_path, textured())
    cv2.imwrite(str(view.image_path), textured(800, 600))
    with pytest.raises(StageError, match="1603×1205") as raised:
        small_view(view, 0.02)
    assert raised.value.hint
