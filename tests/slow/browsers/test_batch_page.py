"""The batch's page in a real browser."""

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image
from playwright.sync_api import Browser, expect

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.batch.pages.page import REFRESH_S, write_page
from splatpipe.pipeline.app.batch.pages.state import STALE_S, BatchState, CaptureState

SCRIPT = '<script>document.title = "taken"</script><img src="http://example.org/x.png">&"\''


HOSTILE = (SCRIPT, "two\nlines\r\t", "long" * 75, "\u202egpj.exe\u2066", "b\udcffd", "a#b?c%20d", "javascript:alert(1)")


WIDTHS = ((1440, 900), (390, 844))


def batch(*captures: CaptureState, **facts: object) -> BatchState:
    return replace(BatchState("night", captures, as_of_s=time.time(), began_s=time.time() - 3600.0), **facts)


def words(watched: object) -> str:
    return " ".join(watched.page.evaluate("document.body.innerText").split())  # type: ignore[attr-defined]


def full_batch(folder: Path) -> BatchState:
    """A capture in each state, one of them with everything that a card can show."""
    whole = folder / "church"
    whole.mkdir()
    for name in ("report.html", "viewer.html"):
        (whole / name).write_text("<!doctype html>")
    Image.new("RGB", (900, 600), "green").save(whole / "best.jpg")
    return batch(
        CaptureState("lund", "failed", "sparse", reason="Only 3 of 29 photos could be placed.", hint="Add overlap.",
                     tries=2, earlier=("train: killed by signal 9",), seconds=150.0, photos=29),
        CaptureState("seneca", "running", "matches", progress=0.234, left_s=5400.0, photos=167, tries=1, seconds=70.0),
        CaptureState("field", "stopped", "train", reason="The batch was stopped."),
        CaptureState("copr", "waiting", "ingest"),
        CaptureState("church", "done", verdict="Finished; 2 points to look at", level="doubt", seconds=1834.0,
                     picture="church/best.jpg", report="church/report.html", viewer="church/viewer.html"),
        CaptureState("roof", "reused", verdict="Finished", level="good"),
        left_s=6000.0, free_bytes=81_000_000_000, needed_bytes=9_000_000_000, warnings=("Mind the disk.",),
        unlisted=("old",),
    )  # fmt: skip


@pytest.mark.parametrize(("width", "height"), WIDTHS)
def test_one_card_per_capture_fits_the_screen_and_requests_nothing(
    tmp_path: Path, open_page: Callable, width: int, height: int
) -> None:
    write_page(full_batch(tmp_path), tmp_path / "batch.html")
    watched = open_page((tmp_path / "batch.html").as_uri(), width=width, height=height, touch=width < 500)
    assert (watched.requests, watched.errors) == ([], [])
    assert watched.page.evaluate("document.documentElement.scrollWidth") <= width
    cards = watched.page.locator(".capture")
    assert cards.locator("h2").all_inner_texts() == ["lund", "seneca", "field", "church", "roof", "copr"]
    said = words(watched)
    assert "Running: 2 of 6 captures finished, 1 failed" in said and "About 1.7 h left" in said
    assert "81.00 GB are free on the disk; the remaining stages need about 9.00 GB" in said
    assert "Only 3 of 29 photos could be placed. Add overlap." in said and "Mind the disk." in said
    assert "Running in matches 23 %, about 1.5 h left" in said
    assert watched.page.locator("progress").get_attribute("value") == "23"
    church = cards.filter(has_text="church")
    links = church.locator("a").evaluate_all("all => all.map(a => a.href)")
    assert links == [(tmp_path / "church" / name).as_uri() for name in ("report.html", "viewer.html")]
    assert cards.locator("a").count() == 2  # no other has a report yet
    assert church.locator("img").evaluate("image => image.naturalWidth > 0 && image.naturalWidth <= 480")
    for title in ("Failed", "Running", "Stopped", "Waiting", "Done", "Finished before"):
        link = watched.page.locator(".counts a", has_text=title)
        assert watched.page.locator(str(link.get_attribute("href"))).count() == 1
    silent = watched.page.locator("[data-silent]")
    expect(silent).to_be_hidden()


