"""Control points marked in a real browser, against the demo's truth; and everything that a mark must survive."""

import json
import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import answered
from finished_run import linked_copy
from marked_points import TRUTH, by_gps_alone, marks_in, read_points
from PIL import Image
from playwright.sync_api import Page
from served import Served, reserved_port, serving

from splatpipe.demo import CAPTURE, capture_path
from splatpipe.demo.truth.truth import true_poses
from splatpipe.pipeline.app.view.marking.photo import without_metadata

TWELVE = ("P01", "P02", "P03", "P04", "P05", "P06", "P07", "P08", "P15", "P16", "P17", "P18")


MARKS = 4  # a point


GSD_M = 0.0278  # ground sample distance of the whole capture; that of the marked photos is smaller


@pytest.fixture(scope="module")
def gps_run(demo_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return by_gps_alone(demo_run, tmp_path_factory.mktemp("survey"))


@pytest.fixture
def marking(gps_run: Path) -> Iterator[tuple[Served, Path]]:
    """The server with the control file that it writes, which does not exist at first."""
    file = gps_run.parent / "photos of a house" / "gcp_list.txt"
    file.unlink(missing_ok=True)
    config = (gps_run / "config.toml").read_bytes()
    with serving(gps_run, "--mark", "--points", gps_run.parent / "points.csv") as server:
        assert server.start == "mark"
        yield server, file
    (gps_run / "config.toml").write_bytes(config)


def state(page: Page) -> Any:
    """Return what the page shows, once it has begun and no request is pending."""
    page.evaluate("splatpipe.mark.ready")
    assert page.evaluate("splatpipe.mark.settled()") == 0
    return page.evaluate("splatpipe.mark.state()")


def opened(open_page: Callable, server: Served, *size: object) -> Any:
    watched = open_page(server.page("mark"), *size)
    watched.page.evaluate("splatpipe.mark.ready")
    return watched


def click(page: Page, pixel: list[float]) -> None:
    """Click on a photo's pixel; if it is out of view, after zooming out to the whole photo."""
    if not in_sight(page, page.evaluate("(at) => splatpipe.mark.screenAt(at)", pixel)):
        page.keyboard.press("f")
        page.wait_for_timeout(50)
    page.mouse.click(*page.evaluate("(at) => splatpipe.mark.screenAt(at)", pixel))


def in_sight(page: Page, at: list[float]) -> bool:
    box = page.locator("#canvas").bounding_box()
    assert box is not None
    return box["x"] < at[0] < box["x"] + box["width"] and box["y"] < at[1] < box["y"] + box["height"]


def test_twelve_points_marked_in_the_browser_georeference_the_demo(
    marking: tuple[Served, Path], gps_run: Path, open_page: Callable
) -> None:
    """As a surveyor does it: click and Enter, X where the point cannot be seen; then the command that the page names.

    The limits are those of the georeferencing: check points within a ground pixel, and one and a half in height.
    """
    server, file = marking
    watched = opened(open_page, server, 1000, 640)
    page = watched.page
    page.locator("#file select").select_option("4")
    errors, unseen = [], 0
    for _ in range(400):
        now = state(page)
        done = {point["name"] for point in now["overview"]["points"] if point["marks"] >= MARKS}
        if done >= set(TWELVE):
            break
        if now["overview"]["expected_m"] and (not errors or errors[-1] != now["overview"]["expected_m"]):
            errors.append(now["overview"]["expected_m"])
        point, photo = now["point"], now["photo"]
        if point not in TWELVE or point in done:
            page.keyboard.press("j")
        elif photo in TRUTH[point]["seen_px"]:
            click(page, TRUTH[point]["seen_px"][photo])
            page.keyboard.press("Enter")
        else:
            page.keyboard.press("x")
            unseen += 1
    assert unseen <= len(TWELVE)  # the page seldom asks for a point where something hides it
    assert done >= set(TWELVE)
    assert errors[0][0] > 1.0 and errors[-1][0] < 0.03 and errors[-1][1] < 0.03
    overview = now["overview"]
    assert overview["file"] == str(file) and overview["tables"]["check"]["rmse_horizontal_m"] < 0.03
    assert watched.errors == [] and all(url.startswith(server.address) for url in watched.requests)
    for (name, photo), pixel in marks_in(file).items():
        np.testing.assert_allclose(pixel, TRUTH[name]["seen_px"][photo], atol=0.3)
    command = shlex.split(overview["command"])
    assert command[0] == "splatpipe"
    answered(*command[1:])
    metrics = json.loads((gps_run / "metrics.json").read_text())["accuracy"]
    control, check = (metrics["tables"][role] for role in ("control", "check"))
    assert (control["count"], check["count"]) == (8, 4)
    assert check["rmse_horizontal_m"] <= metrics["gsd_m"] and check["rmse_up_m"] <= 1.5 * metrics["gsd_m"]
    assert metrics["gsd_m"] <= GSD_M
    assert cameras_off_m(gps_run) < 3.0 * GSD_M


def cameras_off_m(out: Path) -> float:
    """Root mean square distance of the cameras from the true ones, in the true frame: no mark, no fit of ours."""
    import pyproj

    georef = json.loads((out / "georef.json").read_text())
    frame = json.loads((CAPTURE / "truth.json").read_text())["frame"]["origin"]
    to_truth = pyproj.Transformer.from_pipeline(
        "+proj=topocentric +ellps=WGS84 +lat_0={latitude} +lon_0={longitude} +h_0={height_m}".format(**frame)
    )
    off = []
    for camera in json.loads((out / "cameras.json").read_text()):
        place = np.array(georef["exact_path"]["matrix"]) @ np.append(camera["position"], 1.0)
        pose = true_poses()[camera["img_name"]]
        off.append(np.array(to_truth.transform(*place[:3])) + pose[:3, :3].T @ pose[:3, 3])
    return float(np.sqrt((np.array(off) ** 2).sum(axis=1).mean()))


def test_keys_move_remove_hide_and_take_back(marking: tuple[Served, Path], open_page: Callable) -> None:
    server, file = marking
    page = opened(open_page, server).page
    page.evaluate("splatpipe.mark.goTo('P16', 'DJI_0034.JPG')")
    pixel = TRUTH["P16"]["seen_px"]["DJI_0034.JPG"]
    key = ("P16", "DJI_0034.JPG")

    def marked() -> tuple[float, float] | None:
        state(page)
        return marks_in(file).get(key)

    page.keyboard.press("Enter")  # the expected place alone is not a measurement
    state(page)
    assert not file.exists() and "not a measurement" in page.locator("#hint").inner_text()
    click(page, pixel)
    x, y = marked() or (0.0, 0.0)
    assert (x, y) == pytest.approx(pixel, abs=0.3)
    for name in ("ArrowRight", "ArrowRight", "ArrowDown", "Shift+ArrowLeft", "Shift+ArrowUp"):
        page.keyboard.press(name)
    assert marked() == pytest.approx((x + 1.9, y + 0.9), abs=0.011)
    page.keyboard.press("u")  # the moves and the click are one
    state(page)
    assert "P16" not in [point.name for point in read_points(file)]
    page.keyboard.press("r")
    assert marked() == pytest.approx((x + 1.9, y + 0.9), abs=0.011)
    page.keyboard.press("Delete")
    state(page)
    page.keyboard.press("Control+z")
    assert marked() == pytest.approx((x + 1.9, y + 0.9), abs=0.011)
    page.keyboard.press("x")
    assert state(page)["photo"] != "DJI_0034.JPG" and "# not visible:\tP16\tDJI_0034.JPG" in file.read_text()
    page.keyboard.press("Control+z")
    now = state(page)
    assert (now["point"], now["photo"]) == key and marked() == pytest.approx((x + 1.9, y + 0.9), abs=0.011)
    page.keyboard.press("n")
    page.keyboard.press("p")
    assert state(page)["photo"] == "DJI_0034.JPG"
    page.keyboard.press("PageDown")
    assert state(page)["point"] == "P17"


def test_a_click_before_the_photo_is_loaded_marks_nothing(marking: tuple[Served, Path], open_page: Callable) -> None:
    """Otherwise a point seen in one photo would be marked in the next."""
    server, file = marking
    page = opened(open_page, server).page
    page.evaluate("splatpipe.mark.goTo('P16', 'DJI_0034.JPG')")
    held: list[Any] = []
    page.route("**/photo/*", lambda route: held.append(route))  # noqa: PLW0108 - playwright marks what it calls
    with page.expect_request("**/photo/*"):
        page.evaluate("() => { splatpipe.mark.goTo('P16', 'DJI_0005.JPG'); }")
    page.locator("#canvas").click()
    assert state(page)["waiting"] == 0 and not file.exists()
    for route in held:
        route.continue_()
    page.unroute("**/photo/*")
    page.evaluate("splatpipe.mark.goTo('P16', 'DJI_0005.JPG')")
    page.locator("#canvas").click()
    state(page)
    assert list(marks_in(file)) == [("P16", "DJI_0005.JPG")]


def test_a_mark_survives_a_killed_server(gps_run: Path, open_page: Callable) -> None:
    file = gps_run.parent / "photos of a house" / "gcp_list.txt"
    file.unlink(missing_ok=True)
    options = ("--mark", "--points", gps_run.parent / "points.csv", "--port", reserved_port())
    with serving(gps_run, *options) as server:
        page = opened(open_page, server).page
        page.evaluate("splatpipe.mark.goTo('P17', 'DJI_0034.JPG')")
        server.process.kill()
        server.process.wait()
        click(page, TRUTH["P17"]["seen_px"]["DJI_0034.JPG"])
        page.get_by_text("1 change not saved").wait_for()
    assert not file.exists()
    with serving(gps_run, *options) as server:
        page.get_by_text("Open the address that splatpipe view printed").wait_for()  # the new server has its own key
        asked: list[str] = []
        page.on("dialog", lambda dialog: (asked.append(dialog.message), dialog.accept()))
        page.goto(server.page("mark"))
        page.wait_for_url(lambda url: "?key=" not in url)
        page.evaluate("splatpipe.mark.ready")
        assert ("P17", "DJI_0034.JPG") in marks_in(file)
        assert state(page)["waiting"] == 0
        assert len([text for text in asked if "P17 in DJI_0034.JPG" in text]) == 1
        page.reload()
        page.evaluate("splatpipe.mark.ready")
        assert len([text for text in asked if "P17" in text]) == 1  # saved: not asked again


def test_other_lines_of_the_file_are_kept_and_external_changes_are_read(gps_run: Path, open_page: Callable) -> None:
    file = gps_run.parent / "photos of a house" / "gcp_list.txt"
    x, y, z = TRUTH["P01"]["utm_m"]
    written = f"# by hand\r\nEPSG:32633\r\n{x:.4f} {y:.4f} {z:.4f} 1 2 ELSEWHERE.JPG P01 extra 7\r\n\r\n# end\r\n"
    file.write_bytes(written.encode())
    with serving(gps_run, "--mark", "--points", gps_run.parent / "points.csv") as server:
        page = opened(open_page, server).page
        page.evaluate("splatpipe.mark.goTo('P02', 'DJI_0009.JPG')")
        click(page, TRUTH["P02"]["seen_px"]["DJI_0009.JPG"])
        state(page)
        with file.open("ab") as stream:
            stream.write(b"# added meanwhile\r\n")
        page.evaluate("splatpipe.mark.goTo('P01', 'DJI_0005.JPG')")
        click(page, TRUTH["P01"]["seen_px"]["DJI_0005.JPG"])
        state(page)
    text = file.read_bytes().decode()
    kept = [line for line in text.split("\r\n") if "DJI_" not in line]
    assert kept == [*written.split("\r\n")[:-1], "# added meanwhile", ""]
    assert {("P01", "DJI_0005.JPG"), ("P02", "DJI_0009.JPG"), ("P01", "ELSEWHERE.JPG")} == set(marks_in(file))
    file.unlink()


def posted(server: Served, body: bytes, *lines: str, path: str = "/api/mark/change", cookie: bool = True) -> int:
    headers = ["Content-Type: application/json", *lines]
    if not any(line.lower().startswith(("content-length", "transfer-encoding")) for line in lines):
        headers.append(f"Content-Length: {len(body)}")
    return server.ask(server.pages + path, *headers, method="POST", body=body, cookie=cookie).status


def test_only_requests_of_the_page_itself_are_written(marking: tuple[Served, Path], open_page: Callable) -> None:
    server, file = marking
    good = b'{"point": 0, "photo": 4, "action": "mark", "x": 10.5, "y": 20}'
    assert posted(server, good, cookie=False) == 403
    assert posted(server, good, f"Cookie: splatpipe={'0' * 32}", cookie=False) == 403
    assert server.ask("/api/mark/change", "Content-Type: application/json", method="POST", body=good).status == 403
    assert posted(server, good, "Origin: http://elsewhere.example") == 403
    assert posted(server, good, "Origin: null") == 403
    assert posted(server, good, f"Origin: http://localhost:{server.port}") == 403
    assert posted(server, good, "Sec-Fetch-Site: cross-site") == 403
    assert posted(server, good, "Content-Length: 99999999999") == 413
    assert posted(server, b"0\r\n\r\n", "Transfer-Encoding: chunked") in (400, 411)
    assert posted(server, good, "Content-Length: 5", "Content-Length: 6") == 400
    plain = ("Content-Type: text/plain", f"Content-Length: {len(good)}")
    assert server.ask(f"{server.pages}/api/mark/change", *plain, method="POST", body=good).status == 415
    bad: list[object] = [
        *([], 3, None, "x", {}, {"point": 0}),
        *({"point": number, "photo": 4, "action": "unmark"} for number in (-1, 18, 10**30, 0.0, True, "0", None, [0])),
        *({"point": 0, "photo": number, "action": "hide"} for number in (-1, 40, "../x", 1e400)),
        *({"point": 0, "photo": 4, "action": act, "x": 1, "y": 1} for act in ("", None, "MARK", "__class__", ["mark"])),
        *(
            {"point": 0, "photo": 4, "action": "mark", "x": x, "y": 20}
            for x in (-0.1, 1200.1, 1e309, 10**400, "5", None)
        ),
        {"point": 0, "photo": 4, "action": "mark", "x": float("nan"), "y": 1},
        {"point": 0, "photo": 4, "action": "mark", "x": True, "y": 1},
    ]
    assert [body for body in bad if posted(server, json.dumps(body).encode()) != 400] == []
    for raw in (b"", b"{", b"\xff\xfe", b"[" * 8000, b'{"point":' * 1000):
        assert posted(server, raw) == 400
    page = open_page((CAPTURE / "truth.json").as_uri()).page  # another origin, with the cookies it may have
    sent = "(url) => fetch(url, { method: 'POST', mode: 'no-cors', body: '{}' }).then(() => 'sent', () => 'refused')"
    page.evaluate(sent, f"{server.address}{server.pages}/api/mark/change")
    assert not file.exists()
    assert posted(server, good) == 200 and marks_in(file) == {("P01", "DJI_0005.JPG"): (10.5, 20.0)}


TAMPERED = """<!doctype html><script>
window.tried = (async (ours, file) => {
  const forged = JSON.stringify([{ point: "P01", photo: "DJI_0005.JPG", action: "mark", x: 7, y: 8 }]);
  const attempt = async (what) => { try { return String(await what()); } catch (error) { return error.name; } };
  const post = { method: "POST", mode: "no-cors", credentials: "include", body: forged };
  return {
    storage: await attempt(() => localStorage.setItem(`splatpipe.marks:${file}`, forged)),
    cookie: await attempt(() => document.cookie),
    read: await attempt(() => fetch(`${ours}/api/mark`, { credentials: "include" })),
    photo: await attempt(() => fetch(`${ours}/photo/3`, { credentials: "include", mode: "no-cors" })),
    write: await attempt(() => fetch(`${ours}/api/mark/change`, post)),
    open: await attempt(() => window.open(`${ours}/mark`)),
    beside: await attempt(() => fetch("report.html").then((answer) => answer.status)),
  };
})("OURS", "FILE");
</script>"""


def test_a_page_of_the_run_can_neither_mark_nor_see_photos(
    marking: tuple[Served, Path], gps_run: Path, open_page: Callable
) -> None:
    """A received report.html that even knows our addresses, in the browser that has the cookie."""
    server, file = marking
    report = gps_run / "report.html"
    kept = report.read_bytes()
    report.unlink()
    report.write_text(TAMPERED.replace("OURS", f"{server.address}{server.pages}").replace("FILE", str(file)))
    try:
        page = opened(open_page, server).page
        page.goto(f"{server.address}{server.pages}/run")
        page.get_by_text("Report", exact=True).click()
        page.wait_for_url("**/report.html")
        tried = page.evaluate("tried")
        assert tried.pop("open") == "null" and tried.pop("beside") == "200"
        assert set(tried.values()) <= {"SecurityError", "TypeError"}, tried
        with page.expect_navigation():  # by itself, not by the user: no cookie goes with it
            page.evaluate(f"() => {{ location = '{server.address}{server.pages}/mark'; }}")
        assert "splatpipe view printed" in page.content()
        opened_again = page.context.new_page()
        opened_again.goto(f"{server.address}{server.pages}/mark")  # by the user
        assert state(opened_again)["waiting"] == 0
        assert not file.exists()
    finally:
        report.write_bytes(kept)


def test_marks_that_a_page_before_left_are_saved_only_if_the_user_agrees(
    marking: tuple[Served, Path], open_page: Callable
) -> None:
    """The storage is that of an address and port: another user's server may have had them."""
    server, file = marking
    page = opened(open_page, server).page
    forged = [{"point": "P01", "photo": "DJI_0005.JPG", "action": "mark", "x": 7, "y": 8}] * 20
    asked: list[str] = []
    page.on("dialog", lambda dialog: (asked.append(dialog.message), dialog.dismiss()))
    for left in (forged, {"length": 3}, [None], "{}", 7):
        page.evaluate("([key, left]) => localStorage.setItem(key, left)", [f"splatpipe.marks:{file}", json.dumps(left)])
        page.reload()
        page.evaluate("splatpipe.mark.ready")
        assert state(page)["waiting"] == 0 and not file.exists()
        assert page.evaluate("localStorage.length") == 0
    assert len(asked) == 1 and asked[0].count("P01 in DJI_0005.JPG") == 12 and "8 more" in asked[0]


def test_a_phone_shows_and_marks_by_touch(marking: tuple[Served, Path], open_page: Callable) -> None:
    server, file = marking
    watched = opened(open_page, server, 390, 844, True)
    page = watched.page
    page.evaluate("splatpipe.mark.goTo('P16', 'DJI_0034.JPG')")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for name in ("Accept", "Remove", "Not visible", "Undo", "Points"):
        box = page.get_by_role("button", name=name, exact=True).bounding_box()
        assert box is not None and box["x"] >= 0 and box["x"] + box["width"] <= 390 and box["y"] + box["height"] <= 844
    page.touchscreen.tap(*page.evaluate("(at) => splatpipe.mark.screenAt(at)", TRUTH["P16"]["seen_px"]["DJI_0034.JPG"]))
    state(page)
    assert marks_in(file)["P16", "DJI_0034.JPG"] == pytest.approx(TRUTH["P16"]["seen_px"]["DJI_0034.JPG"], abs=2.0)
    page.get_by_role("button", name="→").tap()
    page.get_by_role("button", name="Accept").tap()
    assert state(page)["photo"] != "DJI_0034.JPG"
    page.get_by_role("button", name="Points", exact=True).tap()
    page.locator("#list li", has_text="P07").tap()
    assert state(page)["point"] == "P07"
    assert watched.errors == []


@pytest.fixture(scope="module")
def found_run(demo_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo with coordinates alone: its marks are detected targets."""
    home = tmp_path_factory.mktemp("found")
    shutil.copytree(capture_path(), home / "photos of a house")
    listed = [line.split() for line in (CAPTURE / "gcp_list.txt").read_text().splitlines()]
    places = {fields[6]: fields[:3] for fields in listed[1:]}
    rows = [",".join([name, *place]) for name, place in places.items()]
    (home / "photos of a house" / "control.csv").write_text("\n".join([listed[0][0], "name,x,y,z", *rows, ""]))
    out = linked_copy(demo_run, home / "out")
    config = re.sub(
        r"(?m)^photos = .*$", f'photos = "{home / "photos of a house"}"', (out / "config.toml").read_text(), count=1
    )
    (out / "config.toml").unlink()
    (out / "config.toml").write_text(config)
    for stage in ("control", "georef"):  # the points are the demo's, and so are the targets that were found
        answered("stage", stage, out)
    return out


def test_detected_targets_are_shown_moved_and_rejected_in_the_browser(found_run: Path, open_page: Callable) -> None:
    file = found_run.parent / "photos of a house" / "control.csv"
    begun = file.read_text()
    with serving(found_run, "--mark") as server:
        watched = opened(open_page, server, 1000, 640)
        page = watched.page
        points = state(page)["overview"]["points"]
        assert sum(point["found"] for point in points) == sum(point["marks"] for point in points) > 200
        photo, pixel = "DJI_0034.JPG", TRUTH["P16"]["seen_px"]["DJI_0034.JPG"]
        page.evaluate(f"splatpipe.mark.goTo('P16', '{photo}')")
        chosen = page.locator("#photos li[aria-current]")
        assert "found" in (chosen.get_attribute("class") or "") and "detected" in (chosen.get_attribute("title") or "")
        assert "were detected" in (page.locator("#list li", has_text="P16").get_attribute("title") or "")
        assert "found in" in page.locator("#about").inner_text()
        page.keyboard.press("Enter")  # accepted: nothing is written
        state(page)
        assert file.read_text() == begun
        page.evaluate(f"splatpipe.mark.goTo('P16', '{photo}')")
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowRight")
        state(page)
        assert list(marks_in(file)) == [("P16", photo)]
        assert marks_in(file)["P16", photo] == pytest.approx((pixel[0] + 2.0, pixel[1]), abs=0.3)
        assert "marked" in (chosen.get_attribute("class") or "")
        page.keyboard.press("u")  # both moves at once: as it was detected
        state(page)
        assert marks_in(file) == {} and "found" in (chosen.get_attribute("class") or "")
        page.keyboard.press("Delete")
        state(page)
        assert f"# not visible:\tP16\t{photo}" in file.read_text() and marks_in(file) == {}
        assert "hidden" in (chosen.get_attribute("class") or "")
        assert watched.errors == []


def test_a_turned_photo_is_shown_as_it_is_stored(tmp_path: Path, open_page: Callable) -> None:
    """Marks count in the stored grid: the browser must not apply the rotation in EXIF."""
    rng = np.random.default_rng(1)
    picture = Image.fromarray(rng.integers(0, 255, (30, 50, 3), np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 6
    picture.save(tmp_path / "turned.jpg", exif=exif, quality=95, comment=b"hello")
    stripped = without_metadata((tmp_path / "turned.jpg").read_bytes())
    (tmp_path / "stripped.jpg").write_bytes(stripped)
    assert b"Exif" not in stripped and b"hello" not in stripped
    with Image.open(tmp_path / "turned.jpg") as before, Image.open(tmp_path / "stripped.jpg") as after:
        assert np.array_equal(np.asarray(before), np.asarray(after))
    page = open_page((tmp_path / "stripped.jpg").as_uri()).page
    assert page.evaluate("[document.images[0].naturalWidth, document.images[0].naturalHeight]") == [50, 30]
    for broken in (b"", b"\xff\xd8", b"\xff\xd8\xff\xe1\x00\x00", b"\xff\xd8\xff", b"PNG", stripped[:20]):
        with pytest.raises(ValueError, match="JPEG"):
            without_metadata(broken)
