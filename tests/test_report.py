"""The report: correct for finished, stopped and failed runs, in a real browser and without a network."""

import base64
import fcntl
import io
import json
import math
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.console import show_bad_cameras
from splatpipe.pipeline.app.report import make_report, write_report
from splatpipe.pipeline.app.report.capture import unit_of
from splatpipe.pipeline.app.report.georeferencing import georeferencing_chapter
from splatpipe.pipeline.app.report.page import report_page
from splatpipe.pipeline.app.report.pictures import CHIP_SIDE, MAX_CHIPS, chosen_views, cut_chips
from splatpipe.pipeline.app.report.report_inputs import read_report_inputs
from splatpipe.pipeline.app.report.verdict import judge
from splatpipe.stages.line import LINE

sys.path.insert(0, str(Path(__file__).parent / "scenes"))
from timeouts import TIMEOUT_S, wait_until

QUICK = (
    *("features.extractor=opencv-sift", "features.max_image_size=700", "undistort.max_megapixels=0.03"),
    *("depths.max_megapixels=0.01", "dsm.cell_m=0.3", "ortho.gsd_m=0.3"),
)
HOSTILE = '<script>document.title = "taken"</script><img src="http://example.org/x.png">&"\''


def sets(*assignments: str) -> list[str]:
    return [part for text in assignments for part in ("--set", text)]


