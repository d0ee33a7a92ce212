"""Control points marked in a real browser, against the demo's truth; and everything that a mark must survive."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from marked_points import POINTS, TRUTH, by_gps_alone, marks_in, read_points

from splatpipe.pipeline.app.view.marking.marking import Marking, WrongRequestError
from splatpipe.pipeline.app.view.marking.marking_job import open_job
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.runs.run_folder import open_run_folder
from splatpipe.pipeline.photos.files.names import NameFinder
from splatpipe.pipeline.survey.files.control_edit import ControlText
from splatpipe.pipeline.survey.placing.level import Positions
from splatpipe.stages.line import LINE


@pytest.fixture(scope="module")
def gps_run(demo_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return by_gps_alone(demo_run, tmp_path_factory.mktemp("survey"))


def test_the_page_says_what_cannot_be_marked(gps_run: Path, tmp_path: Path) -> None:
    def message(points: Path | None = None) -> str:
        with pytest.raises(SplatpipeError) as caught:
            Marking(open_job(open_run_folder(gps_run, LINE), points))
        return f"{caught.value.message} {caught.value.hint}"

    (gps_run.parent / "photos of a house" / "gcp_list.txt").unlink(missing_ok=True)
    assert "--points FILE" in message()
    points = tmp_path / "points.csv"
    assert "cannot be read" in message(points)
    points.write_text("name,x,y,z\nP1,1,2,3\n")
    assert "states no CRS" in message(points)
    points.write_text("EPSG:32633\n")
    assert "points.csv" in message(points)
    points.write_bytes(b"\x00\xff" * 100)
    assert "not UTF-8 text" in message(points)
    control = gps_run.parent / "photos of a house" / "gcp_list.txt"
    control.write_text("EPSG:25833\n388710 5299705 512 1 2 DJI_0001.JPG P99\n")
    points.write_text(POINTS)
    assert "One control file has one CRS" in message(points)
    control.write_text("EPSG:32633\n388711 5299705 512 1 2 DJI_0001.JPG P01\n")
    assert "other coordinates" in message(points)
    control.unlink()
    points.write_text(POINTS.replace("EPSG:32633", "EPSG:25832"))  # the neighbour's zone
    assert "km from the photos" in message(points)


def test_the_page_opens_before_anything_is_marked(gps_run: Path, tmp_path: Path) -> None:
    (gps_run.parent / "photos of a house" / "gcp_list.txt").unlink(missing_ok=True)
    points = tmp_path / "points.csv"
    points.write_text(POINTS)
    marking = Marking(open_job(open_run_folder(gps_run, LINE), points))
    overview = marking.overview()
    assert [point["marks"] for point in overview["points"]] == [0] * len(TRUTH)
    assert marking.detail(overview["points"][0]["name"])["photos"]


def test_three_points_determine_a_frame_if_photos_have_no_positions(gps_run: Path, tmp_path: Path) -> None:
    """Before that no positions are predicted; then all others are, to a few pixels. Wrong marks are reported."""
    job = open_job(open_run_folder(gps_run, LINE), gps_run.parent / "points.csv")
    text = ControlText.begin(tmp_path / "gcp_list.txt", "EPSG:32633", False, NameFinder(job.photos))
    marking = Marking(replace(job, frame=None, positions=Positions({}, {}), text=text))
    assert not marking.overview()["placed"]
    assert all(row["predicted"] is None for row in marking.detail("P07")["photos"])
    first = next(iter(TRUTH["P01"]["seen_px"].items()))
    marking.change("P01", first[0], tuple(first[1]))
    rows = {row["name"]: row for row in marking.detail("P01")["photos"]}
    for photo, pixel in list(TRUTH["P01"]["seen_px"].items())[1:]:  # the ray of the only mark runs through the point
        assert beside(rows[photo]["line"], pixel) < 2.0
    for name in ("P01", "P04", "P05", "P16"):
        for photo, (x, y) in list(TRUTH[name]["seen_px"].items())[:4]:
            marking.change(name, photo, (x, y))
    overview = marking.overview()
    assert overview["placed"] and overview["heights_tied"] and not overview["warnings"]
    assert max(overview["expected_m"]) < 0.1
    rows = {row["name"]: row for row in marking.detail("P07")["photos"]}
    for photo, pixel in TRUTH["P07"]["seen_px"].items():
        assert rows[photo]["predicted"] == pytest.approx(pixel, abs=8.0)
    photo, (x, y) = list(TRUTH["P01"]["seen_px"].items())[4]
    marking.change("P01", photo, (x + 60.0, y))
    assert [point["name"] for point in marking.overview()["points"] if point["wrong"]] == ["P01"]
    row = next(row for row in marking.detail("P01")["photos"] if row["name"] == photo)
    assert not row["agrees"] and row["residual_px"] == pytest.approx([-60.0, 0.0], abs=2.0)
    for wrong in (("P0", photo, None), ("P01", "none.jpg", None), ("P01", photo, (-1.0, 0.0))):
        with pytest.raises(WrongRequestError):
            marking.change(*wrong)


def beside(line: list[list[float]], pixel: list[float]) -> float:
    """Distance of a pixel from a line of straight pieces."""
    a, b = np.array(line[:-1]), np.array(line[1:])
    along = np.clip(((np.array(pixel) - a) * (b - a)).sum(1) / np.maximum(((b - a) ** 2).sum(1), 1e-9), 0.0, 1.0)
    return float(np.linalg.norm(a + along[:, None] * (b - a) - pixel, axis=1).min())


def test_detected_targets_count_like_marks_and_are_never_written(gps_run: Path, tmp_path: Path) -> None:
    """A user's mark replaces a detection; a removed mark is detected again; a hidden one is not."""
    job = open_job(open_run_folder(gps_run, LINE), gps_run.parent / "points.csv")
    assert job.found == {}
    file = tmp_path / "gcp_list.txt"
    text = ControlText.begin(file, "EPSG:32633", False, NameFinder(job.photos))
    found = {name: {photo: tuple(at) for photo, at in TRUTH[name]["seen_px"].items()} for name in ("P01", "P04", "P05")}
    marking = Marking(replace(job, text=text, found=found))
    here, (x, y) = next(iter(found["P01"].items()))

    def seen() -> tuple[object, bool, bool]:
        row = next(row for row in marking.detail("P01")["photos"] if row["name"] == here)
        return row["mark"], row["found"], row["hidden"]

    def counts() -> tuple[int, int]:
        point = next(point for point in marking.overview()["points"] if point["name"] == "P01")
        return point["marks"], point["found"]

    every = len(found["P01"])
    overview = marking.overview()
    assert overview["tables"]["control"]["count"] == 3 and not overview["warnings"] and not overview["exists"]
    assert counts() == (every, every) and seen() == ([round(x, 2), round(y, 2)], True, False)
    marking.change("P01", here, (x + 1.0, y))
    assert counts() == (every, every - 1) and seen() == ([round(x + 1.0, 2), round(y, 2)], False, False)
    assert list(marks_in(file)) == [("P01", here)]  # and no other of those that were found
    marking.change("P01", here, None)
    assert counts() == (every, every) and seen()[1] and read_points(file) == []
    marking.change("P01", here, "hidden")
    assert counts() == (every - 1, every - 1) and seen() == (None, False, True)
    marking.undo()
    assert counts() == (every, every) and seen()[1] and "not visible" not in file.read_text()
