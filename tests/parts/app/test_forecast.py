"""Forecasts of a real run, beside what it used."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from command import answered

from splatpipe.stages.forecast.needs import machine_speed


def test_it_is_cheap_and_runs_anywhere() -> None:
    code = "import sys, splatpipe.stages.forecast.needs; print({'numpy', 'torch', 'cv2'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
    assert 0.25 <= machine_speed() <= 4.0


def test_each_manifest_has_the_forecast_beside_what_was_used(demo_run: Path) -> None:
    output = answered("status", demo_run)
    assert [stage["name"] for stage in output["stages"] if stage["forecast"] is None] == ["ingest"]
    for stage in output["stages"][1:]:
        assert set(stage["forecast"]) == set(stage["used"]) == {"memory_bytes", "cpu_seconds", "disk_bytes"}
    used, forecasts = ([stage[kind] for stage in output["stages"][1:]] for kind in ("used", "forecast"))
    for kind, join in (("memory_bytes", max), ("cpu_seconds", sum), ("disk_bytes", sum)):
        assert 0.25 < join(each[kind] for each in forecasts) / join(each[kind] for each in used) < 4.0
    for path in demo_run.glob("stages/*/manifest.json"):
        assert "forecast" not in json.loads(path.read_text())["inputs"]
    assert "<th>forecast</th>" in (demo_run / "report.html").read_text(encoding="utf-8")
