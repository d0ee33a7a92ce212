"""EXIF's degrees and hemispheres: notations that are read, and those that give no position; a missing one is told."""

import io
import math

import pytest
from PIL import Image

from splatpipe.pipeline.photos.metadata.exif import LATITUDE_SIGNS, Gps, _degrees, read_exif


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


@pytest.mark.parametrize(
    "latitude",
    [(46.5, 0.0, 0.0), (46.0, 30.0, 0.0), (46.0, 29.0, 60.0), (46.5,), (46.0, 30.0)],
)
def test_notations_of_one_angle(latitude: tuple[float, ...]) -> None:
    assert gps_of(PLACE | {1: "N", 2: latitude, 3: "E"}).latitude == pytest.approx(46.5, abs=0.01)


@pytest.mark.parametrize("latitude", [(46.0, 84.12, 0.0), (46.0, 30.0, 2848.0), (46.5, 30.0, 0.0), (46.0, 30.5, 28.0)])
def test_numbers_that_are_no_degrees_minutes_and_seconds_give_no_position(latitude: tuple[float, ...]) -> None:
    """Decimals written as minutes, or a decimal left in front of its minutes, would be kilometres off."""
    assert math.isnan(gps_of(PLACE | {1: "N", 2: latitude, 3: "E"}).latitude)


@pytest.mark.parametrize(("south", "is_stated"), [("S", True), ("", True)])
def test_a_sign_of_the_degrees_is_that_of_the_angle(south: str, is_stated: bool) -> None:
    """Pillow has no signed rationals in GPS tags: other writers do."""
    latitude, stated = _degrees((-33.0, 51.0, 36.0), south, LATITUDE_SIGNS)
    assert (latitude, stated) == (pytest.approx(-33.86), is_stated)


@pytest.mark.parametrize(
    ("stated", "far"),
    [("TOKYO", "TOKYO"), ("Tokyo97", "Tokyo97"), ("NAD-27", "NAD-27"), ("WGS-84", ""), ("", ""), ("JGD2011", "")],
)
def test_a_datum_far_from_wgs84_is_kept(stated: str, far: str) -> None:
    assert gps_of(PLACE | {1: "N", 3: "E", 18: stated}).datum == far