@pytest.mark.parametrize(("width", "height"), WIDTHS)
def test_hostile_names_and_messages_stay_text(tmp_path: Path, open_page: Callable, width: int, height: int) -> None:
    captures = [
        CaptureState(name, "failed", name, verdict=name, level="bad", reason=name, hint=name, earlier=(name,), tries=2,
                     picture=f"{name}/x.jpg", report=f"../{name}", viewer=f"/etc/{name}")
        for name in HOSTILE
    ]  # fmt: skip
    odd = tmp_path / "a#b?c%20d"
    odd.mkdir()
    (odd / "report.html").write_text("<!doctype html>")
    captures[5] = replace(captures[5], report="a#b?c%20d/report.html", state="running")
    (tmp_path.parent / SCRIPT.replace("/", "")).write_text("outside")
    captures[0] = replace(captures[0], report=f"../{SCRIPT.replace('/', '')}", viewer=str(capture_path()))
    state = batch(*captures, name=SCRIPT, message=SCRIPT, warnings=HOSTILE, unlisted=HOSTILE)
    write_page(state, tmp_path / "batch.html")
    watched = open_page((tmp_path / "batch.html").as_uri(), width=width, height=height, touch=width < 500)
    assert (watched.requests, watched.errors) == ([], [])
    assert watched.page.evaluate("document.documentElement.scrollWidth") <= width
    assert watched.page.locator("script").count() == 1
    assert watched.page.title().startswith("▶ Running")  # not "taken"
    assert words(watched).count('document.title = "taken"') >= 5
    text = (tmp_path / "batch.html").read_text(encoding="utf-8")
    assert "\u202e" not in text and "\u2066" not in text
    links = watched.page.locator(".capture a").evaluate_all("all => all.map(a => a.href)")
    assert links == [(odd / "report.html").as_uri()]


def test_during_the_batch_it_reloads_itself_and_nothing_else(tmp_path: Path, open_page: Callable) -> None:
    path = tmp_path / "batch.html"
    state = batch(CaptureState("one", "running", "train", progress=0.25))
    write_page(state, path)
    path.write_text(path.read_text().replace(f'data-refresh="{REFRESH_S}"', 'data-refresh="1"'))
    watched = open_page(path.as_uri())
    end = replace(state, captures=(CaptureState("one", "done", progress=1.0),), ended_s=time.time(), exit_code=0)
    write_page(end, path)
    expect(watched.page.locator("h2").first).to_have_text("The capture succeeded")
    assert (watched.requests, watched.errors) == ([], [])
    assert watched.page.locator("script").count() == watched.page.locator("noscript").count() == 0  # and then no more
    assert "1 h 00 min" in words(watched)


def test_pause_stops_the_refresh(tmp_path: Path, open_page: Callable) -> None:
    path = tmp_path / "batch.html"
    write_page(batch(CaptureState("one", "running", "train")), path)
    path.write_text(path.read_text().replace(f'data-refresh="{REFRESH_S}"', 'data-refresh="2"'))
    watched = open_page(path.as_uri())
    loads: list[str] = []
    watched.page.on("load", lambda page: loads.append(page.url))
    watched.page.get_by_role("button", name="Pause").click()
    watched.page.wait_for_timeout(4500)
    assert loads == []
    watched.page.get_by_role("button", name="Resume refreshing").click()
    watched.page.wait_for_event("load")


def test_without_scripts_the_browser_refreshes_it(tmp_path: Path, browser: Browser) -> None:
    path = tmp_path / "batch.html"
    write_page(batch(CaptureState("one", "running", "train")), path)
    path.write_text(path.read_text().replace(f'refresh" content="{REFRESH_S}"', 'refresh" content="1"'))
    with browser.new_context(java_script_enabled=False) as context:
        page = context.new_page()
        page.goto(path.as_uri())
        write_page(batch(CaptureState("one", "failed", "train"), ended_s=time.time(), exit_code=3), path)
        expect(page.locator("h2").first).to_have_text("1 of 1 capture failed; 0 finished", timeout=60_000)


def test_a_page_that_is_no_longer_updated_says_so(tmp_path: Path, open_page: Callable) -> None:
    """After a power cut the end of the batch is not recorded: the reader's clock reveals it."""
    path = tmp_path / "batch.html"
    write_page(batch(CaptureState("one", "running"), as_of_s=time.time() - STALE_S - 30.0), path)
    watched = open_page(path.as_uri())
    expect(watched.page.locator("[data-silent]")).to_be_visible()
    assert "(1 min ago)" in words(watched) and "Repeat the command to resume" in words(watched)


def test_two_hundred_captures_stay_a_small_page(tmp_path: Path, open_page: Callable) -> None:
    for i in range(4):
        noise = Image.frombytes("RGB", (480, 360), os.urandom(480 * 360 * 3))
        noise.save(tmp_path / f"{i}.jpg", quality=95)
    captures = [
        CaptureState(f"capture-{i:03}", "done", verdict="Finished", level="good", picture=f"{i % 4}.jpg")
        for i in range(200)
    ]
    path = tmp_path / "batch.html"
    write_page(batch(*captures), path)
    assert path.stat().st_size < 12_000_000  # for pure noise; photos take a third
    watched = open_page(path.as_uri(), width=390, height=844, touch=True)
    assert (watched.requests, watched.errors) == ([], [])
    assert watched.page.locator(".capture img").count() == 200
