"""The preflight page in a real browser: it fits the screen, and requests nothing."""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from check_grid import grid
from playwright.sync_api import expect

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.preflight.finding_pictures import MAX_PER_FINDING, MAX_PICTURES
from splatpipe.pipeline.app.preflight.findings import (
    ControlPlace,
    Finding,
    Gap,
    LeftOutPhoto,
    MatchedPair,
    Preflight,
    PresetForecast,
    worst_first,
)
from splatpipe.pipeline.app.preflight.map_frame import WIDTH, frame_of
from splatpipe.pipeline.app.preflight.overlap_map import MAX_PAIRS
from splatpipe.pipeline.app.preflight.page import write_page

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


def words(watched: object) -> str:
    return " ".join(watched.page.evaluate("document.body.innerText").split())  # type: ignore[attr-defined]


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
