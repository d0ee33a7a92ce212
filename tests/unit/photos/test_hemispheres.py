"""EXIF's hemispheres: letters, words, either case; what is none gives no position, and a missing one is told."""

import io
import math

import pytest
from PIL import Image

from splatpipe.pipeline.photos.exif import Gps, read_exif


def gps_of(tags: dict[int, object]) -> Gps:
    exif = Image.Exif()
    exif.get_ifd(0x8825).update(tags)
    stream = io.BytesIO()
    Image.new("RGB", (8, 8)).save(stream, "JPEG", exif=exif.tobytes())
    with Image.open(io.BytesIO(stream.getvalue())) as picture:
        gps = read_exif(picture).gps
    assert gps is not None
    return gps


PLACE: dict[int, object] = {2: (46.0, 30.0, 0.0), 4: (91.0, 15.0, 0.0)}


@pytest.mark.parametrize(
    ("north", "east", "signs"),
    [
        ("N", "E", (1, 1)),
        ("S", "W", (-1, -1)),
        ("South", "west", (-1, -1)),
        ("north", "EAST", (1, 1)),
        ("s", "w", (-1, -1)),
        ("Nord", " West ", (1, -1)),
    ],
)
def test_the_first_letter_counts_in_either_case(north: str, east: str, signs: tuple[int, int]) -> None:
    gps = gps_of(PLACE | {1: north, 3: east})
    assert (gps.latitude, gps.longitude) == (signs[0] * 46.5, signs[1] * 91.25)
    assert gps.hemispheres


@pytest.mark.parametrize(("north", "east"), [("Q", "E"), ("N", "Ouest"), ("0", "E"), ("-", "-")])
def test_another_word_gives_no_position(north: str, east: str) -> None:
    gps = gps_of(PLACE | {1: north, 3: east})
    assert math.isnan(gps.latitude) or math.isnan(gps.longitude)


@pytest.mark.parametrize("tags", [{}, {1: "N"}, {3: "W"}, {1: "\0", 3: " "}])
def test_a_missing_hemisphere_is_told(tags: dict[int, object]) -> None:
    assert not gps_of(PLACE | tags).hemispheres
