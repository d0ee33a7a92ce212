"""PatchMatch's kernel: a slanted wall, its planes, and input that it rejects."""

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.isa import isa_names

WIDTH, HEIGHT, FOCAL = 96, 64, 80.0
RANGE = (0.05, 1.0)
WALL = np.array([0.002, 0.001, 0.15], np.float32)  # across, down, and the inverse depth at the first pixel's corner

Job = tuple[tuple[np.ndarray, np.ndarray], list[tuple[np.ndarray, ...]]]


def wall(count: int = 3) -> Job:
    """A photo of a slanted wall and others from beside it, each wall point the same grey in all."""
    rng = np.random.default_rng(5)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (4 * HEIGHT, 4 * WIDTH)).astype(np.float32), (0, 0), 3.0)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    photo = sampled(texture, x, y)
    others = []
    for number in range(count):
        shift = np.array([FOCAL * (0.5 if number % 2 else -0.5), FOCAL * 0.2 * number, 0.0], np.float32)
        matrix = np.linalg.inv(np.eye(3) + np.outer(shift, WALL))
        p = matrix @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
        back = (p[:2] / p[2]).reshape(2, HEIGHT, WIDTH)
        others.append((sampled(texture, *back), everywhere(), np.eye(3, dtype=np.float32), shift))
    return (photo, everywhere()), others


def sampled(texture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    places = ((3 * side + size).astype(np.float32) for side, size in ((x, WIDTH / 2), (y, HEIGHT / 2)))
    return cv2.remap(texture, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT).round().astype(np.uint8)


def everywhere() -> np.ndarray:
    return np.ones((HEIGHT, WIDTH), np.uint8)


def matched(job: Job, iterations: int = 8, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    planes, costs = np.zeros((3, HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), np.float32)
    _native.patch_match(*job, RANGE, iterations, 0, seed, planes, costs)
    return planes, costs


def true_inverse() -> np.ndarray:
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return WALL[0] * x + WALL[1] * y + WALL[2]


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = _native.threads()
    _native.set_threads(1)
    yield
    _native.set_threads(before)


@pytest.mark.parametrize("name", isa_names())
def test_a_slanted_wall_is_found_with_its_slope(name: str) -> None:
    _native.set_isa(name)
    try:
        planes, costs = matched(wall())
    finally:
        _native.set_isa("auto")
    inner = np.s_[8:-8, 24:-24]
    assert np.median(np.abs(planes[0] / true_inverse() - 1.0)[inner]) < 0.01
    assert np.median(np.abs(planes[1] / WALL[0] - 1.0)[inner]) < 0.2
    assert (costs[inner] < 0.1).mean() > 0.9


def test_threads_do_not_change_a_bit_and_seeds_do() -> None:
    first = matched(wall(), 2)
    _native.set_threads(3)
    for one, other in zip(first, matched(wall(), 2), strict=True):
        np.testing.assert_array_equal(one, other)
    assert (matched(wall(), 2, seed=2)[0] != first[0]).any()


def test_masked_pixels_have_no_plane_and_no_influence() -> None:
    (grey, counts), others = wall()
    counts[20:40, 30:60] = 0
    planes, costs = matched(((grey, counts), others))
    assert (planes[:, counts == 0] == 0.0).all() and (costs[counts == 0] == 2.0).all()
    garbled = grey.copy()
    garbled[counts == 0] = 255 - garbled[counts == 0]
    for one, other in zip((planes, costs), matched(((garbled, counts), others)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_given_planes_are_judged_as_they_are() -> None:
    planes, costs = np.zeros((3, HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), np.float32)
    planes[0], planes[1], planes[2] = true_inverse(), WALL[0], WALL[1]
    before = planes.copy()
    _native.patch_match(*wall(), RANGE, 0, 0, 0, planes, costs)
    np.testing.assert_array_equal(planes, before)
    assert np.median(costs) < 0.05
    planes[1] = np.nan
    _native.patch_match(*wall(), RANGE, 2, 0, 0, planes, costs)
    assert np.isfinite(planes).all()


def test_smaller_changes_refine_planes_that_are_nearly_right() -> None:
    errors = []
    for begun in (0, 5):
        planes, costs = np.zeros((3, HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), np.float32)
        planes[0], planes[1], planes[2] = 1.005 * true_inverse(), WALL[0], WALL[1]
        _native.patch_match(*wall(), RANGE, 1, begun, 0, planes, costs)
        errors.append(np.median(np.abs(planes[0] / true_inverse() - 1.0)))
    assert errors[1] < 0.8 * errors[0] < 0.004, errors


def test_one_other_photo_is_not_enough() -> None:
    assert matched(wall(1))[1].min() > 0.5


def test_mismatched_inputs_are_refused() -> None:
    (grey, counts), others = wall()
    planes, costs = np.zeros((3, HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), np.float32)

    given = {"photo": (grey, counts), "others": others, "inverse_range": RANGE}
    given |= {"iterations": 1, "begun": 0, "seed": 0}
    _native.patch_match(**given, planes=planes, costs=costs)

    def refused(**changed: object) -> None:
        with pytest.raises((ValueError, TypeError)):
            _native.patch_match(**{**given, "planes": planes, "costs": costs, **changed})

    refused(others=[])
    refused(others=others * 6)
    refused(photo=(grey, counts[1:]))
    refused(photo=(np.zeros((3, 96), np.uint8), np.ones((3, 96), np.uint8)))
    refused(others=[(grey[:, 1:].copy(), counts, *others[0][2:])])
    refused(planes=planes[:, 1:].copy())
    refused(costs=costs.astype(np.float64))
    refused(planes=planes[:, :, ::-1])
    refused(iterations=65)
    refused(begun=65)
    refused(begun=-1)
    for bounds in ((0.0, 1.0), (0.5, 0.1), (0.1, np.inf), (np.nan, 1.0)):
        refused(inverse_range=bounds)
