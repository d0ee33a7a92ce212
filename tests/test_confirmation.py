"""Confirmed depths: the same as places in space tell, on an exact scene, however photos are cut into bands."""

import sys
from pathlib import Path

import numpy as np
import pytest

from splatpipe.pipeline.mvs import confirmation
from splatpipe.pipeline.mvs.confirmation import confirmations
from splatpipe.pipeline.mvs.depth_maps import confirmed_map
from splatpipe.pipeline.mvs.depth_search import confirmed

sys.path.insert(0, str(Path(__file__).parent / "scenes"))
import house_site

CAMERAS = [house_site.cameras()[number] for number in (4, 1, 9, 12, 14)]  # above, beside it, and around


def inverse_of(number: int) -> np.ndarray:
    depth = house_site.depths_of(CAMERAS[number]).depth
    return np.where(depth > 0.0, 1.0 / np.where(depth > 0.0, depth, 1.0), 0.0).astype(np.float32)


MAPS = [inverse_of(number) for number in range(len(CAMERAS))]


def votes_in_space(inverse: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero(inverse > 0.0)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    places = CAMERAS[0].unproject(pixels, 1.0 / inverse[rows, columns].astype(np.float64))
    votes = np.zeros(inverse.shape, np.uint8)
    for camera, theirs in zip(CAMERAS[1:], MAPS[1:], strict=True):
        votes[rows, columns] += confirmed(places, CAMERAS[0], camera, theirs)[1]
    return votes


@pytest.mark.parametrize("band", [1, 1 << 12, 1 << 30])
def test_votes_are_those_of_places_in_space(band: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(confirmation, "BAND_PIXELS", band)
    given = MAPS[0].copy()
    given[50:60] *= 1.2  # wrong
    given[90:95, 20:60] = 0.0
    found = confirmations(CAMERAS[0], given, zip(CAMERAS[1:], MAPS[1:], strict=True))
    expected = votes_in_space(given)
    assert (found == expected).mean() > 0.9995  # places on the border between two pixels may round to either
    assert np.abs(found.astype(int) - expected).max() <= 1
    assert found.max() == 4 and (found[90:95, 20:60] == 0).all() and found[50:60].mean() < 0.5 * found.mean()


def test_depths_that_too_few_confirm_are_none() -> None:
    votes = np.array([[0, 1, 2, 24]], np.uint8)
    found = confirmed_map(np.array([[0.0, 0.5, 0.5, 0.25]], np.float32), votes)
    assert found.depth.tolist() == [[0.0, 0.0, 2.0, 4.0]] and found.confidence.tolist() == [[0, 0, 2, 24]]


def test_one_that_looks_away_or_has_no_depths_confirms_nothing() -> None:
    away = house_site.photo_camera("away", (0.0, 0.0, 3.0), (0.0, 40.0, 60.0))
    nothing = np.zeros_like(MAPS[0])
    asked = [(away, np.full_like(nothing, 0.1)), (CAMERAS[1], nothing)]
    assert not confirmations(CAMERAS[0], MAPS[0], asked).any()
    assert not confirmations(CAMERAS[0], nothing, [(CAMERAS[1], MAPS[1])]).any()
