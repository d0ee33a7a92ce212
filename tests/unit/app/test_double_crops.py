"""The report's crops of two photos that may show two places, though the model has them at one."""

import base64
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from splatpipe.pipeline.app.report.charts import pictures

FOUND = {"photos": ["a.jpg", "b.jpg"], "places_px": [[300.0, 200.0], [10.0, 390.0]]}


def test_both_photos_are_cropped_around_the_place(monkeypatch: pytest.MonkeyPatch) -> None:
    photos = {
        name: SimpleNamespace(width=600, height=400, orientation=turn) for name, turn in (("a.jpg", 1), ("b.jpg", 6))
    }
    pixels = np.zeros((400, 600, 3), np.uint8)
    pixels[190:210, 290:310] = (255, 0, 0)  # RGB, around the first place
    monkeypatch.setattr(pictures, "load_photo_list", lambda part: SimpleNamespace(by_name=lambda: photos))
    monkeypatch.setattr(pictures, "_decoded", lambda photo, part, folder: pixels)
    crops = pictures.double_crops(FOUND, Path("part"), Path("photos"))
    assert [name for name, _ in crops] == ["a.jpg", "b.jpg"]
    first, second = (
        cv2.imdecode(np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8), cv2.IMREAD_COLOR) for _, url in crops
    )
    assert first.shape == second.shape == (180, 180, 3)  # 0.3 of the longer side
    blue, _, red = first[90, 90].astype(int)
    assert red > 200 > 60 > blue  # the place is in the middle
    assert second[20, 150].min() > 100  # beyond the photo's lower edge, turned upright: grey at the left


def test_photos_that_are_gone_leave_no_crops(monkeypatch: pytest.MonkeyPatch) -> None:
    assert pictures.double_crops(FOUND, None, Path("photos")) == []
    monkeypatch.setattr(pictures, "load_photo_list", lambda part: SimpleNamespace(by_name=dict))
    assert pictures.double_crops(FOUND, Path("part"), Path("photos")) == []
    assert pictures.double_crops({}, Path("part"), Path("photos")) == []
