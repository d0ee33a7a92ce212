"""Positions in a film's subtitles: DJI's forms are read, and hostile files do no harm."""

import datetime
import random
import re
import time
from pathlib import Path

import numpy as np
import pytest

from splatpipe.pipeline.photos.video.boxes import Cue
from splatpipe.pipeline.photos.video.telemetry import Fix, FlightPath, read_fixes, read_subtitles

MINI = """1
00:00:00,000 --> 00:00:00,033
<font size="28">FrameCnt: 1, DiffTime: 33ms
2024-08-07 12:34:24.380
[iso: 100] [shutter: 1/3200.0] [fnum: 1.7] [ev: 0] [color_md: default] [focal_len: 24.00] [latitude: 47.841190] \
[longitude: -13.512690] [rel_alt: 32.100 abs_alt: 547.213] [ct: 5310] </font>

"""
MAVIC_2 = """1
00:00:00,000 --> 00:00:00,016
<font size="36">SrtCnt : 1, DiffTime : 16ms
2024-04-19 14:46:07,308,705
[iso : 100] [shutter : 1/180.0] [fnum : 280] [focal_len : 240] [latitude : 47.841190] [longtitude : -13.512690] \
[altitude: 547.213]
</font>

"""
MAVIC_PRO = """1
00:00:01,000 --> 00:00:02,000
HOME(-13.5130,47.8410) 2017.08.05 14:11:51
GPS(-13.51269,47.84119,16) BAROMETER:32.1
ISO:100 Shutter:60 EV: Fnum:2.2
"""
MAVIC_MINI = """1
00:00:00,000 --> 00:00:01,000
F/2.8, SS 206.14, ISO 150, EV 0, GPS (-13.51269, 47.84119, 10), D 2.80m, H 32.10m, H.S 0.00m/s, V.S 0.00m/s
"""
RTK = """1
00:00:00,000 --> 00:00:01,000
F/6.3, SS 60, ISO 100, RTK (-13.512690, 47.841190, 28), HOME (-13.5127, 47.8412, 515.00m), D 75.36m, H 32.10m
"""
LETTERS = "1\n00:00:00,000 --> 00:00:01,000\nGPS(W: 13.51269, N: 47.84119, 9) BAROMETER: 32.1\n"


def fixes(path: Path, text: str, near: tuple[float, float] | None = None) -> list[Fix]:
    path.write_text(text, encoding="utf-8")
    return read_fixes(read_subtitles(path), near)


@pytest.mark.parametrize(
    ("text", "altitude", "height"),
    [
        (MINI, 547.213, 32.1),
        (MINI.replace("\n", "\r\n"), 547.213, 32.1),
        ("\ufeff" + MINI, 547.213, 32.1),
        (re.sub(r"(: -?\d+)\.", r"\1,", MINI), 547.213, 32.1),
        (MAVIC_2, 547.213, None),
        (MAVIC_PRO, None, 32.1),
        (MAVIC_MINI, None, 32.1),
        (RTK, None, 32.1),
        (LETTERS, None, 32.1),
    ],
)
def test_forms_of_several_drones_are_read(
    tmp_path: Path, text: str, altitude: float | None, height: float | None
) -> None:
    (fix,) = fixes(tmp_path / "a.srt", text)
    assert (fix.latitude, fix.longitude) == (47.84119, -13.51269)
    assert (fix.altitude_m, fix.height_m) == (altitude, height)


def test_time_and_focal_length_are_read(tmp_path: Path) -> None:
    (mini,), (mavic,) = (fixes(tmp_path / "a.srt", text) for text in (MINI, MAVIC_2))
    assert mini.recorded == datetime.datetime(2024, 8, 7, 12, 34, 24, 380_000)
    assert mavic.recorded == datetime.datetime(2024, 4, 19, 14, 46, 7, 308_000)
    assert mini.focal_mm == mavic.focal_mm == 24.0


def test_a_receiver_without_a_fix_and_impossible_places_state_nothing(tmp_path: Path) -> None:
    for place in (
        "0.000000] [longitude: 0.000000",
        "91.5] [longitude: 99.5",
        "47.8] [longitude: 1e9",
        "nan] [longitude: 3.0",
    ):
        assert fixes(tmp_path / "a.srt", f"1\n00:00:00,000 --> 00:00:01,000\n[latitude: {place}]\n") == []


