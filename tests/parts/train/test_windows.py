"""Windows of photos: parts of the photo, each used equally often, that together add up to the whole."""

import subprocess
import sys
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_scene
import torch

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View, load_views
from splatpipe.pipeline.splat.quality.metrics import SSIM_WINDOW
from splatpipe.pipeline.splat.sky.panorama import STEP_PX
from splatpipe.pipeline.train.photos.stream import PhotoStream, TrainingPhoto
from splatpipe.pipeline.train.plan import windows
from splatpipe.pipeline.train.plan.training_order import PhotoOrder, TrainingOrder, WindowOrder
from splatpipe.pipeline.train.plan.windows import PixelRectangle, TrainingSize, windows_of

MASKED = "flight 1/photo_5.png"
PIXELS = 800  # size of a window: six in a tiny photo
SIZES = [(5472, 3648, 500_000), (5472, 3648, 1_000_000), (2300, 1740, 500_000), (3000, 4000, 700_000), (72, 54, 800)]


@pytest.fixture
def views(tmp_path: Path) -> list[View]:
    return load_views(tiny_scene.write_dataset(tmp_path / "dataset", masked=MASKED))


def streamed(
    views: list[View], cache: Path, sizes: list[TrainingSize], first: int = 1, fill: bool = False
) -> list[TrainingPhoto]:
    with PhotoStream.over(views, sizes, 0, first, cache) as photos:
        if fill:
            photos.fill(tiny_scene.Recorder())
        return list(photos)


def same(one: torch.Tensor | None, other: torch.Tensor | None) -> bool:
    return one is other is None or (one is not None and other is not None and torch.equal(one, other))


@pytest.mark.parametrize(("width", "height", "pixels"), SIZES)
def test_windows_are_nearly_equal_cells_that_cover_the_picture_once(width: int, height: int, pixels: int) -> None:
    found = windows_of(width, height, pixels)
    covered = np.zeros((height, width), np.uint8)
    for window in found:
        covered[window.top : window.bottom, window.left : window.right] += 1
    assert (covered == 1).all()
    sizes = [window.pixels for window in found]
    assert max(sizes) <= pixels and len(found) <= np.ceil(1.35 * width * height / pixels)
    slack = 2 * windows.NODES_PX  # borders are moved to nodes
    for sides in ([window.width for window in found], [window.height for window in found]):
        assert max(sides) - min(sides) <= slack
    window = found[0]
    assert max(window.width / window.height, window.height / window.width) < windows.MAX_OBLONG + 0.2


def test_a_window_grown_by_ssims_reach_begins_on_a_node_of_the_sky() -> None:
    assert SSIM_WINDOW // 2 == windows.REACH_PX and windows.NODES_PX == STEP_PX
    for window in windows_of(1000, 700, 90_000):
        cut = window.grown(1000, 700)
        assert cut.left % STEP_PX == 0 == cut.top % STEP_PX
        assert (window.left - cut.left, cut.right - window.right) == (5 * (window.left > 0), 5 * (window.right < 1000))
        assert (window.top - cut.top, cut.bottom - window.bottom) == (5 * (window.top > 0), 5 * (window.bottom < 700))


def test_photos_that_fit_are_whole_and_others_are_divided_as_far_as_possible() -> None:
    assert windows_of(100, 50, 5000) == windows_of(100, 50, 0) == [PixelRectangle(0, 0, 100, 50)]
    assert all(min(window.width, window.height) >= windows.NODES_PX for window in windows_of(100, 50, 10))


