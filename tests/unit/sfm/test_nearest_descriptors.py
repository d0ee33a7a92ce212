"""Matching of descriptors: only true mutual neighbours, nearly all of them, ties, and photos with few descriptors."""

import numpy as np
import pytest

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


def test_blocks_do_not_change_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = two_photos(600)
    whole = matches(first, second)
    monkeypatch.setattr("splatpipe.pipeline.sfm.matching.nearest_descriptors.BLOCK", 7)
    assert matches(first, second) == whole