def splatpipe(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


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
    out = shutil.copytree(demo_run, tmp_path_factory.mktemp("finished") / "out")
    write_report(out)
    return out


@pytest.fixture
def copy_of_run(demo_run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(demo_run, tmp_path / "out")


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


def test_its_ids_are_unique(finished: Path) -> None:
    ids = re.findall(r'\bid="([^"]+)"', (finished / "report.html").read_text())
    assert len(ids) == len(set(ids))


def test_held_out_photos_come_worst_first_and_the_slider_moves_the_cut(
    finished: Path, open_page: Callable[..., object]
) -> None:
    watched = open_page((finished / "report.html").as_uri())
    views = json.loads((finished / "metrics.json").read_text())["per_view"]
    order = [view["name"] for view in sorted(views, key=lambda view: view["psnr"])]
    rows = watched.page.locator("#views tbody th").all_inner_texts()
    assert rows == order
    shown = watched.page.locator("#views article h3").all_inner_texts()
    assert shown == order[: len(shown)] or shown == [*order[: len(shown) - 1], order[-1]]
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
    chip = section.locator(".chip").first
    assert worst["photo"] in chip.inner_text() and f"{math.hypot(*worst['residual_px']):.2f} px" in chip.inner_text()
    x, y = map(float, re.match(r"M([\d.]+) ([\d.]+)v24", chip.locator(".mark").get_attribute("d")).groups())
    circle = chip.locator(".found")
    apart = (float(circle.get_attribute("cx")) - x, float(circle.get_attribute("cy")) - y - 12.0)
    for drawn, true in zip(apart, worst["residual_px"], strict=True):
        assert math.isclose(drawn * CHIP_SIDE / 100.0, true, abs_tol=0.02)


def test_a_cut_out_shows_the_photo_at_the_mark(finished: Path) -> None:
    inputs = read_report_inputs(finished)
    points = inputs.read("georef.control")["points"]
    chips = cut_chips(points, inputs.part("ingest.photos"), inputs.photos_dir)
    seen = points[0]["observations"][0]
    chip = chips[0, 0]
    code = str(chip.picture).split(",")[1]
    cut = Image.open(io.BytesIO(base64.b64decode(code))).convert("RGB")
    left, top = (math.floor(value - CHIP_SIDE / 2) for value in seen["pixel"])
    with Image.open(capture_path() / seen["photo"]) as photo:
        true = photo.convert("RGB").crop((left, top, left + CHIP_SIDE, top + CHIP_SIDE))
    differences = [abs(a - b) for a, b in zip(cut.tobytes(), true.tobytes(), strict=True)]
    assert sum(differences) / len(differences) < 6.0  # JPEG's


def test_a_run_stopped_in_training_has_a_truthful_report(copy_of_run: Path, open_page: Callable[..., object]) -> None:
    """Ctrl-C in a longer training: its progress, its curve, and a note that the other files are from an earlier run."""
    before = len((copy_of_run / "events.jsonl").read_text())
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli", "stage", "train", str(copy_of_run)]
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
    assert "30 trained on, 10 held out" in words(watched)  # of the plan that it had
    assert state_of(watched, "train") == "stopped" and state_of(watched, "sparse") == "earlier run"
    assert watched.page.locator("#training .chart").count() == 2
    assert watched.page.locator("#views").count() == 0 and "PSNR" not in watched.page.locator(".cards").inner_text()
    assert "6 check points are off by" in shown_text  # what was found before is not lost
    assert watched.page.locator("#files .stale").count() == watched.page.locator("#files tr").filter(
        has_text=re.compile(r"splat\.|\.glb|cameras\.json|georef\.json|metrics\.json|viewer\.html|flythrough")
    ).count() > 0  # fmt: skip
    row = watched.page.locator("#processing tr", has_text="stopped").inner_text()
    assert "MB" in row or "GB" in row  # its memory is known though it never ended


def test_a_stop_leaves_the_plain_report_when_there_is_no_time_for_pictures(copy_of_run: Path) -> None:
    (copy_of_run / "report.html").unlink()
    page = report_page(read_report_inputs(copy_of_run), drawn=False)
    assert "splatpipe report writes the page again" in page and "<svg role=" not in page and "data:image" not in page
    make_report(copy_of_run, copy_of_run / "splatpipe.log", until_s=time.monotonic() + 600.0)
    assert "<svg role=" in (copy_of_run / "report.html").read_text()
    code = (
        "import sys; from pathlib import Path; from splatpipe.pipeline.app.report import write_report\n"
        f"write_report(Path({str(copy_of_run)!r}), drawn=False)\n"
        "print([name for name in ('matplotlib', 'torch', 'pycolmap', 'cv2') if name in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


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


@pytest.mark.parametrize(
    "part", ["georef.control", "evaluate.metrics", "sparse.summary", "train.history", "ingest.positions"]
)
def test_a_damaged_part_costs_only_its_chapter_of_the_report(copy_of_run: Path, part: str) -> None:
    path = read_report_inputs(copy_of_run).part(part)
    path.write_text("[" + " " * (path.stat().st_size - 2) + "]")  # of the same length, with other content
    page = report_page(read_report_inputs(copy_of_run), drawn=False)
    assert page.count("This part could not be read") == 1
    assert "Processing</h2>" in page


def test_a_damaged_artifact_of_a_finished_run_is_not_reported_as_a_requested_end(
    copy_of_run: Path,
) -> None:
    (read_report_inputs(copy_of_run).part("sparse.summary").parent / "manifest.json").write_text("{")
    verdict = judge(read_report_inputs(copy_of_run))
    assert verdict.level == "bad"
    assert verdict.headline == "Finished, but its results are damaged"
    assert "sparse" in verdict.text


def rewrite(path: Path, change: Callable[[dict[str, object]], None]) -> None:
    """Change a part of an artifact and keep the artifact valid."""
    data = json.loads(path.read_text())
    size = path.stat().st_size
    change(data)
    path.write_text(json.dumps(data))
    manifest = path.parent / "manifest.json"
    manifest.write_text(manifest.read_text().replace(f'"size": {size},', f'"size": {path.stat().st_size},'))


def show_nothing_inside(data: dict[str, Any]) -> None:
    """evaluate's output if no held-out photo shows the inside of the boundary."""
    data["whole"] = dict(data["mean"])
    for measures in (data["mean"], *data["per_view"]):
        measures.update(psnr=None, psnr_cc=None, ssim=None)


@pytest.mark.parametrize(
    ("part", "change", "level", "said"),
    [
        ("evaluate.metrics", lambda data: data["mean"].update(psnr_cc=17.0), "bad", "poor image quality"),
        ("evaluate.metrics", lambda data: data["mean"].update(psnr_cc=22.0), "doubt", "fair image quality"),
        ("evaluate.metrics", lambda data: data.update(per_view=[]), "doubt", "No photo was held out"),
        ("evaluate.metrics", lambda data: data.update(whole=data["mean"]), "good", "dB inside the boundary"),
        ("evaluate.metrics", show_nothing_inside, "doubt", "No held-out photo shows the area inside the boundary"),
        ("evaluate.metrics", lambda data: data["floaters"]["veil"].update(mean=0.2), "doubt", "20.0 % of the light"),
        (
            "evaluate.metrics",
            lambda data: data["floaters"]["veil"].update(mean=0.0, held_out=False),
            "good",
            "of the training",
        ),
        ("georef.accuracy", lambda data: data["tables"]["check"].update(rmse_up_m=0.5), "doubt", "50.0 cm in height"),
        (
            "evaluate.metrics",
            lambda data: data["accuracy"]["splat"]["points"][2].update(residual_m=[3.0, 0.0, 4.0]),
            "doubt",
            "(5.00 m)",
        ),
        ("georef.accuracy", lambda data: data["tables"].update(check=None), "doubt", "no check point to verify it"),
        (
            "georef.accuracy",
            lambda data: data["tables"].update(check=None, control=None),
            "doubt",
            "own positions alone",
        ),
        ("georef.frame", lambda data: data.update(kind="arbitrary"), "doubt", "neither scale nor georeference"),
        (
            "georef.frame",
            lambda data: data.update(kind="arbitrary", metres=True),
            "doubt",
            "metric but not georeferenced",
        ),
    ],
)
def test_the_verdict_follows_the_figures(
    copy_of_run: Path, part: str, change: Callable[[dict[str, object]], None], level: str, said: str
) -> None:
    before = [finding.text for finding in judge(read_report_inputs(copy_of_run)).findings]
    assert not any(said in text for text in before)
    rewrite(read_report_inputs(copy_of_run).part(part), change)
    found = next(finding for finding in judge(read_report_inputs(copy_of_run)).findings if said in finding.text)
    assert found.level == level


def test_scale_bars_are_reported_one_by_one(copy_of_run: Path) -> None:
    """Metric, not placed: lengths have a unit, and no axis is called east."""
    bars = [("P1", "P2", 12.5, 0.0012, True), ("P2", "P3", 8.0, -0.9, False), ("P3", "P9", 4.0, None, False)]
    rows = [dict(zip(("a", "b", "metres", "error_m", "used"), bar, strict=True)) for bar in bars]
    scale = {"metric": True, "placed": False, "sentence": "by one bar.", "sigma": 0.001, "bars": rows}
    inputs = read_report_inputs(copy_of_run)
    rewrite(inputs.part("georef.frame"), lambda data: data.update(kind="arbitrary", metres=True, origin=None))
    rewrite(inputs.part("georef.accuracy"), lambda data: data.update(scale=scale))
    inputs = read_report_inputs(copy_of_run)
    chapter = georeferencing_chapter(inputs, None)
    assert chapter is not None
    facts = dict(chapter["facts"])
    assert "position and heading are arbitrary" in facts["Frame"] and "per pixel" in facts["Ground sample distance"]
    assert facts["P1 to P2"].endswith("m, +1.2 mm in the model")
    assert facts["P2 to P3"].endswith("-900.0 mm in the model, left out")
    assert facts["P3 to P9"].endswith("one of its targets was not found")
    assert unit_of(inputs) == "metres"
    finding = next(finding for finding in judge(inputs).findings if "metric but not georeferenced" in finding.text)
    assert finding.level == "doubt"  # one bar, which no other confirms


def test_bad_cameras_are_the_headline_of_page_and_console(
    copy_of_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reason = {"level": "bad", "kind": "bent", "text": "40 of 90 pairs contradict it.", "hint": "Add photos."}
    verdict = {"level": "bad", "reasons": [reason]}
    rewrite(read_report_inputs(copy_of_run).part("sparse.summary"), lambda judged: judged.update(verdict=verdict))
    judged = judge(read_report_inputs(copy_of_run))
    assert (judged.level, judged.headline) == ("bad", "The camera poses are unreliable")
    assert (judged.findings[0].level, judged.findings[0].text) == ("bad", "40 of 90 pairs contradict it. Add photos.")
    show_bad_cameras(verdict)
    assert re.search(
        "The camera poses are unreliable.*40 of 90 pairs contradict it.*Add photos", capsys.readouterr().err, re.DOTALL
    )
    show_bad_cameras({"level": "doubt", "reasons": [{**reason, "level": "doubt"}]})
    assert capsys.readouterr().err == ""


def test_the_page_lists_the_mappers_that_were_tried(copy_of_run: Path) -> None:
    page = report_page(read_report_inputs(copy_of_run), drawn=False)
    table = page[page.index("Mapping methods tried") : page.index("Calibration</h3>")]
    assert "incremental" in table and "taken" in table and "nan" not in table


def test_an_interrupted_run_is_distinguished_from_a_running_one(copy_of_run: Path) -> None:
    lines = (copy_of_run / "events.jsonl").read_text().splitlines()
    started = next(i for i, line in enumerate(lines) if '"stage_started"' in line and '"train"' in line)
    (copy_of_run / "events.jsonl").write_text("\n".join(lines[: started + 4]))
    assert "Interrupted in train" in report_page(read_report_inputs(copy_of_run), drawn=False)
    with (copy_of_run / "stages" / ".lock").open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert "Still running in train" in report_page(read_report_inputs(copy_of_run), drawn=False)


def test_a_report_that_cannot_be_written_does_not_spoil_a_good_run(copy_of_run: Path) -> None:
    (copy_of_run / "report.html").unlink()
    (copy_of_run / "report.html").mkdir()
    done = splatpipe("stage", "export", copy_of_run, "--json")
    assert done.returncode == 0 and "The report could not be written" in done.stderr
    assert json.loads(done.stdout)["error"] is None


def test_report_of_a_folder_without_a_run_is_a_usage_error(tmp_path: Path) -> None:
    done = splatpipe("report", tmp_path)
    assert done.returncode == 2 and "does not contain a run" in " ".join(done.stderr.replace("│", " ").split())
    assert not list(tmp_path.iterdir())


def test_hundreds_of_photos_keep_the_report_small() -> None:
    views = [{"psnr": float(i)} for i in range(300)]
    assert len(chosen_views(views)) == 12 and chosen_views(views)[-1] is views[-1]
    seen = [{"photo": f"{i}.jpg", "pixel": [10.0, 10.0], "residual_px": [i / 100.0, 0.0]} for i in range(400)]
    points = [{"observations": seen}, {"observations": seen}, {"observations": seen[:3]}]
    chips = cut_chips(points, None, None)
    assert len(chips) == MAX_CHIPS
    assert {(0, 399), (1, 399), (2, 0), (2, 1), (2, 2)} <= set(chips) and (0, 0) not in chips


def test_no_folder_outside_out_is_named(copy_of_run: Path) -> None:
    secret = "/home/jane doe/customers/Brown"
    config = (copy_of_run / "config.toml").read_text()
    photos = tomllib.loads(config)["photos"]
    config = config.replace(photos, f"{secret}/photos").replace(
        'control = "auto"', f'control = "{secret}/points 2.csv"'
    )
    (copy_of_run / "config.toml").write_text(config)
    message = (
        f"{secret}/photos/a.jpg and {copy_of_run}/x and {secret}/points 2.csv and /srv/backup/y and {Path.home()}/z"
    )
    warning = {"kind": "warning", "stage": "georef", "data": {"message": message, "hint": message}, "time_s": 1e9}
    with (copy_of_run / "events.jsonl").open("a") as log:
        log.write(json.dumps(warning) + "\n")
    page = report_page(read_report_inputs(copy_of_run), drawn=False)
    assert "PHOTOS/a.jpg and OUT/x and points 2.csv and y and z" in page
    for folder in ("jane", "customers", "Brown", "/srv", str(copy_of_run.parent), f"{Path.home()}/"):
        assert folder not in page
