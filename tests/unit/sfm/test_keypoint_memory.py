"""Keypoint extraction keeps to the memory that there is: fewer photos at once, or a clear refusal."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatpipe.pipeline.engine import machine
from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.stage import Machine
from splatpipe.pipeline.photos.files.photo_list import Photo, PhotoList
from splatpipe.pipeline.sfm.matching.keypoints import extraction_bytes
from splatpipe.pipeline.sfm.options import FeaturesConfig
from splatpipe.stages import features

PREVIEW = FeaturesConfig(extractor="opencv-sift", max_image_size=1600)
PHOTOS = PhotoList(tuple(Photo(f"{name}.jpg", "", 2832, 2128, 0) for name in "abc"))


def allowed(monkeypatch: pytest.MonkeyPatch, total: int, free: int) -> None:
    """Set the memory of this machine and its groups, and what is free of it, in megabytes."""
    monkeypatch.setattr(features, "available_memory_bytes", lambda: total * 1_000_000)
    monkeypatch.setattr(features, "resident_bytes", lambda: 130_000_000)
    monkeypatch.setattr(machine, "free_memory_bytes", lambda root=Path("/"): free * 1_000_000)
    monkeypatch.setattr(machine, "resident_bytes", lambda root=Path("/"): 130_000_000)


def test_memory_follows_the_photo_and_the_reduced_image() -> None:
    small, large = (extraction_bytes(PREVIEW, 3 * side * side // 4, side) for side in (1600, 16_000))
    assert 466e6 < small < 520e6  # one photo of sceaux takes 466 MB at 1.9 megapixels
    assert large - small == pytest.approx(8 * 0.75 * (16_000**2 - 1600**2))  # only decoding grows
    standard = FeaturesConfig(extractor="sift", max_image_size=1600)
    assert extraction_bytes(standard, 1600 * 1200, 1600) > small


def test_as_many_photos_are_in_work_as_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    for free, threads in ((20_000, 8), (2000, 3), (600, 1), (10, 1)):
        allowed(monkeypatch, 20_000, free)
        assert features._threads(PREVIEW, PHOTOS, Machine(threads=8)) == threads
    allowed(monkeypatch, 20_000, 20_000)
    assert features._threads(PREVIEW, PHOTOS, Machine(threads=8, memory_bytes=1_300_000_000)) == 2


def test_a_container_that_is_too_small_is_refused_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    allowed(monkeypatch, 500, 400)
    with pytest.raises(
        MachineError, match=r"takes 0\.6\d GB of memory, and this machine or container has 0\.50 GB"
    ) as raised:
        features._threads(PREVIEW, PHOTOS, Machine(threads=2))
    assert "features.max_image_size" in raised.value.hint
    smaller = PREVIEW.model_copy(update={"max_image_size": 1000})
    assert features._threads(smaller, PHOTOS, Machine(threads=2)) == 1
