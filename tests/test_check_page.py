"""The preflight page: a single file with map and images, whatever the photos' names and number."""

import os
import re
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import expect

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.preflight.coverage import CELLS, STEPS, count_footprints, shades
from splatpipe.pipeline.app.preflight.finding_pictures import MAX_PER_FINDING, MAX_PICTURES, finding_pictures
from splatpipe.pipeline.app.preflight.findings import (
    ControlPlace,
    Finding,
    Gap,
    LeftOutPhoto,
    MachineFacts,
    MatchedPair,
    PhotoFacts,
    Preflight,
    PresetForecast,
    worst_first,
)
from splatpipe.pipeline.app.preflight.map_frame import WIDTH, frame_of
from splatpipe.pipeline.app.preflight.overlap_map import MAX_PAIRS, Labels
from splatpipe.pipeline.app.preflight.page import check_page, write_page

WIDTHS = ((1440, 900), (390, 844))
SCRIPT = '<script>document.title = "taken"</script><img src="http://example.org/x.png">&"\''
HOSTILE = (
    SCRIPT,
    "two\nlines\r\t.jpg",
    "long" * 75,
    "\u202egpj.exe\u2066",
    "b\udcffd.jpg",
    "../outside.jpg",
    "/etc/passwd",
)
STEP_M, REACH_M = 10.0, 14.0  # between the photos of the grid, and from a photo to the sides of its footprint


def words(watched: object) -> str:
    return " ".join(watched.page.evaluate("document.body.innerText").split())  # type: ignore[attr-defined]


