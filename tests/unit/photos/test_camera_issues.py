"""Photos of another camera than the others are described as a person would."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from splatpipe.pipeline.photos.intake.camera_groups import group_cameras
from splatpipe.pipeline.photos.intake.camera_issues import find_camera_issues
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.photos.metadata.exif import Exif


def photo(number: int, make: str, model: str) -> CheckedPhoto:
    exif = replace(Exif(), make=make, model=model, focal_mm=12.29 if model else None)
    name = f"{number}.jpg"
    return CheckedPhoto(name, Path(name), name, 1200, 900, name, True, False, None, exif, {})


@pytest.mark.parametrize(
    ("camera", "others", "said"),
    [
        (("DJI", "M3E"), ("", ""), "taken with a DJI M3E (12.29 mm), the others with an unknown camera"),
        (("", ""), ("DJI", "M3E"), "no camera is named in EXIF, the others were taken with a DJI M3E (12.29 mm)"),
        (("Apple", "iPhone"), ("DJI", "M3E"), "taken with an Apple iPhone (12.29 mm), the others with a DJI M3E"),
    ],
)
def test_cameras_have_the_right_article_and_a_missing_name_is_told(
    camera: tuple[str, str], others: tuple[str, str], said: str
) -> None:
    photos = [photo(0, *camera), *(photo(number, *others) for number in range(1, 6))]
    groups, camera_of = group_cameras(photos)
    (issue,) = find_camera_issues(photos, groups, camera_of)
    assert issue.message.startswith(f"0.jpg: {said}")
    assert issue.photos == ("0.jpg",)
