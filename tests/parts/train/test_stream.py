"""Training photos: in order, to the bit, at the requested size, decoded once, and never all in memory."""

import resource
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.engine.errors import MachineError, StageError
from splatpipe.pipeline.geometry.camera import Camera, reduced_size
from splatpipe.pipeline.photos.pixels import mapped_file
from splatpipe.pipeline.photos.pixels.dataset import View, load_views
from splatpipe.pipeline.photos.pixels.images import load_colour, load_mask, reduced_camera, reduced_view
from splatpipe.pipeline.train.photos.stream import PhotoStream, TrainingPhoto
from splatpipe.pipeline.train.plan.training_order import PhotoOrder
from splatpipe.pipeline.train.plan.windows import TrainingSize

EPOCHS = 4
MASKED = "flight 1/photo_5.png"


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return tiny_scene.write_dataset(tmp_path / "dataset", masked=MASKED)


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    folder = tmp_path / "cache"
    folder.mkdir()
    return folder


def streamed(views: list[View], cache: Path, levels: list[int], first: int = 1, **size: float) -> list[TrainingPhoto]:
    with PhotoStream.over(views, [TrainingSize(level) for level in levels], 0, first, cache, **size) as photos:
        return list(photos)


def names(photos: list[TrainingPhoto]) -> list[str]:
    return [photo.camera.name for photo in photos]


def same(one: TrainingPhoto, other: TrainingPhoto) -> bool:
    masks = (one.mask, other.mask)
    if any(mask is None for mask in masks):
        return masks == (None, None) and torch.equal(one.colour, other.colour)
    return torch.equal(*masks) and torch.equal(one.colour, other.colour)


def test_every_epoch_shows_every_photo_once_in_an_order_of_its_own(dataset: Path, cache: Path) -> None:
    views = load_views(dataset)
    seen = names(streamed(views, cache, [0] * len(views) * EPOCHS))
    epochs = [tuple(seen[start : start + len(views)]) for start in range(0, len(seen), len(views))]
    assert all(sorted(epoch) == [view.camera.name for view in views] for epoch in epochs)
    assert len(set(epochs)) == EPOCHS


def test_photo_of_an_iteration_does_not_depend_on_where_the_stream_began(dataset: Path, cache: Path) -> None:
    views = load_views(dataset)
    levels = [1] * 20 + [0] * 10
    whole = streamed(views, cache, levels)
    for first in (2, 15, 30):
        later = streamed(views, cache, levels, first)
        assert names(later) == names(whole[first - 1 :])
        assert all(same(one, other) for one, other in zip(later, whole[first - 1 :], strict=True))
    assert streamed(views, cache, levels, 31) == []


def test_photos_and_masks_are_those_of_the_dataset_to_the_bit_also_from_the_cache(dataset: Path, cache: Path) -> None:
    views = {view.camera.name: view for view in load_views(dataset)}
    photos = streamed(list(views.values()), cache, [0] * len(views) * EPOCHS)
    for photo in photos:
        view = views[photo.camera.name]
        expected = load_colour(view).astype(np.float32) * np.float32(1.0 / 255.0)
        assert photo.camera is view.camera and np.array_equal(photo.colour.numpy(), expected)
        mask = load_mask(view)
        assert (photo.mask is None) == (mask is None)
        assert mask is None or np.array_equal(photo.mask.numpy(), mask)
    assert sum(photo.mask is not None for photo in photos) == EPOCHS


@pytest.mark.parametrize(("megapixels", "level"), [(None, 1), (None, 3), (0.002, 0), (0.002, 1), (1.0, 0), (1.0, 2)])
def test_photos_have_the_size_asked_for_and_its_camera(
    dataset: Path, cache: Path, megapixels: float | None, level: int
) -> None:
    views = {view.camera.name: view for view in load_views(dataset)}
    width, height = (tiny_scene.WIDTH, tiny_scene.HEIGHT) if megapixels != 0.002 else (51, 38)
    width, height = width >> level, height >> level
    for photo in streamed(list(views.values()), cache, [level] * 2 * len(views), max_megapixels=megapixels):
        full = views[photo.camera.name].camera
        assert (photo.camera.width, photo.camera.height) == (width, height) == tuple(photo.colour.shape[1::-1])
        assert photo.camera.fx == full.fx * (width / full.width) and photo.camera.cy == full.cy * (height / full.height)
        camera, colour, mask = reduced_view(views[photo.camera.name], megapixels, level)
        assert camera.fx == photo.camera.fx
        assert np.array_equal(photo.colour.numpy(), colour.astype(np.float32) * np.float32(1.0 / 255.0))
        assert (mask is None) == (photo.mask is None) and (mask is None or np.array_equal(photo.mask.numpy(), mask))


