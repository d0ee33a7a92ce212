"""Matching of descriptors: only true mutual neighbours, nearly all of them, ties, photos with few descriptors;
and the search itself on every instruction set."""

import itertools

import numpy as np
import pytest

from splatpipe.pipeline.native import _native
from splatpipe.pipeline.sfm.matching.nearest_descriptors import group_descriptors, match_descriptors

DISTANCE, RATIO = 0.7 * 512, 0.8


def unit_descriptors(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.rint(512.0 * values / np.linalg.norm(values, axis=1, keepdims=True)), np.uint8)


def descriptors(count: int, seed: int) -> np.ndarray:
    """Return descriptors around a few centres, as those of photos are."""
    rng = np.random.default_rng(seed)
    centres = np.random.default_rng(99).gamma(0.7, size=(20, 128))
    return unit_descriptors(centres[rng.integers(0, 20, count)] + 0.35 * rng.gamma(0.7, size=(count, 128)))


def seen_again(photo: np.ndarray, rows: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(scale=6.0, size=(len(rows), 128))
    return unit_descriptors(np.maximum(photo[rows] + noise, 0.0))


def every_match(first: np.ndarray, second: np.ndarray) -> set[tuple[int, int]]:
    """Compare everything with everything, one product at a time, by COLMAP's tests."""
    products = first.astype(np.int64) @ second.astype(np.int64).T
    squared = np.maximum(2 * (512 * 512 - products), 0)

    def clear(row: np.ndarray) -> int:
        order = np.argsort(row, kind="stable")
        best = np.sqrt(row[order[0]])
        other = np.sqrt(row[order[1]]) if len(row) > 1 else np.sqrt(2) * 512
        return int(order[0]) if best <= DISTANCE and best < RATIO * other else -1

    there = [clear(row) for row in squared]
    back = [clear(row) for row in squared.T]
    return {(i, j) for i, j in enumerate(there) if j >= 0 and back[j] == i}


def matches(first: np.ndarray, second: np.ndarray) -> list[tuple[int, int]]:
    return [tuple(row) for row in match_descriptors(first, group_descriptors(second)).tolist()]


def two_photos(count: int) -> tuple[np.ndarray, np.ndarray]:
    first = descriptors(count, 1)
    again = seen_again(first, np.random.default_rng(2).permutation(count)[: count // 3], 3)
    return first, np.concatenate([descriptors(count // 2, 4), again])


def test_matches_are_those_of_comparing_everything() -> None:
    first, second = two_photos(1800)
    found, all_matches = matches(first, second), every_match(first, second)
    assert len(all_matches) > 400
    assert set(found) <= all_matches
    assert len(found) >= 0.97 * len(all_matches)
    assert found == sorted(found)


def test_few_descriptors_are_compared_completely() -> None:
    first, second = two_photos(40)
    assert len(second) <= 36  # as many cells as a descriptor may be in
    assert set(matches(first, second)) == every_match(first, second)
    assert matches(first, second)


@pytest.mark.parametrize("counts", [(0, 0), (0, 30), (30, 0)])
def test_a_photo_without_descriptors_has_no_matches(counts: tuple[int, int]) -> None:
    found = match_descriptors(descriptors(counts[0], 1), group_descriptors(descriptors(counts[1], 2)))
    assert found.shape == (0, 2)
    assert found.dtype == np.uint32


def test_one_descriptor_matches_its_like() -> None:
    photo = descriptors(50, 1)
    other = np.flatnonzero((photo.astype(np.int64) @ photo[7].astype(np.int64)) < 150_000)
    second = np.concatenate([photo[other], photo[7:8]])
    assert matches(photo[7:8], second) == [(0, len(other))]
    assert matches(second, photo[7:8]) == [(len(other), 0)]
    assert matches(photo[7:8], photo[7:8]) == [(0, 0)]


def test_equal_descriptors_match_nothing() -> None:
    photo = descriptors(400, 1)
    repeated = np.concatenate([np.repeat(photo[:1], 300, axis=0), photo[1:]])
    for first, second in ((repeated, photo), (photo, repeated)):
        found = matches(first, second)
        assert set(found) <= every_match(first, second)
        assert not any(0 in pair or (pair[0] < 300 and first is repeated) for pair in found)
    assert matches(np.repeat(photo[:1], 300, axis=0), np.repeat(photo[:1], 300, axis=0)) == []


def test_descriptors_of_nothing_match_nothing() -> None:
    assert matches(np.zeros((60, 128), np.uint8), np.zeros((60, 128), np.uint8)) == []
    assert matches(np.zeros((60, 128), np.uint8), descriptors(60, 1)) == []


def slowly_nearest(queries: np.ndarray, values: np.ndarray) -> tuple[list[int], list[int], list[int]]:
    products = queries.astype(np.int64) @ values.astype(np.int64).T
    rows = products.argmax(axis=1)
    best = products.max(axis=1)
    products[np.arange(len(queries)), rows] = 0
    return rows.tolist(), best.tolist(), products.max(axis=1).tolist()


def search(queries: tuple[np.ndarray, ...], values: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    count = len(queries[0])
    found = np.full(count, -1, np.int64), np.full(count, -1, np.int32), np.full(count, -1, np.int32)
    _native.nearest_descriptors(queries, values, found)
    return found


@pytest.mark.usefixtures("isa")
@pytest.mark.parametrize(
    ("count", "others"), [(1, 1), (1, 16), (6, 17), (7, 64), (13, 65), (5, 255), (30, 257), (3, 700)]
)
def test_products_are_exact_for_every_number_of_descriptors(count: int, others: int) -> None:
    rng = np.random.default_rng(others)
    queries, values = (rng.integers(0, 256, (n, 128), np.uint8) for n in (count, others))
    queries[0], values[-1] = 255, 255  # the largest product that there can be
    values[: others // 2] = values[others // 2 : others // 2 * 2]  # each of them twice: the first counts
    found = search((queries, np.array([0, count])), (values, np.array([0, others])))
    assert [part.tolist() for part in found] == [*slowly_nearest(queries, values)]


@pytest.mark.usefixtures("isa")
def test_groups_are_compared_each_for_itself() -> None:
    rng = np.random.default_rng(5)
    queries, values = (rng.integers(0, 90, (n, 128), np.uint8) for n in (50, 300))
    bounds, theirs = np.array([0, 20, 20, 33, 45]), np.array([10, 200, 210, 210, 299])
    found = search((queries, bounds), (values, theirs))
    for number, (low, high) in enumerate(itertools.pairwise(bounds.tolist())):
        part = values[theirs[number] : theirs[number + 1]]
        expected = slowly_nearest(queries[low:high], part) if len(part) else 3 * ([-1] * (high - low),)
        assert [each[low:high].tolist() for each in found] == [*expected]
    assert all(set(part[45:].tolist()) == {-1} for part in found)  # in no group


@pytest.mark.parametrize(
    ("bounds", "theirs", "message"),
    [
        ([], [], "no bounds"),
        ([-1, 3], [0, 3], "no bounds"),
        ([0, 3, 2], [0, 1, 3], "not in order"),
        ([0, 4], [0, 3], "out of range"),
        ([0, 3], [0, 2, 3], "differ in groups"),
    ],
)
def test_bounds_that_do_not_fit_are_refused(bounds: list[int], theirs: list[int], message: str) -> None:
    some = np.zeros((3, 128), np.uint8)
    with pytest.raises(ValueError, match=message):
        search((some, np.array(bounds, np.int64)), (some, np.array(theirs, np.int64)))
