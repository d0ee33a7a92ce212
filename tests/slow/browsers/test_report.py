"""The report in a real browser: complete, within the screen, and without a network."""

import json
import math
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from command import splatpipe
from finished_run import linked_copy, write_apart
from PIL import Image
from timeouts import TIMEOUT_S, wait_until

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.report import write_report
from splatpipe.pipeline.app.report.charts.pictures import CROP_SIDE_PX
from splatpipe.pipeline.app.report.facts.report_inputs import read_report_inputs
from splatpipe.stages.line import LINE

QUICK = (
    *("features.extractor=opencv-sift", "features.max_image_size=700", "undistort.max_megapixels=0.03"),
    *("depths.max_megapixels=0.01", "dsm.cell_m=0.3", "ortho.gsd_m=0.3"),
)


HOSTILE = '<script>document.title = "taken"</script><img src="http://example.org/x.png">&"\''


def sets(*assignments: str) -> list[str]:
    return [part for text in assignments for part in ("--set", text)]


def words(watched: object) -> str:
    """Return a page's whole text, including closed parts, with whitespace collapsed."""
    return " ".join(watched.page.evaluate("document.body.textContent").split())  # type: ignore[attr-defined]


def headline(watched: object) -> str:
    return str(watched.page.locator(".verdict h2").inner_text())  # type: ignore[attr-defined]


def state_of(watched: object, stage: str) -> str:
    row = watched.page.locator("#processing tr", has=watched.page.get_by_role("rowheader", name=stage, exact=True))  # type: ignore[attr-defined]
    return str(row.locator("td").first.inner_text())


@pytest.fixture(scope="module")
def finished(demo_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the finished run, whose report this test's own code wrote."""
    out = linked_copy(demo_run, tmp_path_factory.mktemp("finished") / "out")
    write_report(out)
    return out


@pytest.fixture
def copy_of_run(demo_run: Path, tmp_path: Path) -> Path:
    return linked_copy(demo_run, tmp_path / "out")


def test_a_run_writes_a_report_that_opens_offline_without_a_request(
    demo_run: Path, open_page: Callable[..., object]
) -> None:
    watched = open_page((demo_run / "report.html").as_uri())
    assert (watched.requests, watched.errors) == ([], [])
    assert headline(watched).startswith("Finished")
    said = words(watched)
    assert "could not be read" not in said
    assert "All 40 photos were placed" in said and "6 check points are off by" in said
    metrics = json.loads((demo_run / "metrics.json").read_text())
    assert f"{metrics['psnr']:.2f}" in said and f"{metrics['gaussians']:,}" in said
    table = metrics["accuracy"]["tables"]["check"]
    assert f"{table['rmse_3d_m']:.3f}" in watched.page.locator("#georeferencing table").first.inner_text()
    for stage in LINE:
        assert state_of(watched, stage.name) == "finished"


def test_links_point_to_the_files_beside_it_and_nowhere_else(finished: Path, open_page: Callable[..., object]) -> None:
    watched = open_page((finished / "report.html").as_uri())
    links = watched.page.eval_on_selector_all("a[href]", "all => all.map(a => a.getAttribute('href'))")
    for link in links:
        assert link.startswith("#") or (finished / link).exists(), link
    assert {"splat.ply", "georef.json", "metrics.json", "config.toml"} <= set(links)
    anchors = [link for link in links if link.startswith("#")]
    assert all(watched.page.locator(anchor).count() == 1 for anchor in anchors)


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
def test_it_fits_a_desktop_and_a_phone(
    finished: Path, open_page: Callable[..., object], width: int, height: int
) -> None:
    watched = open_page((finished / "report.html").as_uri(), width=width, height=height, touch=width < 500)
    assert watched.page.evaluate("document.documentElement.scrollWidth") <= width
    assert watched.page.locator(".trouble").all_inner_texts() == []
    assert watched.page.locator(".chart svg").count() >= 12
    assert watched.page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")


def test_held_out_photos_come_worst_first_and_the_slider_moves_the_cut(
    finished: Path, open_page: Callable[..., object]
) -> None:
    watched = open_page((finished / "report.html").as_uri())
    views = json.loads((finished / "metrics.json").read_text())["per_view"]
    order = [view["name"] for view in sorted(views, key=lambda view: view["psnr"])]
    rows = watched.page.locator("#views tbody th").all_inner_texts()
    assert rows == order
    titles = watched.page.locator("#views article h3").all_inner_texts()
    assert titles == order[: len(titles)] or titles == [*order[: len(titles) - 1], order[-1]]
    view = watched.page.locator("#views article").first
    view.scroll_into_view_if_needed()
    box = view.locator(".photo").bounding_box()
    cut = "element => getComputedStyle(element).clipPath"
    assert "50%" in view.locator(".render img").evaluate(cut)
    watched.page.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 30)
    left = float(re.search(r"([\d.]+)%", view.locator(".render img").evaluate(cut)).group(1))
    assert math.isclose(left, 25.0, abs_tol=1.0)
    view.locator("input").focus()
    watched.page.keyboard.press("End")
    assert "100%" in view.locator(".render img").evaluate(cut)