def test_reduced_pixel_is_the_mean_of_its_source_pixels(dataset: Path) -> None:
    view = load_views(dataset)[0]
    full = load_colour(view).astype(float)
    _, half, _ = reduced_view(view, None, 1)
    means = full.reshape(tiny_scene.HEIGHT // 2, 2, tiny_scene.WIDTH // 2, 2, 3).mean(axis=(1, 3))
    assert np.abs(half - means).max() <= 0.5


def test_reduced_size_is_the_largest_within_the_limit_that_undistort_would_choose() -> None:
    assert reduced_size(1000, 800, 0.8) == (1000, 800)
    for width, height, limit in ((1000, 800, 0.5), (4000, 3000, 0.4), (5472, 3648, 1.6), (33, 100_000, 0.01)):
        found = reduced_size(width, height, limit)
        assert found[0] * found[1] <= limit * 1e6 < (found[0] + 1) * (found[1] + 1)
        assert reduced_size(*found, limit) == found
    assert reduced_size(100_000, 1, 0.01) == (31_622, 1)  # no side vanishes


@pytest.mark.parametrize(
    ("width", "height", "megapixels"),
    [(72, 54, 0.0035), (72, 54, 0.0021), (72, 54, 0.0007), (1100, 825, 0.7986)],  # the last: weights of 0.999 in sum
)
def test_reduced_mask_loses_the_pixels_that_a_masked_one_touches_and_no_others(
    tmp_path: Path, width: int, height: int, megapixels: float
) -> None:
    camera = Camera("photo", width, height, 50.0, 50.0, width / 2, height / 2, np.eye(4))
    view = View(camera, tmp_path / "photo.png", tmp_path / "mask.png")
    cv2.imwrite(str(tmp_path / "photo.png"), np.zeros((height, width, 3), np.uint8))
    size = reduced_camera(camera, megapixels)
    assert size.width < width
    for hole in (None, (0, 0), (30, 41), (height - 1, width - 1)):
        mask = np.full((height, width), 255, np.uint8)
        expected = np.ones((size.height, size.width), bool)
        if hole is not None:
            mask[hole] = 0
            rows, columns = touched(hole[0], height, size.height), touched(hole[1], width, size.width)
            expected[np.ix_(rows, columns)] = False
        cv2.imwrite(str(tmp_path / "mask.png"), mask)
        assert np.array_equal(reduced_view(view, megapixels)[2], expected)


def touched(place: int, full: int, reduced: int) -> npt.NDArray[np.bool_]:
    """Return the pixels of a reduced row that overlap pixel ``place`` of the full one; OpenCV ignores 0.001 px."""
    edges = np.arange(reduced + 1) * (full / reduced)
    return (edges[1:] > place + 1e-3) & (edges[:-1] < place + 1 - 1e-3)


def test_photos_are_decoded_once_and_the_files_are_not_needed_again(dataset: Path, cache: Path) -> None:
    views = load_views(dataset)
    levels = [1] * len(views) + [0] * len(views)
    with PhotoStream.over(views, [TrainingSize(level) for level in levels * 2], 0, 1, cache) as photos:
        first = [next(photos) for _ in levels]
        next_ones = [next(photos)]
        shutil.rmtree(dataset)
        next_ones += list(photos)
    again = {(photo.camera.name, photo.camera.width): photo for photo in next_ones}
    assert len(first) == len(next_ones) == len(again)
    assert all(same(photo, again[photo.camera.name, photo.camera.width]) for photo in first)


@pytest.mark.parametrize("begun", [1, 12])
def test_a_stream_continued_with_another_sequence_equals_one_begun_with_it(
    dataset: Path, cache: Path, begun: int
) -> None:
    views = load_views(dataset)
    planned, later = [2] * 20 + [1] * 20, [2] * 12 + [1] * 5 + [0] * 13
    expected = streamed(views, cache, later)
    with PhotoStream.over(views, [TrainingSize(level) for level in planned], 0, begun, cache) as photos:
        photos.fill(tiny_scene.Recorder())
        seen = [next(photos) for _ in range(begun, 13)]
        photos.switch_order(
            PhotoOrder([view.camera for view in views], [TrainingSize(level) for level in later], 0), 13
        )
        seen += photos
    assert len(seen) == len(expected[begun - 1 :])
    assert all(same(one, other) for one, other in zip(seen, expected[begun - 1 :], strict=True))


def test_cache_has_no_name_and_the_thread_ends_with_the_stream(dataset: Path, cache: Path) -> None:
    views = load_views(dataset)
    with PhotoStream.over(views, [TrainingSize()] * 40, 0, 1, cache) as photos:
        for _ in range(20):
            next(photos)
            assert not list(cache.iterdir())
    with pytest.raises(KeyboardInterrupt), PhotoStream.over(views, [TrainingSize()] * 40, 0, 1, cache) as photos:
        next(photos)
        raise KeyboardInterrupt
    assert not list(cache.iterdir())
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("photos")]


