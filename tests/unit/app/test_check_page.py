"""The preflight page: a single file with map and images, whatever the photos' names and number."""

import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from check_grid import REACH_M, grid

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.preflight.coverage import CELLS, STEPS, count_footprints, shades
from splatpipe.pipeline.app.preflight.finding_pictures import finding_pictures
from splatpipe.pipeline.app.preflight.findings import (
    Finding,
    LeftOutPhoto,
)
from splatpipe.pipeline.app.preflight.map_frame import WIDTH, frame_of
from splatpipe.pipeline.app.preflight.overlap_map import Labels
from splatpipe.pipeline.app.preflight.page import check_page


@pytest.fixture(scope="module")
def demo_names() -> list[str]:
    return sorted(path.name for path in capture_path().glob("*.JPG"))


def test_overlap_counts_the_footprints_that_contain_a_place(demo_names: list[str]) -> None:
    preflight = grid(capture_path(), demo_names)
    frame = frame_of(preflight)
    assert frame is not None
    counts = count_footprints(frame, [photo.footprint_m for photo in preflight.photos if photo.footprint_m])
    cell = WIDTH / CELLS
    for place in ((25.0, 25.0), (-10.0, -10.0), (-13.0, 20.0), (52.0, 3.0)):
        x, y = frame.point(place)
        row, column = int(y / cell), int(x / cell)
        east = frame.west + (column + 0.5) * cell * frame.metres / WIDTH
        north = frame.north - (row + 0.5) * cell * frame.metres / WIDTH
        centres = [photo.position_m for photo in preflight.photos if photo.position_m]
        true = sum(abs(e - east) < REACH_M and abs(n - north) < REACH_M for e, n, _ in centres)
        assert counts[row, column] == true > 0
    assert counts[0, 0] == 0
    cells = [0] * len(STEPS)
    for step, d in enumerate(shades(counts)):
        runs = [tuple(map(int, run)) for run in re.findall(r"M(\d+) (\d+)h(\d+)v(\d+)h-\d+z", d)]
        cells[step] = round(sum(wide * high for _, _, wide, high in runs) / cell**2)
    bounds = [*STEPS, 10_000]
    assert cells == [int(((counts >= a) & (counts < b)).sum()) for a, b in pairwise(bounds)]


def test_a_finding_on_the_whole_capture_shows_example_photos(demo_names: list[str]) -> None:
    findings = (
        Finding("orphan", "warning", "1 of 40 photos matches no other one."),
        Finding("gap", "warning", f"Photos are missing between {demo_names[4]} and {demo_names[5]}: 80 m apart."),
        Finding("blurred", "warning", "All photos are dull."),
        Finding("nadir-only", "warning", "All photos look straight down."),
    )
    preflight = grid(capture_path(), demo_names, findings=findings)
    photos = tuple(replace(it, sharpness=0.5 + 0.01 * i) for i, it in enumerate(preflight.photos))
    photo_names = [
        [it.name for it in pictures if not it.beside]
        for pictures in finding_pictures(replace(preflight, photos=photos))
    ]
    assert photo_names == [demo_names[-1:], demo_names[4:6], demo_names[:3], []]


def test_names_on_the_map_do_not_cover_each_other() -> None:
    labels = Labels()
    assert labels.room(100, 100, "P01", "start") == "everywhere"
    assert labels.room(110, 105, "P02", "start") == ""
    assert labels.room(100, 145, "P03", "start") == "wide"  # with larger letters there is no room
    assert labels.room(100, 300, "P04", "end") == "everywhere"


@pytest.mark.parametrize(
    ("severities", "level", "headline"),
    [
        ((), "good", "No problems found"),
        (("note",), "good", "No problems found"),
        (("warning", "note"), "doubt", "One point to resolve before you leave"),
        (("warning", "warning"), "doubt", "2 points to resolve before you leave"),
        (("error", "warning"), "bad", "This capture cannot be reconstructed as it stands"),
    ],
)
def test_the_verdict_is_that_of_the_worst_finding(severities: tuple[str, ...], level: str, headline: str) -> None:
    findings = tuple(Finding("code", severity, "Something.") for severity in severities)  # type: ignore[arg-type]
    page = check_page(grid(Path("/nowhere"), ["a.jpg", "b.jpg"], findings=findings))
    assert f'<section class="verdict {level}"' in page and f"<h2>{headline}</h2>" in page


def test_no_folder_of_this_machine_is_named(tmp_path: Path) -> None:
    finding = Finding("control", "error", f"{tmp_path}/gcp_list.txt: line 4 is broken.", "See /home/somebody/a.txt.")
    page = check_page(grid(tmp_path, ["a.jpg", "b.jpg"], findings=(finding,)))
    assert "PHOTOS/gcp_list.txt: line 4 is broken." in page and "See a.txt." in page
    assert str(tmp_path.parent) not in page and "somebody" not in page


def test_a_folder_without_a_photo_still_has_a_page() -> None:
    page = check_page(grid(Path("/nowhere"), [], components=(), left_out=(LeftOutPhoto("a.jpg", "is no picture"),)))
    assert "There are no usable photos" in page and "<svg" not in page
