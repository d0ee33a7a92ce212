"""dtm: the terrain model, from the surface model, and the contours of either."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.surface.depths.site_extent import load_site
from splatpipe.pipeline.surface.ground.dtm import DtmTask, make_dtm
from splatpipe.pipeline.surface.heights.contour_files import draw_contours
from splatpipe.pipeline.surface.heights.surface_file import open_surface
from splatpipe.pipeline.surface.options import DtmConfig
from splatpipe.pipeline.surface.rasters.grid import make_grid
from splatpipe.pipeline.survey.crs.frames import load_frame


def run(config: DtmConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `files/` (dtm.tif, dtm_confidence.tif, chm.tif, contours) and `cover/`; nothing if off or without a site.

    Raises:
        SplatpipeError: if the surface model or the site is broken.
        MachineError: if the disk is full.
    """
    files, cover = out / "files", out / "cover"
    files.mkdir(exist_ok=True)
    cover.mkdir(exist_ok=True)
    surveyed = load_site(inputs["dsm.site"]) if config.enabled else None  # a stage that is off gets no inputs
    if surveyed is None:
        report.progress(1, 1, "nothing is made", "steps")
        return {"cells": 0}
    site, cell_m = surveyed
    grid = make_grid(load_frame(inputs["georef.frame"]), site.box, cell_m)
    dsm = inputs["dsm.files"] / "dsm.tif"
    surface = open_surface(dsm, inputs["dsm.files"] / "dsm_confidence.tif")
    task = DtmTask(surface, grid, site.gsd_m, inputs.machine.threads)
    facts = make_dtm(task, out / "parts", files, cover / "cover.tif", report)
    draw_contours(files / "dtm.tif" if config.contours == "dtm" else dsm, files, grid, report)
    report.progress(1, 1, "contours", "steps")
    return {**facts, "contours": "ground" if config.contours == "dtm" else "surface"}
