"""Control against the photos' positions, which it overrules: what contradicts is told first."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from surveyed import Row, capture_parts, gcp_list, positions, rows, true_model

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.survey.crs.crs import from_geodetic, open_operation, parse_crs
from splatpipe.pipeline.survey.options import GeorefConfig
from splatpipe.stages.georef import run

NAMES = ("P01", "P03", "P05", "P07", "P16")
FEET = "+proj=tmerc +lat_0=0 +lon_0=15 +k=0.9996 +x_0=500000 +y_0=0 +ellps=WGS84 +units={} +no_defs"
US_OVER_INTERNATIONAL = 1200.0 / 3937.0 / 0.3048
Coordinates = tuple[float, float, float]


@dataclass
class Notes:
    """A reporter that records."""

    warnings: list[str] = field(default_factory=list)

    def progress(self, done: int | float, total: int | float, what: str, unit: str = "") -> None: ...

    def metric(self, name: str, value: int | float, step: int | None = None) -> None: ...

    def note(self, message: str) -> None: ...

    def warning(self, message: str, hint: str = "") -> None:
        self.warnings.append(message)


def contradictions(
    folder: Path,
    written: Callable[[Coordinates], Coordinates] = lambda place: place,
    crs: str = "EPSG:32633",
    kind: str = "rtk",
    **fields: Any,
) -> str:
    """What georeferencing by five points, written in some way, says against itself."""
    lines = [replace(row, place=written(row.place)) for row in rows(NAMES)]
    sigmas = {"rtk": (0.02, 0.03), "gps": (3.0, 5.0)}[kind]
    records = [record | fields for record in positions(kind, sigmas)]
    parts = capture_parts(folder, true_model(points=300), records, gcp_list(lines, crs))
    (folder / "out").mkdir()
    notes = Notes()
    summary = run(GeorefConfig(adjust="off"), Inputs(parts, folder / "photos"), folder / "out", notes)
    found = summary.get("contradictions", [])
    assert all(each["text"] in notes.warnings for each in found)
    return " ".join(f"{each['text']} {each['hint']}" for each in found)


@pytest.mark.parametrize("kind", ["rtk", "gps"])
def test_sound_control_contradicts_nothing(tmp_path: Path, kind: str) -> None:
    assert contradictions(tmp_path, kind=kind) == ""


def test_control_beside_the_photos_is_told(tmp_path: Path) -> None:
    said = contradictions(tmp_path, lambda place: (place[0] + 60.0, place[1], place[2]), kind="gps")
    assert "m horizontally off the photos' positions" in said and "EPSG:32633" in said


@pytest.mark.parametrize(("kind", "metres", "reported"), [("rtk", 5.0, True), ("rtk", 2.0, False), ("gps", 5.0, False)])
def test_a_base_in_the_wrong_place_is_told_where_positions_are_accurate(
    tmp_path: Path, kind: str, metres: float, reported: bool
) -> None:
    said = contradictions(tmp_path, lambda place: (place[0] + metres, place[1], place[2]), kind=kind)
    assert ("lies 5 m horizontally off" in said and "base station" in said) if reported else said == ""


def test_heights_of_no_datum_are_told_but_not_against_heights_above_takeoff(tmp_path: Path) -> None:
    def lifted(place: Coordinates) -> Coordinates:
        return place[0], place[1], place[2] + 400.0

    assert "more than vertical datums can differ" in contradictions(tmp_path / "a", lifted)
    for source in ("takeoff", "assumed"):
        assert contradictions(tmp_path / source, lifted, altitude_source=source) == ""


@pytest.mark.parametrize("stated", ["us-ft", "ft"])
@pytest.mark.parametrize("is_other", [False, True])
def test_the_other_foot_is_named_where_the_positions_show_it(tmp_path: Path, stated: str, is_other: bool) -> None:
    """At a northing of 5,300 km the two feet are 10.6 m apart."""
    crs = parse_crs(FEET.format(stated))
    utm = parse_crs("EPSG:32633")
    ratio = US_OVER_INTERNATIONAL if stated == "us-ft" else 1.0 / US_OVER_INTERNATIONAL

    def written(place: Coordinates) -> Coordinates:
        from splatpipe.pipeline.survey.crs.crs import to_geodetic

        geodetic = to_geodetic(np.array([place]), utm).geodetic
        there = from_geodetic(open_operation(crs, *geodetic[0, :2].tolist(), True), crs, geodetic)[0]
        east, north, up = there.tolist()
        return (east * ratio, north * ratio, up) if is_other else (east, north, up)

    said = contradictions(tmp_path, written, FEET.format(stated))
    other = "international feet" if stated == "us-ft" else "US survey feet"
    assert (f"its coordinates are in {other}" in said) == is_other
    assert bool(said) == is_other


def bottom(lines: list[Row]) -> list[Row]:
    """Rows counted from the bottom of the photo."""
    return [replace(row, pixel=(row.pixel[0], 900.0 - row.pixel[1])) for row in lines]


def test_three_points_none_of_whose_marks_agree_stop_without_a_cause(tmp_path: Path) -> None:
    """Three can contradict: enough to refuse the file, too few to name why."""
    few = [row for name in NAMES[:3] for row in rows((name,))[:3]]
    parts = capture_parts(tmp_path, true_model(points=300), positions("gps", (3.0, 5.0)), gcp_list(bottom(few)))
    (tmp_path / "out").mkdir()
    with pytest.raises(SplatpipeError, match="contradict each other") as caught:
        run(GeorefConfig(adjust="off"), Inputs(parts, tmp_path / "photos"), tmp_path / "out", Notes())
    assert "looks like" not in caught.value.hint and "rows from the top" in caught.value.hint


def test_one_wrong_mark_of_three_is_left_out_and_told(tmp_path: Path) -> None:
    few = rows(("P01",))[:3]
    few[0] = bottom(few[:1])[0]
    parts = capture_parts(tmp_path, true_model(points=300), positions("gps", (3.0, 5.0)), gcp_list(few))
    (tmp_path / "out").mkdir()
    notes = Notes()
    run(GeorefConfig(adjust="off"), Inputs(parts, tmp_path / "photos"), tmp_path / "out", notes)
    assert any("disagree with its other marks" in text for text in notes.warnings)