def grid(folder: Path, names: list[str], columns: int = 6, **facts: object) -> Preflight:
    """Photos in a grid, each matched with the next; the last matches no other."""
    photos = []
    for i, name in enumerate(names):
        east, north = STEP_M * (i % columns), STEP_M * (i // columns)
        corners = [(east + x * REACH_M, north + y * REACH_M) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        time_of = f"2026-06-18T13:{i // 60 % 60:02}:{i % 60:02}"
        photos.append(
            PhotoFacts(name, 1200, 900, 1, 0, time_of, (east, north, 40.0), tuple(corners), 1.0, 0.0, 120.0, 2)
        )
    last = len(photos) - 1
    pairs = tuple(MatchedPair(i, i + 1, 20 + i) for i in range(last - 1))
    machine = MachineFacts(8_000_000_000, 2, 81_000_000_000)
    pieces = (tuple(range(last)), (last,))
    made = Preflight(folder, tuple(photos), (), (), (52.0, 13.0), pairs, pieces, (), (), (), machine, time.time(), 21.3)
    return replace(made, **facts)


@pytest.fixture(scope="module")
def demo_names() -> list[str]:
    return sorted(path.name for path in capture_path().glob("*.JPG"))


def full(names: list[str]) -> Preflight:
    findings = worst_first([
        Finding("unreadable", "error", "1 photo cannot be read.", "Copy it again.", ("broken.jpg",)),
        Finding("blurred", "warning", "1 photo is blurred.", "Take it again.", (names[3],)),
        Finding("underexposed", "warning", "1 photo is darker than its neighbours.", "", (names[5],)),
        Finding("nadir_only", "note", "All photos look straight down.", "Add slanting ones."),
    ])  # fmt: skip
    preflight = grid(
        capture_path(),
        names,
        findings=findings,
        left_out=(LeftOutPhoto("broken.jpg", "ends before its picture does"),),
        gaps=(Gap(((10.0, 10.0), (30.0, 10.0), (30.0, 30.0), (10.0, 30.0)), "Two strips lie too far apart."),),
        control=(
            ControlPlace("P01", "control", (5.0, 5.0), 7, 5),
            ControlPlace("P02", "check", (40.0, 50.0), 4, 4),
            ControlPlace("P03", "control", (4000.0, 5.0), 0, 0),
        ),
        forecasts=(
            PresetForecast("preview", 1_200_000_000, 300.0, 150.0, 800_000_000),
            PresetForecast("high", 9_800_000_000, 60_000.0, 30_000.0, 6_100_000_000, "It lacks 1.8 GB of memory."),
        ),
    )
    photos = list(preflight.photos)
    photos[3] = replace(photos[3], sharpness=0.41)
    photos[5] = replace(photos[5], brightness_ev=-1.6)
    return replace(preflight, photos=tuple(photos))


@pytest.mark.parametrize(("width", "height"), WIDTHS)
def test_it_fits_the_screen_and_requests_nothing(
    tmp_path: Path, open_page: Callable, demo_names: list[str], width: int, height: int
) -> None:
    path = tmp_path / "check.html"
    write_page(full(demo_names), path)
    watched = open_page(path.as_uri(), width=width, height=height, touch=width < 500)
    assert (watched.requests, watched.errors) == ([], [])
    assert watched.page.evaluate("document.documentElement.scrollWidth") <= width
    said = words(watched)
    assert said.index("This capture cannot be reconstructed as it stands") < said.index("Two strips lie too far apart.")
    assert "41 % as sharp as its neighbours" in said and "−1.6 EV" in said and "cannot be read" in said
    assert "8.3 h" in said and "17 h" in said and "9.80 GB" in said and "It lacks 1.8 GB of memory." in said
    assert watched.page.locator(".verdict li").count() == watched.page.locator("article.finding-card").count() == 4
    every = "[...document.images].every(image => image.complete && image.naturalWidth > 0)"
    assert watched.page.evaluate(every)
    assert watched.page.locator("img").count() == 3  # blurred, one beside it, and the dark one
    anchors = watched.page.eval_on_selector_all("a[href]", "all => all.map(a => a.getAttribute('href'))")
    assert anchors and all(watched.page.locator(anchor).count() == 1 for anchor in anchors)


def test_the_map_marks_gaps_orphans_doubts_and_control_where_they_are(
    tmp_path: Path, open_page: Callable, demo_names: list[str]
) -> None:
    preflight = full(demo_names)
    path = tmp_path / "check.html"
    write_page(preflight, path)
    watched = open_page(path.as_uri())
    drawn = watched.page.locator(".drawn")
    frame = frame_of(preflight)
    assert frame is not None
    counts = {kind: drawn.locator(f".photo.{kind}").count() for kind in ("plain", "doubtful", "orphan")}
    assert counts == {"plain": len(demo_names) - 3, "doubtful": 2, "orphan": 1}
    orphan = drawn.locator(".photo.orphan")
    east, north, _ = preflight.photos[-1].position_m or (0.0, 0.0, 0.0)
    x, y = frame.point((east, north))
    assert orphan.get_attribute("d") == f"M{x} {y}h0"
    assert demo_names[-1] in str(orphan.locator("title").text_content())
    scale = WIDTH / frame.metres  # a metre to the east and to the north, as drawn
    assert np.allclose(np.subtract(frame.point((1.0, 0.0)), frame.point((0.0, 1.0))), (scale, scale), atol=1.01)
    assert drawn.locator(".gap").count() == 1 and drawn.locator(".gap-number").text_content() == "1"
    far = drawn.locator(".control.poor title")
    assert "P03" in str(far.text_content()) and "outside it" in str(far.text_content())
    assert 0.0 < preflight.control[0].position_m[0] < frame.metres  # outliers do not shrink the rest
    assert drawn.locator("text", has_text="P0").count() == 3
    pairs = watched.page.locator(".layer-pairs")
    expect(pairs).to_be_visible()
    watched.page.get_by_label("matched pairs").uncheck()
    expect(pairs).to_be_hidden()
    expect(watched.page.locator(".layer-footprints")).to_be_hidden()
    watched.page.get_by_label("outlines").check()
    expect(watched.page.locator(".layer-footprints")).to_be_visible()
    assert watched.errors == []


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


def test_without_positions_the_photos_are_drawn_in_a_ring(
    tmp_path: Path, open_page: Callable, demo_names: list[str]
) -> None:
    placed = grid(capture_path(), demo_names, findings=(Finding("no_positions", "note", "No photo has a position."),))
    photos = tuple(replace(photo, position_m=None, footprint_m=None) for photo in placed.photos)
    path = tmp_path / "check.html"
    write_page(replace(placed, photos=photos, origin=None), path)
    watched = open_page(path.as_uri(), width=390, height=844, touch=True)
    assert (watched.requests, watched.errors) == ([], [])
    assert watched.page.evaluate("document.documentElement.scrollWidth") <= 390
    assert "No photo has a position" in words(watched) and "No problems found" in words(watched)
    assert watched.page.locator(".drawn .photo").count() == len(demo_names)
    assert watched.page.locator(".layer-overlap").count() == watched.page.locator(".drawn .scale").count() == 0
    assert watched.page.locator(".drawn .photo.orphan").count() == 1


@pytest.mark.parametrize(("width", "height"), WIDTHS)
def test_hostile_names_stay_text_and_open_nothing(
    tmp_path: Path, open_page: Callable, demo_names: list[str], width: int, height: int
) -> None:
    photos = tmp_path / SCRIPT.replace("/", "|")
    photos.mkdir()
    shutil.copy(capture_path() / demo_names[0], tmp_path / "outside.jpg")
    findings = [Finding(name, "warning", name, name, (name,)) for name in HOSTILE]
    findings.append(Finding("blurred", "error", "Blurred.", "", HOSTILE))
    control = tuple(ControlPlace(name, "check", (10.0 * i, 5.0), 1, 0) for i, name in enumerate(HOSTILE))
    preflight = grid(photos, list(HOSTILE), findings=tuple(findings), control=control)
    gap = Gap(((0.0, 0.0), (9.0, 0.0), (9.0, 9.0)), SCRIPT)
    forecast = PresetForecast(SCRIPT, 1, 1.0, 1.0, 1, SCRIPT)
    path = tmp_path / "check.html"
    write_page(replace(preflight, gaps=(gap,), forecasts=(forecast,)), path)
    watched = open_page(path.as_uri(), width=width, height=height, touch=width < 500)
    assert (watched.requests, watched.errors) == ([], [])
    assert watched.page.evaluate("document.documentElement.scrollWidth") <= width
    assert watched.page.title().startswith("This capture cannot") and watched.page.locator("script").count() == 0
    assert words(watched).count('document.title = "taken"') >= 5
    assert watched.page.locator("img").count() == 0  # files outside the folder are not read
    text = path.read_text(encoding="utf-8")
    assert "\u202e" not in text and "\u2066" not in text


def test_images_are_few_and_a_truncated_photo_shows_what_there_is(
    tmp_path: Path, open_page: Callable, demo_names: list[str]
) -> None:
    for name in demo_names[:12]:
        os.link(capture_path() / name, tmp_path / name)
    whole = (capture_path() / demo_names[12]).read_bytes()
    (tmp_path / demo_names[12]).write_bytes(whole[: len(whole) // 2])
    findings = [Finding("cut_off", "error", "A file is cut off.", "", (demo_names[12],))]
    findings += [Finding(f"code{i}", "warning", f"Finding {i}.", "", tuple(demo_names[:12])) for i in range(9)]
    path = tmp_path / "check.html"
    write_page(grid(tmp_path, demo_names, findings=tuple(findings)), path)
    watched = open_page(path.as_uri())
    figures = [card.locator("img").count() for card in watched.page.locator("article.finding-card").all()]
    assert figures[:2] == [1, MAX_PER_FINDING] and sum(figures) == MAX_PICTURES
    assert (
        watched.page.locator("article.finding-card").nth(2).locator("details bdi").all_text_contents()
        == demo_names[:12]
    )
    picture = watched.page.locator("article.finding-card img").first
    upper = """image => {
        const canvas = Object.assign(document.createElement("canvas"), {width: image.width, height: image.height});
        const context = canvas.getContext("2d");
        context.drawImage(image, 0, 0);
        const grey = [...context.getImageData(0, 0, image.width, image.height / 3).data].filter((_, i) => i % 4 == 1);
        return Math.max(...grey) - Math.min(...grey);
    }"""
    assert picture.evaluate(upper) > 60
    assert path.stat().st_size < 1_500_000


def test_two_thousand_photos_stay_a_page_that_opens(tmp_path: Path, open_page: Callable) -> None:
    names = [f"DJI_{i:04}.JPG" for i in range(2000)]
    preflight = grid(tmp_path, names, columns=50)
    pairs = [MatchedPair(i, i + step, 30 + i % 200) for step in (1, 2, 49, 50, 51) for i in range(2000 - step)]
    path = tmp_path / "check.html"
    write_page(replace(preflight, pairs=tuple(pairs), components=(tuple(range(2000)),)), path)
    assert path.stat().st_size < 1_000_000
    watched = open_page(path.as_uri(), width=390, height=844, touch=True)
    assert (watched.requests, watched.errors) == ([], [])
    assert watched.page.evaluate("document.documentElement.scrollWidth") <= 390
    assert watched.page.locator(".drawn .photo").count() == 2000
    drawn = "".join(path.get_attribute("d") or "" for path in watched.page.locator(".drawn .pair").all())
    assert drawn.count("M") == MAX_PAIRS
    ends = {end for line in drawn.split("M")[1:] for end in line.split("L")}
    assert len(ends) == 2000  # no photo loses all its lines


def test_a_finding_on_the_whole_capture_shows_example_photos(demo_names: list[str]) -> None:
    findings = (
        Finding("orphan", "warning", "1 of 40 photos matches no other one."),
        Finding("gap", "warning", f"Photos are missing between {demo_names[4]} and {demo_names[5]}: 80 m apart."),
        Finding("blurred", "warning", "All photos are dull."),
        Finding("nadir-only", "warning", "All photos look straight down."),
    )
    preflight = grid(capture_path(), demo_names, findings=findings)
    photos = tuple(replace(it, sharpness=0.5 + 0.01 * i) for i, it in enumerate(preflight.photos))
    shown = [
        [it.name for it in pictures if not it.beside]
        for pictures in finding_pictures(replace(preflight, photos=photos))
    ]
    assert shown == [demo_names[-1:], demo_names[4:6], demo_names[:3], []]


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
