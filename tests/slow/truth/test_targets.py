"""The demo, placed by its targets alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from measure import SilentReporter

from splatpipe.demo import capture_path
from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.photos.files.photo_list import load_photo_list
from splatpipe.pipeline.survey.options import ControlConfig, TargetsConfig
from splatpipe.pipeline.survey.placing.gps import georeference, read_positions
from splatpipe.pipeline.survey.placing.model import read_model
from splatpipe.pipeline.survey.targets.target_finds import load_finds, load_wanted
from splatpipe.pipeline.survey.targets.target_survey import TargetSurvey
from splatpipe.stages.control import run as read_control
from splatpipe.stages.targets import run as find_targets


def test_demo_is_placed_by_its_targets_alone(demo_run: Path, tmp_path: Path) -> None:
    """With all marks removed from the file, the detected points lie at their surveyed positions."""
    lines = [line.split() for line in (capture_path().parent / "gcp_list.txt").read_text().splitlines()]
    points = {fields[6]: fields[:3] for fields in lines[1:]}
    file = tmp_path / "control.csv"
    file.write_text("\n".join([lines[0][0], "name,x,y,z", *(",".join([n, *xyz]) for n, xyz in points.items())]))
    stages = {path.name.split("-")[0]: path for path in (demo_run / "stages").iterdir() if path.is_dir()}
    (tmp_path / "control").mkdir()
    (tmp_path / "targets").mkdir()
    parts = {
        "source.control": file,
        "source.scale_bars": tmp_path / "none",
        "control.points": tmp_path / "control" / "points.json",
        "sparse.model": stages["sparse"] / "sparse" / "0",
        "ingest.photos": stages["ingest"] / "photos",
        "ingest.positions": stages["ingest"] / "positions.json",
    }
    settings = {"georef.max_position_error_m": "auto", "georef.approximate_crs": False}
    inputs = Inputs(parts, capture_path(), settings)
    read_control(ControlConfig(), inputs, tmp_path / "control", SilentReporter())
    find_targets(TargetsConfig(), inputs, tmp_path / "targets", SilentReporter())
    finds = load_finds(tmp_path / "targets" / "targets.json")
    photos = load_photo_list(parts["ingest.photos"]).by_name()
    model = read_model(parts["sparse.model"], photos)
    frame, _ = georeference(model, read_positions(parts["ingest.positions"]), "auto", photos)
    survey = TargetSurvey(load_wanted(parts["control.points"]), finds, model, photos, frame, False)
    found = survey.marks({}, SilentReporter()).pixels()
    truth = {p["name"]: p["seen_px"] for p in json.loads((capture_path().parent / "truth.json").read_text())["points"]}
    off = [
        np.hypot(*(np.array(pixel) - truth[name][photo]))
        for name, marks in found.items()
        for photo, pixel in marks.items()
        if photo in truth[name]
    ]
    assert len(found) >= 16 and len(off) > 200
    assert np.sqrt(np.square(off).mean()) < 0.1 and max(off) < 1.0  # none is another's
