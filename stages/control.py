"""control: read the surveyed points, without their marks, and the scale bars; reports broken files before any work."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.survey.files.control_file import read_control_file
from splatpipe.pipeline.survey.files.scale_bars import ScaleBar, read_scale_bars
from splatpipe.pipeline.survey.options import ControlConfig
from splatpipe.pipeline.survey.targets.target_finds import WantedTargets, save_wanted


def run(config: ControlConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write the part points (``points.json``). Marks are left to georef, so that a changed mark needs no new search.

    Raises:
        SplatpipeError: if one of the files is broken.
    """
    del config
    crs, points = "", []
    bars: tuple[ScaleBar, ...] = ()
    if inputs["source.control"].is_file():
        file = read_control_file(inputs["source.control"])
        crs = file.crs.text
        points = [(point.name, point.x, point.y, point.z) for point in file.points]
    if inputs["source.scale_bars"].is_file():
        bars = read_scale_bars(inputs["source.scale_bars"])
    save_wanted(WantedTargets(crs, tuple(points), bars), out / "points.json")
    report.progress(1, 1, "reading the control", "steps")
    return {"points": len(points), "scale_bars": len(bars)}