@pytest.mark.parametrize("damage", ["missing", "empty", "no picture", "other size", "mask"])
def test_damaged_photo_is_named_by_the_stream(dataset: Path, cache: Path, damage: str) -> None:
    victim = dataset / "images" / MASKED
    if damage == "missing":
        victim.unlink()
    elif damage == "mask":
        (dataset / "masks" / f"{MASKED}.png").write_bytes(b"")
    elif damage == "other size":
        cv2.imwrite(str(victim), np.zeros((5, 7, 3), np.uint8))
    else:
        victim.write_bytes(b"" if damage == "empty" else b"not a picture")
    with pytest.raises(StageError, match=r"photo_5\.png"):
        streamed(load_views(dataset), cache, [0] * 30)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("photos")]


def test_memory_does_not_grow_with_the_number_of_photos(tmp_path: Path) -> None:
    width, height, few, many = 640, 480, 8, 160
    picture = tmp_path / "photo.png"
    cv2.imwrite(str(picture), np.full((height, width, 3), 128, np.uint8))
    program = Path(__file__).with_name("streamed_memory.py")
    command = [sys.executable, str(program), str(picture), str(tmp_path), str(few), str(many), "3"]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    of_few, of_many = map(int, output.split())
    more_bytes = 3 * width * height * (many - few)
    assert more_bytes > 140e6
    assert of_many - of_few < 0.2 * more_bytes  # allocators may keep some; in memory they would take all of it


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Let the system refuse to write files larger than ``size`` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_full_disk_is_reported_with_what_to_do(dataset: Path, cache: Path) -> None:
    with pytest.raises(MachineError, match="decoded photos cannot be kept") as failure, largest_file(30_000):
        streamed(load_views(dataset), cache, [0] * 30)
    assert "Free some space" in failure.value.hint
    with pytest.raises(MachineError, match="No such file"):
        PhotoStream.over([], [], 0, 1, cache / "gone")


def test_photos_that_do_not_fit_on_the_disk_are_decoded_again_with_a_note(
    dataset: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = load_views(dataset)
    usual = streamed(views, cache, [0] * 30)
    free = shutil.disk_usage(cache).free
    for room, warnings in ((30_000, 1), (0, 1), (1 << 20, 0)):
        monkeypatch.setattr(mapped_file, "SHARE_OF_FREE", room / free)
        recorder = tiny_scene.Recorder()
        with PhotoStream.over(views, [TrainingSize()] * 30, 0, 1, cache) as photos:
            photos.warn_if_disk_full(recorder)
            assert all(same(one, other) for one, other in zip(photos, usual, strict=True))
        assert len(recorder.warnings) == warnings


def test_photos_needed_once_are_not_stored(dataset: Path, cache: Path) -> None:
    views = load_views(dataset)
    with PhotoStream.over(views, [TrainingSize()] * len(views), 0, 1, cache) as photos:
        assert photos.wanted_bytes() == 0
    with PhotoStream.over(
        views, [TrainingSize(1)] * len(views) + [TrainingSize()] * (len(views) + 2), 0, 1, cache
    ) as photos:
        pages = -(-3 * tiny_scene.WIDTH * tiny_scene.HEIGHT // 4096) * 4096
        half = -(-3 * tiny_scene.WIDTH * tiny_scene.HEIGHT // 4 // 4096) * 4096
        unmasked, masked = len(views) - 1, 2 * 4096  # one more byte a pixel with a mask
        all_levels = (unmasked + 1) * (pages + half)
        assert all_levels <= photos.wanted_bytes() <= all_levels + masked
