"""What was measured of a film is kept whole, and a broken or foreign file is not gone on with."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatpipe.pipeline.photos.video.measuring import load_meter, save_meter
from splatpipe.pipeline.photos.video.motion import FilmMeter

COUNT = 8  # pictures


def pictures() -> list[np.ndarray]:
    noise = np.random.default_rng(0).integers(0, 255, (180, 320 + 6 * COUNT, 3), dtype=np.uint8)
    ground = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return [np.ascontiguousarray(ground[:, 6 * k : 6 * k + 320]) for k in range(COUNT)]


def measured(count: int) -> FilmMeter:
    meter = FilmMeter()
    for k, picture in enumerate(pictures()[:count]):
        meter.add(2 * k, k / 15.0, picture)
    return meter


def test_measuring_goes_on_as_if_it_had_not_stopped(tmp_path: Path) -> None:
    whole = measured(COUNT).measures()
    save_meter(measured(3), tmp_path / "kept")
    meter = load_meter(tmp_path / "kept")
    assert meter.begun == 5
    for k, picture in list(enumerate(pictures()))[3:]:
        meter.add(2 * k, k / 15.0, picture)
    for name in ("frames", "times_s", "sharpness", "steps"):
        np.testing.assert_array_equal(getattr(meter.measures(), name), getattr(whole, name))


def test_a_missing_file_begins_anew(tmp_path: Path) -> None:
    assert load_meter(tmp_path / "none").begun == 0
    (tmp_path / "folder").mkdir()
    assert load_meter(tmp_path / "folder").begun == 0


@pytest.mark.parametrize(
    "head",
    [
        {"rows": 10**15, "picture": [180, 320], "waited": 0},
        {"rows": -1, "picture": [180, 320], "waited": 0},
        {"rows": 3, "picture": [10**6, 10**6], "waited": 0},
        {"rows": 3, "picture": [-180, -320], "waited": 0},
        {"rows": 3, "picture": [180], "waited": 0},
        {"rows": 3, "picture": [180, 320], "waited": -1},
        {"rows": 1e400, "picture": [180, 320], "waited": 0},
        {"rows": None, "picture": None, "waited": None},
        ["rows"],
    ],
)
def test_a_false_head_begins_anew(tmp_path: Path, head: object) -> None:
    path = tmp_path / "kept"
    save_meter(measured(3), path)
    body = path.read_bytes().partition(b"\n")[2]
    path.write_bytes(json.dumps(head).encode() + b"\n" + body)
    assert load_meter(path).begun == 0


def test_a_file_that_is_cut_off_or_out_of_order_begins_anew(tmp_path: Path) -> None:
    path = tmp_path / "kept"
    meter = measured(3)
    save_meter(meter, path)
    path.write_bytes(path.read_bytes()[:-1])
    assert load_meter(path).begun == 0
    for number in (0.0, np.nan):
        meter.rows[2][0] = number
        save_meter(meter, path)
        assert load_meter(path).begun == 0