def test_every_round_shows_every_window_of_a_photo_once_in_an_order_of_its_own() -> None:
    cameras = [camera.scaled(720, 540) for camera in tiny_scene.cameras()]
    rounds, windows = 6, len(windows_of(720, 540, 70_000))
    order = PhotoOrder(cameras, [TrainingSize(1)] * 9 + [TrainingSize(0, 70_000)] * (9 * windows * rounds), 0)
    seen: dict[int, list[PixelRectangle]] = {view: [] for view in range(9)}
    for iteration in range(10, len(order) + 1):
        crop = order.at(iteration)
        seen[crop.view].append(crop.window)
    orders = set()
    for frames in seen.values():
        for begin in range(0, len(frames), windows):
            assert sorted(map(str, frames[begin : begin + windows])) == sorted(map(str, windows_of(720, 540, 70_000)))
            orders.add(tuple(map(str, frames[begin : begin + windows])))
    assert len(orders) > 0.9 * 9 * rounds
    other = PhotoOrder(cameras, [TrainingSize(0, 70_000)] * 90, 1)
    assert [order.at(number + 9).window for number in range(1, 91)] != [other.at(n).window for n in range(1, 91)]


def test_windows_of_photos_of_several_sizes_are_seen_equally_often() -> None:
    small, large = tiny_scene.cameras()[:2]
    cameras = [small.scaled(640, 480), large.scaled(2000, 1500), small.scaled(600, 500)]
    size = TrainingSize(0, 100_000)
    cells = [len(windows_of(camera.width, camera.height, size.window_pixels)) for camera in cameras]
    assert len(set(cells)) > 1
    order = PhotoOrder(cameras, [TrainingSize(2)] * 6 + [size] * (3 * sum(cells) + 1), 0)
    seen = [order.at(iteration) for iteration in range(1, len(order) + 1)]
    rounds = [seen[6 + start : 6 + start + sum(cells)] for start in range(0, 3 * sum(cells), sum(cells))]
    crops = [[(crop.view, crop.window) for crop in each] for each in rounds]
    assert all(len(set(each)) == sum(cells) for each in crops) and len({tuple(each) for each in crops}) == 3


def rounds_of(order: TrainingOrder) -> dict[int, int]:
    """Return the number of visits in each round, by the iteration that ends it."""
    seen = {iteration: order.at(iteration).round for iteration in range(1, len(order) + 1)}
    return {iteration: count for iteration, count in seen.items() if count}


def test_a_round_ends_when_every_photo_has_been_seen_and_of_larger_ones_every_window() -> None:
    cameras = [camera.scaled(720, 540) for camera in tiny_scene.cameras()]
    size, windows = TrainingSize(0, 70_000), len(windows_of(720, 540, 70_000))
    whole = PhotoOrder(
        cameras, [TrainingSize(2)] * 12 + [TrainingSize(1)] * 17, 0
    )  # epochs of photos, whatever their size
    assert rounds_of(whole) == {9: 9, 18: 9, 27: 9}
    order = PhotoOrder(cameras, [TrainingSize(1)] * 12 + [size] * (18 * windows + 10), 0)
    ends = [9, 18, 18 + 9 * windows, 18 + 18 * windows]
    assert rounds_of(order) == dict(zip(ends, (9, 9, 9 * windows, 9 * windows), strict=True))
    seen = Counter(order.at(iteration).view for iteration in range(ends[1] + 1, ends[2] + 1))
    assert set(seen.values()) == {windows}


def test_rounds_of_windows_that_are_mixed_or_chosen_begin_with_their_size() -> None:
    small, large = tiny_scene.cameras()[:2]
    cameras, size = [small.scaled(640, 480), large.scaled(2000, 1500)], TrainingSize(0, 100_000)
    count = sum(len(windows_of(camera.width, camera.height, size.window_pixels)) for camera in cameras)
    mixed = PhotoOrder(cameras, [TrainingSize(2)] * 5 + [size] * (2 * count + 1), 0)
    assert rounds_of(mixed) == {2: 2, 4: 2, 5: 1, 5 + count: count, 5 + 2 * count: count}
    parts = {1: [(0, PixelRectangle(0, 0, 9, 9))], 0: [(view, PixelRectangle(0, 0, 9, 9)) for view in (0, 1, 1)]}
    chosen = WindowOrder(cameras, [TrainingSize(1)] * 2 + [size] * 7, 0, None, parts)
    assert rounds_of(chosen) == {1: 1, 2: 1, 5: 3, 8: 3}


