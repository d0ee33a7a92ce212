"""The node's page in a real browser: a folder is dropped, checked, run to its end, and the results are opened."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from marked_points import POINTS
from node_process import StartedNode, drop, started
from PIL import Image
from playwright.sync_api import Locator, Page, expect
from timeouts import TIMEOUT_S

from splatpipe.demo import capture_path

PIXELS = 400  # of the longer side: enough to be matched and placed
PHOTOS = 8
BUDGET = "15s"  # of the run: its training is short
RUN_MS = 600_000.0  # until a run has ended, on a busy machine


@pytest.fixture(autouse=True, scope="module")
def patience() -> Iterator[None]:
    """Wait as long as elsewhere for what the page shall show: this machine may be busy."""
    expect.set_options(timeout=1000.0 * TIMEOUT_S)
    yield
    expect.set_options(timeout=5000.0)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as it comes from the field: small photos in a folder, points beside it, and what no run needs."""
    site = tmp_path_factory.mktemp("field") / "house north"
    photos = site / "DCIM" / "100MEDIA"
    photos.mkdir(parents=True)
    for path in sorted(capture_path().glob("*.JPG"))[-PHOTOS:]:
        with Image.open(path) as photo:
            exif = photo.info["exif"]
            photo.thumbnail((PIXELS, PIXELS))
            photo.save(photos / path.name, exif=exif, quality=90)
    (site / "control.csv").write_text(POINTS)
    (site / "notes.docx").write_bytes(b"PK")
    (site / ".DS_Store").write_bytes(b"\0")
    return site


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StartedNode]:
    with started(tmp_path_factory.mktemp("node"), "--port", 0) as running:
        yield running


def job(page: Page, name: str = "house north") -> Locator:
    return page.locator(".job", has=page.get_by_role("heading", name=name, exact=True))


def fits(page: Page) -> bool:
    """Whether nothing is wider than the window."""
    return bool(page.evaluate("document.documentElement.scrollWidth <= innerWidth"))


def test_a_folder_is_dropped_checked_run_and_its_results_are_opened(
    node: StartedNode, site: Path, open_page: Callable
) -> None:
    watched = open_page(node.page)
    page = watched.page
    drop(page, page.locator(".zone"), [site])
    card = job(page)
    expect(card.get_by_text(f"All {PHOTOS + 1} files are here.")).to_be_visible()
    expect(card.get_by_text("1 file of the folder is not used: notes.docx.")).to_be_visible()
    expect(card.get_by_role("region", name="what the check found")).to_be_visible(timeout=RUN_MS)
    expect(card.locator(".forecast").first).to_contain_text("of memory")
    with page.expect_popup() as opened:
        card.get_by_role("link", name="map of the overlap").click()
    expect(opened.value.locator(".drawn svg")).to_be_visible()
    opened.value.close()
    card.get_by_label("preview").check()
    card.get_by_text("More options").click()
    card.get_by_label("Quality of keypoints").select_option("lowest")
    card.get_by_label("Time budget").fill(BUDGET)
    card.get_by_role("button", name="Start", exact=True).focus()
    page.keyboard.press("Enter")
    expect(card.locator(".state")).to_have_text("Finished", timeout=RUN_MS)
    with page.expect_popup() as opened:
        card.get_by_role("link", name="Report", exact=True).click()
    expect(opened.value.get_by_role("heading", level=1)).to_be_visible()
    assert opened.value.evaluate("origin") == "null"
    opened.value.close()
    with page.expect_popup() as opened:
        card.get_by_role("link", name="3D viewer").click()
    opened.value.wait_for_load_state("load")
    opened.value.evaluate("splatpipe.ready")
    opened.value.close()
    with page.expect_download() as saved:
        card.get_by_role("link", name="All files (all.zip)").click()
    assert saved.value.suggested_filename == "all.zip"
    assert watched.errors == [] and all(url.startswith(node.address) for url in watched.requests)


def test_control_points_of_a_finished_run_are_marked_from_the_page(node: StartedNode, open_page: Callable) -> None:
    page = open_page(node.page).page
    job(page).get_by_role("link", name="Mark control points").click()
    page.wait_for_url("**/mark")
    page.evaluate("splatpipe.mark.ready")
    overview = page.evaluate("splatpipe.mark.state()")["overview"]
    assert overview["file"].startswith("control.csv of this job") and overview["command"] == ""
    page.get_by_role("link", name="go back").click()
    expect(job(page)).to_be_visible()


def test_an_upload_goes_on_after_the_page_was_closed(node: StartedNode, site: Path, open_page: Callable) -> None:
    """The network fails in the middle; another page sends only what is missing, and the job is removed at the end."""
    first = open_page(node.page).page
    first.route("**/api/upload/**DJI_0036**", lambda route: route.abort())
    drop(first, first.locator(".zone"), [site / "DCIM"])
    card = job(first, "100MEDIA")
    expect(card.get_by_text(f"{PHOTOS - 1} of {PHOTOS} files")).to_be_visible()
    expect(card.get_by_text("The node does not answer.")).to_be_visible()
    first.close(run_before_unload=False)
    watched = open_page(node.page, width=390, height=844)
    page = watched.page
    card = job(page, "100MEDIA")
    expect(card.get_by_text(f"{PHOTOS - 1} files are here.")).to_be_visible()
    assert fits(page)
    drop(page, card, [site / "DCIM"])
    expect(card.get_by_text(f"All {PHOTOS} files are here.")).to_be_visible()
    assert [url.rpartition("=")[2] for url in watched.requests if "/api/upload/" in url] == ["DJI_0036.JPG"]
    card.get_by_role("button", name="Remove").click()
    page.get_by_role("dialog").get_by_role("button", name="Remove it").click()
    expect(card).to_have_count(0)


def test_what_cannot_be_a_capture_is_said_at_once(node: StartedNode, tmp_path: Path, open_page: Callable) -> None:
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "offer.docx").write_bytes(b"PK")
    page = open_page(node.page).page
    drop(page, page.locator(".zone"), [tmp_path / "letters"])
    expect(page.locator("#reading")).to_contain_text("There are no photos in this. It has 1 file of other kinds")
