"""dsm: the digital surface model (height of the topmost surface) from the photos' depth maps."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.surface.depths.run_sources import open_run_surface
from splatpipe.pipeline.surface.depths.site_extent import measure_extent, save_site
from splatpipe.pipeline.surface.heights.dsm import DsmTask, make_dsm
from splatpipe.pipeline.surface.options import DsmConfig

CELL_GSD = 2.0  # times the photos' GSD: heights are known less finely than colours, and no more finely than depths


def run(config: DsmConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `files/` (dsm.tif, dsm_confidence.tif) and `site.json`; no files if there are no usable depths.

    Raises:
        SplatpipeError: if the grid would be absurdly large, or an input is broken.
        MachineError: if the disk is full.
    """
    (out / "files").mkdir(exist_ok=True)
    save_site(out / "site.json", None)
    surface = open_run_surface(inputs, report) if config.enabled else None
    if surface is None:
        report.progress(1, 1, "nothing is made", "steps")
        if config.enabled:
            report.note("There are no depths in metres, so there is no surface model and no product that needs one.")
        return {"cells": 0}
    site = measure_extent(surface.depths, surface.finer, surface.area, inputs.machine.threads)
    if site is None:
        report.progress(1, 1, "nothing is made", "steps")
        report.warning("No part of the scene is seen well by three photos, so there is no surface model.")
        return {"cells": 0}
    cell_m = config.cell_m or max(CELL_GSD, surface.finer) * site.gsd_m
    save_site(out / "site.json", site, cell_m)
    task = DsmTask(surface, site, cell_m, inputs.machine.threads)
    return {**make_dsm(task, out / "sheets", out / "files", report), "gsd_m": round(site.gsd_m, 5)}