def test_each_mark_of_the_surveyor_has_a_cut_out_with_both_positions(
    finished: Path, open_page: Callable[..., object]
) -> None:
    """The drawn mark and circle are separated by the residual, in pixels of the crop."""
    watched = open_page((finished / "report.html").as_uri())
    inputs = read_report_inputs(finished)
    points = inputs.read("georef.control")["points"]
    assert watched.page.locator(".chip").count() == sum(len(point["observations"]) for point in points)
    assert watched.page.locator(".chip img").count() == watched.page.locator(".chip").count()
    point = next(point for point in points if point["name"] == "P05")
    section = watched.page.locator("section.point", has=watched.page.locator("h4", has_text="P05"))
    assert section.locator(".chip").count() == len(point["observations"])
    worst = max(point["observations"], key=lambda seen: math.hypot(*seen["residual_px"]))
    crop = section.locator(".chip").first
    assert worst["photo"] in crop.inner_text() and f"{math.hypot(*worst['residual_px']):.2f} px" in crop.inner_text()
    x, y = map(float, re.match(r"M([\d.]+) ([\d.]+)v24", crop.locator(".mark").get_attribute("d")).groups())
    circle = crop.locator(".found")
    apart = (float(circle.get_attribute("cx")) - x, float(circle.get_attribute("cy")) - y - 12.0)
    for drawn, true in zip(apart, worst["residual_px"], strict=True):
        assert math.isclose(drawn * CROP_SIDE_PX / 100.0, true, abs_tol=0.02)


def test_a_run_stopped_in_training_has_a_truthful_report(copy_of_run: Path, open_page: Callable[..., object]) -> None:
    """Ctrl-C in a longer training: its progress, its curve, and a note that the other files are from an earlier run."""
    before = len((copy_of_run / "events.jsonl").read_text())
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "stage", "train", str(copy_of_run)]
    command += sets("train.iterations=100000")
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as running:
        events = copy_of_run / "events.jsonl"
        begun = re.compile('("name": "loss".*){3}', re.DOTALL)
        wait_until(lambda: begun.search(events.read_text(), before) or running.poll() is not None, "the training")
        assert running.poll() is None, running.stderr and running.stderr.read()
        running.send_signal(signal.SIGINT)
        _, said = running.communicate(timeout=TIMEOUT_S)
    assert running.returncode == 130 and "Traceback" not in said
    assert not list(copy_of_run.glob("report.html.*"))
    splatpipe("report", copy_of_run)
    watched = open_page((copy_of_run / "report.html").as_uri())
    assert (watched.requests, watched.errors) == ([], [])
    assert headline(watched) == "Stopped in train before it was finished"
    shown_text = words(watched)
    iteration = int(re.search(r"It had reached ([\d,]+) of 100,000 iterations", shown_text).group(1).replace(",", ""))
    events = [json.loads(line) for line in (copy_of_run / "events.jsonl").read_text()[before:].splitlines()]
    progress = [event["data"]["done"] for event in events if event["data"].get("what") == "training"]
    steps = [event["data"]["step"] for event in events if event["kind"] == "metric"]
    assert iteration == max(*progress, *steps)
    assert "30 trained on, 10 held out" in words(watched)  # as planned for this training
    assert state_of(watched, "train") == "stopped" and state_of(watched, "sparse") == "earlier run"
    assert watched.page.locator("#training .chart").count() == 2
    assert watched.page.locator("#views").count() == 0 and "PSNR" not in watched.page.locator(".cards").inner_text()
    assert "6 check points are off by" in shown_text  # what was found before is not lost
    assert watched.page.locator("#files .stale").count() == watched.page.locator("#files tr").filter(
        has_text=re.compile(r"splat\.|\.glb|cameras\.json|georef\.json|metrics\.json|viewer\.html|flythrough")
    ).count() > 0  # fmt: skip
    row = watched.page.locator("#processing tr", has_text="stopped").inner_text()
    assert "MB" in row or "GB" in row  # its memory is known though it never ended