@pytest.mark.parametrize("fill", [False, True])
def test_windows_of_the_stream_are_parts_of_the_whole_photo_to_the_bit(
    views: list[View], tmp_path: Path, fill: bool
) -> None:
    photos = {photo.camera.name: photo for photo in streamed(views, tmp_path, [TrainingSize()] * len(views))}
    counts: Counter[tuple[object, ...]] = Counter()
    shares: Counter[str] = Counter()
    for photo in streamed(views, tmp_path, [TrainingSize(0, PIXELS)] * 6 * len(views), fill=fill):
        whole, part = photos[photo.camera.name], photo.camera.window
        assert part is not None and photo.inner is not None
        rows = slice(part.top, part.top + photo.camera.height)
        columns = slice(part.left, part.left + photo.camera.width)
        assert torch.equal(photo.colour, whole.colour[rows, columns])
        assert same(photo.mask, None if whole.mask is None else whole.mask[rows, columns])
        left, top, right, bottom = photo.inner
        assert photo.is_empty == (photo.mask is not None and not photo.mask[top:bottom, left:right].any())
        counts[(photo.camera.name, part.left + left, part.top + top, part.left + right, part.top + bottom)] += 1
        shares[photo.camera.name] += photo.share  # type: ignore[assignment]
    expected = [window.within(PixelRectangle(0, 0, 0, 0)) for window in windows_of(72, 54, PIXELS)]
    assert counts == Counter((view.camera.name, *frame) for view in views for frame in expected)
    assert all(share == pytest.approx(1.0) for share in shares.values()) and len(shares) == len(views)


def test_window_of_an_iteration_does_not_depend_on_where_the_stream_began(views: list[View], tmp_path: Path) -> None:
    asked = [TrainingSize(1, 300)] * 20 + [TrainingSize(0, PIXELS)] * 20
    whole = streamed(views, tmp_path, asked)
    for first, fill in ((2, True), (17, False), (33, True)):
        later = streamed(views, tmp_path, asked, first, fill)
        for one, other in zip(later, whole[first - 1 :], strict=True):
            assert one.camera.name == other.camera.name and one.camera.window == other.camera.window
            assert torch.equal(one.colour, other.colour) and one.inner == other.inner and one.share == other.share


def test_one_decode_fills_all_levels_and_is_reported(views: list[View], tmp_path: Path) -> None:
    asked = [TrainingSize(2)] * 9 + [TrainingSize(1, 400)] * 18 + [TrainingSize(0, PIXELS)] * 18
    usual = streamed(views, tmp_path, asked)
    recorder = tiny_scene.Recorder()
    with PhotoStream.over(views, asked, 0, 1, tmp_path) as photos:
        photos.fill(recorder)
        assert recorder.steps == [(done, 9) for done in range(1, 10)]
        for view in views:
            view.image_path.unlink()
        for one, other in zip(photos, usual, strict=True):
            assert torch.equal(one.colour, other.colour)


@pytest.mark.parametrize(("window_pixels", "fits"), [(250_000, True), (0, False)])
def test_windows_of_a_large_photo_need_no_more_memory(tmp_path: Path, window_pixels: int, fits: bool) -> None:
    width, height = 4000, 3000
    picture = tmp_path / "photo.png"
    cv2.imwrite(str(picture), np.full((height, width, 3), 128, np.uint8))
    more_bytes = 28_000_000
    assert more_bytes < 3 * width * height  # a photo in 8 bits would not fit, let alone in float32
    program = Path(__file__).with_name("windowed_memory.py")
    command = [sys.executable, str(program), str(picture), str(tmp_path), str(window_pixels), str(more_bytes)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode == 0 and done.stdout.split() == ["33"]) == fits, done.stderr[-500:]
    assert fits or "memory" in done.stderr.lower()


def test_windows_are_refused_where_a_photo_is_resampled(views: list[View], tmp_path: Path) -> None:
    photo = streamed(views, tmp_path, [TrainingSize(0, PIXELS)])[0]
    assert isinstance(photo.camera, Camera) and photo.camera.uncropped().window is None
    with pytest.raises(ValueError, match="scale the full image"):
        photo.camera.scaled(10, 10)
