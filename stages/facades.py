"""facades: orthographic elevations of the walls that photos show."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.surface.depths.run_sources import open_surveyed
from splatpipe.pipeline.surface.facades.facades import FacadesTask, make_facades, parse_lines
from splatpipe.pipeline.surface.options import FacadesConfig


def run(config: FacadesConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `files/facades/`; nothing if there is no site.

    Raises:
        SplatpipeError: if there is no wall along a given line, a wall has too many pixels, or a depth map is broken.
        MachineError: if the disk is full.
    """
    (out / "files").mkdir(exist_ok=True)
    opened = open_surveyed(config.enabled, inputs, report)
    if opened is None:
        return {"facades": 0}
    surface, site, _ = opened
    folder = out / "files" / "facades"
    folder.mkdir(exist_ok=True)
    pixel_m = config.gsd_m or site.gsd_m
    task = FacadesTask(surface, pixel_m, parse_lines(config.lines), inputs.machine.threads)
    facts = make_facades(task, folder, report)
    return {"facades": len(facts), "names": [each["name"] for each in facts], "pixel_m": round(pixel_m, 6)}