def test_a_run_that_failed_in_sparse_has_a_truthful_report(tmp_path: Path, open_page: Callable[..., object]) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("DJI_0001.JPG", "DJI_0011.JPG", "DJI_0021.JPG", "DJI_0031.JPG"):  # a quarter turn apart
        shutil.copy(capture_path() / name, photos)
    out = tmp_path / "out"
    done = splatpipe("run", photos, out, *sets(*QUICK), "--json")
    output = json.loads(done.stdout)
    assert (done.returncode, output["failed"]) == (1, "sparse")
    watched = open_page((out / "report.html").as_uri())
    assert (watched.requests, watched.errors) == ([], [])
    assert headline(watched) == "Failed in sparse"
    said = words(watched)
    assert output["error"]["message"] in said and output["error"]["hint"] in said
    assert "Not reached, so not in this report: Georeferencing and accuracy, Training, Held-out photos." in said
    assert state_of(watched, "matches") == "finished" and state_of(watched, "sparse") == "failed"
    assert state_of(watched, "train") == "not reached"
    assert "No deliverable was made." in said and "Photos placed" not in said
    assert watched.page.locator("#capture .chart").count() == 1  # where the photos say that they were taken


def test_a_run_without_positions_says_that_nothing_is_in_metres(
    tmp_path: Path, open_page: Callable[..., object]
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for path in sorted(capture_path().glob("*.JPG"))[-6:]:
        with Image.open(path) as photo:
            photo.resize((800, 600)).save(photos / path.name, quality=92)  # Pillow leaves the metadata out
    (photos / "notes.jpg").write_bytes(b"no picture")
    out = tmp_path / "out"
    done = splatpipe("run", photos, out, *sets(*QUICK, "train.iterations=30", "split.every=4"), "--json")
    assert done.returncode == 0, done.stderr
    assert str(out / "report.html") in json.loads(done.stdout)["outputs"]
    watched = open_page((out / "report.html").as_uri())
    assert (watched.requests, watched.errors) == ([], [])
    said = words(watched)
    assert "It cannot be measured in metres" in said and "none of the photos has a position" in said
    assert "Ground sample distance" not in said and "check point" not in said
    assert "x (model units)" in said and "east (m)" not in said
    left_out = watched.page.locator("#capture tr", has_text="notes.jpg").inner_text()
    assert len(left_out.replace("notes.jpg", "").strip()) > 10  # and why


def test_hostile_names_and_messages_stay_text(copy_of_run: Path, open_page: Callable[..., object]) -> None:
    """In events, in the control points, and in what was left out."""
    inputs = read_report_inputs(copy_of_run)
    with (copy_of_run / "events.jsonl").open("a") as events:
        for kind, data in (
            (
                "run_started",
                {"stages": ["ingest", "georef"], "machine": {"system": HOSTILE}, "versions": {HOSTILE: HOSTILE}},
            ),
            ("stage_started", {"reason": HOSTILE}),
            ("warning", {"message": HOSTILE, "hint": HOSTILE}),
            ("note", {"message": HOSTILE}),
            ("stage_failed", {"message": HOSTILE, "hint": "", "exit_code": 1}),
        ):
            stage = "" if kind == "run_started" else "export"
            events.write(json.dumps({"kind": kind, "stage": stage, "data": data, "time_s": 1.8e9}) + "\n")
        events.write("no JSON\n[1, 2]\n" + '{"kind": "metric", "stage": "train", "data": {}, "time_s": "soon"}\n')

    def hostile_control(content: dict[str, object]) -> None:
        point = content["points"][0]
        point["name"] = point["why"] = content["file"] = f"$x_{HOSTILE}"
        point["observations"][0]["photo"] = f"../{HOSTILE}"

    rewrite(inputs.part("georef.control"), hostile_control)
    left_out = [{"name": HOSTILE, "reason": HOSTILE}]
    rewrite(inputs.part("ingest.left_out"), lambda content: content.update(left_out=left_out))
    stolen = {"name": HOSTILE, "file": "../../../etc/passwd"}
    rewrite(inputs.part("evaluate.metrics"), lambda content: content["per_view"][0].update(stolen))
    write_report(copy_of_run)
    watched = open_page((copy_of_run / "report.html").as_uri())
    assert (watched.requests, watched.errors) == ([], [])
    assert watched.page.title() == "out: report"
    assert words(watched).count('document.title = "taken"') >= 9
    assert watched.page.locator("script").count() == 1


def rewrite(path: Path, change: Callable[[dict[str, object]], None]) -> None:
    """Change a part of an artifact and keep the artifact valid."""
    data = json.loads(path.read_text())
    size = path.stat().st_size
    change(data)
    write_apart(path, json.dumps(data))
    manifest = path.parent / "manifest.json"
    write_apart(manifest, manifest.read_text().replace(f'"size": {size},', f'"size": {path.stat().st_size},'))