def test_a_location_decides_which_coordinate_is_the_latitude(tmp_path: Path) -> None:
    text = "1\n00:00:00,000 --> 00:00:01,000\nGPS(47.84119,13.51269,16)\n"
    assert fixes(tmp_path / "a.srt", text)[0].latitude == 13.51269
    assert fixes(tmp_path / "a.srt", text, (47.8, 13.5))[0].latitude == 47.84119


def straight(step_s: float, count: int, **facts: object) -> list[Fix]:
    """North by a millidegree a second."""
    return [Fix(k * step_s, 47.0 + 0.001 * k * step_s, 13.0, **facts) for k in range(count)]  # type: ignore[arg-type]


def test_positions_once_a_second_are_joined_by_lines(tmp_path: Path) -> None:
    path = FlightPath(straight(1.0, 5, altitude_m=500.0, height_m=30.0))
    place = path.at(2.25)
    assert place is not None and place.latitude == pytest.approx(47.00225)
    assert (place.altitude_m, place.height_m, place.sigma_m) == (500.0, 30.0, None)
    last, late = path.at(4.6), path.at(9.5)
    assert last is not None and last.latitude == pytest.approx(47.0046) and late is None


def test_a_receiver_slower_than_the_film_makes_no_stairs() -> None:
    """Thirty cues a second, each fifth with a new position."""
    cues = [
        Cue(k / 30.0, (k + 1) / 30.0, f"[latitude: {47.0 + 1e-4 * (k // 5):.6f}] [longitude: 13.0]") for k in range(90)
    ]
    path = FlightPath(read_fixes(cues))
    places = [path.at(k / 30.0) for k in range(80)]
    steps = np.diff([place.latitude for place in places if place is not None])
    assert len(steps) == 79 and steps == pytest.approx(2e-5, rel=0.05)


def test_across_the_date_line_and_with_few_decimals() -> None:
    path = FlightPath([Fix(0.0, -17.0, 179.9998, decimals=4), Fix(1.0, -17.0, -179.9998, decimals=4)])
    middle = path.at(0.5)
    assert middle is not None and abs(middle.longitude) == pytest.approx(180.0)
    assert middle.sigma_m == pytest.approx(4.39, abs=0.01)  # combines rounding to 11 m and a receiver's 3 m


def test_hostile_subtitles_take_little_time_and_memory(tmp_path: Path) -> None:
    rng = random.Random(0)
    cue_times = "00:00:00,000 --> 00:00:01,000\n"
    attacks = [
        b"\xff" * 3_000_000,
        b"9" * 3_000_000,
        (cue_times + "[latitude: " + " " * 2_000_000).encode(),
        (cue_times + "GPS(" * 500_000).encode(),
        (cue_times + "[latitude: 1" + "." * 1_000_000).encode(),
        (cue_times + "47.0\n" * 300_000).encode(),
        (cue_times * 100_000).encode(),
        ("00:00:00,000 -->" * 100_000).encode(),
        bytes(rng.randrange(256) for _ in range(100_000)),
    ]
    start_s = time.process_time()
    for attack in attacks:
        (tmp_path / "a.srt").write_bytes(attack)
        assert read_fixes(read_subtitles(tmp_path / "a.srt")) == []
    assert time.process_time() - start_s < 30.0  # seconds; the quadratic reader that this guards against takes 170


def test_mutated_subtitles_give_places_on_earth_or_none(tmp_path: Path) -> None:
    rng = random.Random(1)
    for text in (MINI, MAVIC_2, MAVIC_PRO, MAVIC_MINI, RTK):
        for _ in range(50):
            data = bytearray(text.encode())
            for _ in range(rng.randint(1, 8)):
                data[rng.randrange(len(data))] = rng.randrange(256)
            (tmp_path / "a.srt").write_bytes(bytes(data))
            for fix in read_fixes(read_subtitles(tmp_path / "a.srt")):
                assert abs(fix.latitude) <= 90.0 and abs(fix.longitude) <= 180.0
