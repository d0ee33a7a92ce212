"""Control, budgets, and reconstructions of other programs, given to runs of a few photos of the demo capture."""

import json
from pathlib import Path

from command import answered, ran
from PIL import Image
from quick_line import QUICK, STAGES, SURFACES, sets

from splatpipe.demo import capture_path


def test_control_given_to_a_finished_run_retrains_nothing(copy_of_run: Path, tmp_path: Path) -> None:
    """Targets and georef anew, then only what reads the frame; once more with a point less, and with another CRS."""
    lines = (capture_path().parent / "gcp_list.txt").read_text().splitlines()
    more = tmp_path / "more points.txt"
    more.write_text("\n".join(lines))
    fewer = tmp_path / "fewer.txt"
    fewer.write_text("\n".join(line for line in lines if not line.endswith(" P15")))
    before = json.loads((copy_of_run / "metrics.json").read_text())
    for file in (fewer, more):
        result = answered("georef", copy_of_run, "--gcp", file)
        assert ran(result) == ["control", "targets", "georef", "evaluate", "export", *SURFACES]
    after = json.loads((copy_of_run / "metrics.json").read_text())
    assert before["accuracy"]["splat"] is None and after["psnr"] == before["psnr"]
    tables = after["accuracy"]["tables"]
    assert tables["control"]["count"] > tables["check"]["count"] > 1 and tables["check"]["rmse_3d_m"] < 0.3
    assert after["accuracy"]["splat"]["points"]
    assert json.loads((copy_of_run / "georef.json").read_text())["crs"]["id"] == "EPSG:32633"
    assert ran(answered("georef", copy_of_run)) == []
    result = answered("georef", copy_of_run, *sets("georef.crs=EPSG:31255"))
    assert "train" not in ran(result) and ran(result)[-5:] == ["export", *SURFACES]
    assert json.loads((copy_of_run / "georef.json").read_text())["crs"]["id"] == "EPSG:31255"


def test_a_reconstruction_of_another_program_enters_at_georef(photos: Path, copy_of_run: Path, tmp_path: Path) -> None:
    larger = sets(*QUICK, "undistort.max_megapixels=0.1")
    answered("run", photos, copy_of_run, *larger, "--until", "undistort")
    dataset = next(path for path in (copy_of_run / "stages").glob("undistort-*/dataset") if is_larger(path))
    result = answered("run", dataset, tmp_path / "other", *sets(*QUICK))
    assert ran(result) == [name for name in STAGES if name not in ("features", "matches", "sparse")]
    metrics = json.loads((tmp_path / "other" / "metrics.json").read_text())
    assert metrics["registered"] == 12


def is_larger(dataset: Path) -> bool:
    with Image.open(next((dataset / "images").iterdir())) as picture:
        return picture.width > 320


def test_a_budget_is_planned_shown_and_reused(photos: Path, copy_of_run: Path) -> None:
    budgets = ("--time-budget", "8s", "--max-memory", "4G")
    result = answered("run", photos, copy_of_run, *sets(*QUICK), *budgets)
    retrained = ["blocks", "train", "clean", "evaluate", "export", "flythrough"]
    assert ran(result) == [*retrained, *SURFACES]  # which it turns off
    events = [json.loads(line) for line in (copy_of_run / "events.jsonl").read_text().splitlines()]
    notes = [event["data"]["message"] for event in events if event["kind"] == "note"]
    assert any(note.startswith("plan: ") and "8 s budget, within 4.0 GB" in note for note in notes), notes
    metrics = json.loads((copy_of_run / "metrics.json").read_text())
    assert metrics["time_budget_s"] == 8.0 and metrics["iterations"] > 0 and metrics["planned_iterations"] > 0
    assert ran(answered("run", photos, copy_of_run, *sets(*QUICK), *budgets)) == []
