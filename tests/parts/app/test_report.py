"""The report: correct for finished, stopped and failed runs, in a real browser and without a network."""

import base64
import fcntl
import io
import json
import math
import re
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command import splatpipe
from finished_run import linked_copy, write_apart
from PIL import Image

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.report import is_current, make_report, write_report
from splatpipe.pipeline.app.report.chapters.capture import unit_of
from splatpipe.pipeline.app.report.chapters.georeferencing import georeferencing_chapter
from splatpipe.pipeline.app.report.charts.pictures import CROP_SIDE_PX, MAX_CROPS, chosen_views, cut_crops
from splatpipe.pipeline.app.report.facts.report_inputs import read_report_inputs
from splatpipe.pipeline.app.report.page import report_content, report_page
from splatpipe.pipeline.app.report.verdict import judge
from splatpipe.pipeline.app.terminal.console import show_bad_cameras


@pytest.fixture(scope="module")
def finished(demo_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the finished run, whose report this test's own code wrote."""
    out = linked_copy(demo_run, tmp_path_factory.mktemp("finished") / "out")
    write_report(out)
    return out


@pytest.fixture
def copy_of_run(demo_run: Path, tmp_path: Path) -> Path:
    return linked_copy(demo_run, tmp_path / "out")


def undrawn_page(out: Path) -> str:
    inputs = read_report_inputs(out)
    return report_page(inputs, report_content(inputs, drawn=False))


def test_its_ids_are_unique(finished: Path) -> None:
    ids = re.findall(r'\bid="([^"]+)"', (finished / "report.html").read_text())
    assert len(ids) == len(set(ids))


def test_a_cut_out_shows_the_photo_at_the_mark(finished: Path) -> None:
    inputs = read_report_inputs(finished)
    points = inputs.read("georef.control")["points"]
    crops = cut_crops(points, inputs.part("ingest.photos"), inputs.photos_dir)
    seen = points[0]["observations"][0]
    crop = crops[0, 0]
    code = str(crop.picture).split(",")[1]
    cut = Image.open(io.BytesIO(base64.b64decode(code))).convert("RGB")
    left, top = (math.floor(value - CROP_SIDE_PX / 2) for value in seen["pixel"])
    with Image.open(capture_path() / seen["photo"]) as photo:
        true = photo.convert("RGB").crop((left, top, left + CROP_SIDE_PX, top + CROP_SIDE_PX))
    differences = [abs(a - b) for a, b in zip(cut.tobytes(), true.tobytes(), strict=True)]
    assert sum(differences) / len(differences) < 6.0  # JPEG's


def test_a_report_of_the_same_results_is_current_until_one_changes(copy_of_run: Path) -> None:
    report = copy_of_run / "report.html"
    write_report(copy_of_run, drawn=False)
    assert not is_current(copy_of_run)  # one without pictures is to be completed
    write_report(copy_of_run)
    assert is_current(copy_of_run)
    write_apart(copy_of_run / "events.jsonl", (copy_of_run / "events.jsonl").read_text() * 2)  # run again
    assert is_current(copy_of_run)
    measured = copy_of_run / "volumes.json"
    measured.write_text("{}")
    assert not is_current(copy_of_run)
    measured.unlink()
    assert is_current(copy_of_run)
    write_apart(copy_of_run / "georef.json", (copy_of_run / "georef.json").read_text() + "\n")
    assert not is_current(copy_of_run)
    report.unlink()
    assert not is_current(copy_of_run)


def test_a_stop_leaves_the_plain_report_when_there_is_no_time_for_pictures(copy_of_run: Path) -> None:
    (copy_of_run / "report.html").unlink()
    page = undrawn_page(copy_of_run)
    assert "splatpipe report writes the page again" in page and "<svg role=" not in page and "data:image" not in page
    make_report(copy_of_run, copy_of_run / "splatpipe.log", until_s=time.monotonic() + 600.0)
    assert "<svg role=" in (copy_of_run / "report.html").read_text()
    code = (
        "import sys; from pathlib import Path; from splatpipe.pipeline.app.report import write_report\n"
        f"write_report(Path({str(copy_of_run)!r}), drawn=False)\n"
        "print([name for name in ('matplotlib', 'torch', 'pycolmap', 'cv2') if name in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


@pytest.mark.parametrize(
    "part", ["georef.control", "evaluate.metrics", "sparse.summary", "train.history", "ingest.positions"]
)
def test_a_damaged_part_costs_only_its_chapter_of_the_report(copy_of_run: Path, part: str) -> None:
    path = read_report_inputs(copy_of_run).part(part)
    write_apart(path, "[" + " " * (path.stat().st_size - 2) + "]")  # other content of unchanged length
    page = undrawn_page(copy_of_run)
    assert page.count("This part could not be read") == 1
    assert "Processing</h2>" in page


def test_a_damaged_artifact_of_a_finished_run_is_not_reported_as_a_requested_end(
    copy_of_run: Path,
) -> None:
    write_apart(read_report_inputs(copy_of_run).part("sparse.summary").parent / "manifest.json", "{")
    verdict = judge(read_report_inputs(copy_of_run))
    assert verdict.level == "bad"
    assert verdict.headline == "Finished, but its results are damaged"
    assert "sparse" in verdict.text


def rewrite(path: Path, change: Callable[[dict[str, object]], None]) -> None:
    """Change a part of an artifact and keep the artifact valid."""
    data = json.loads(path.read_text())
    size = path.stat().st_size
    change(data)
    write_apart(path, json.dumps(data))
    manifest = path.parent / "manifest.json"
    write_apart(manifest, manifest.read_text().replace(f'"size": {size},', f'"size": {path.stat().st_size},'))


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
    page = undrawn_page(copy_of_run)
    table = page[page.index("Mapping methods tried") : page.index("Calibration</h3>")]
    assert "incremental" in table and "taken" in table and "nan" not in table


def test_an_interrupted_run_is_distinguished_from_a_running_one(copy_of_run: Path) -> None:
    lines = (copy_of_run / "events.jsonl").read_text().splitlines()
    started = next(i for i, line in enumerate(lines) if '"stage_started"' in line and '"train"' in line)
    (copy_of_run / "events.jsonl").write_text("\n".join(lines[: started + 4]))
    assert "Interrupted in train" in undrawn_page(copy_of_run)
    with (copy_of_run / "stages" / ".lock").open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert "Still running in train" in undrawn_page(copy_of_run)


def test_a_report_that_cannot_be_written_does_not_spoil_a_good_run(copy_of_run: Path) -> None:
    (copy_of_run / "report.html").unlink()
    (copy_of_run / "report.html").mkdir()
    done = splatpipe("stage", "split", copy_of_run, "--json")
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
    crops = cut_crops(points, None, None)
    assert len(crops) == MAX_CROPS
    assert {(0, 399), (1, 399), (2, 0), (2, 1), (2, 2)} <= set(crops) and (0, 0) not in crops


def test_no_folder_outside_out_is_named(copy_of_run: Path) -> None:
    secret = "/home/jane doe/customers/Brown"
    config = (copy_of_run / "config.toml").read_text()
    photos = tomllib.loads(config)["photos"]
    config = config.replace(photos, f"{secret}/photos").replace(
        'control = "auto"', f'control = "{secret}/points 2.csv"'
    )
    write_apart(copy_of_run / "config.toml", config)
    message = (
        f"{secret}/photos/a.jpg and {copy_of_run}/x and {secret}/points 2.csv and /srv/backup/y and {Path.home()}/z"
    )
    warning = {"kind": "warning", "stage": "georef", "data": {"message": message, "hint": message}, "time_s": 1e9}
    with (copy_of_run / "events.jsonl").open("a") as log:
        log.write(json.dumps(warning) + "\n")
    page = undrawn_page(copy_of_run)
    assert "PHOTOS/a.jpg and OUT/x and points 2.csv and y and z" in page
    for folder in ("jane", "customers", "Brown", "/srv", str(copy_of_run.parent), f"{Path.home()}/"):
        assert folder not in page
