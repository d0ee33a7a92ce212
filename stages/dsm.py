"""dsm: the height of the topmost surface, from the depths of the photos."""

from __future__ import annotations

import math
import statistics
from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.geometry.plan_area import read_world_area
from splatpipe.pipeline.mvs.depth_maps import kept_depth_maps
from splatpipe.pipeline.photos.dataset import load_views
from splatpipe.pipeline.photos.photo_list import load_photo_list
from splatpipe.pipeline.photos.undistortion import place, read_flown
from splatpipe.pipeline.surface.dsm import DsmTask, make_dsm
from splatpipe.pipeline.surface.options import DsmConfig
from splatpipe.pipeline.surface.run_sources import depth_sources, times_finer
from splatpipe.pipeline.surface.site import save_site, survey_site
from splatpipe.pipeline.survey.frames import load_frame

CELL_GSD = 2.0  # of the photos: heights are known less finely than colours; and no more finely than depths


def run(config: DsmConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `files/` (dsm.tif, dsm_confidence.tif, contours) and `site.json`; nothing where it cannot be made.

    Raises:
        SplatpipeError: if its grid would be absurdly large.
        StageError: if the depths cannot be read.
        MachineError: if the disk is full.
    """
    (out / "files").mkdir(exist_ok=True)
    frame, views = load_frame(inputs["georef.frame"]), load_views(inputs["undistort.dataset"])
    maps = kept_depth_maps(inputs["depths.maps"], views) if config.enabled and frame.in_metres else []
    if config.enabled and not frame.in_metres:
        report.note("The reconstruction has no scale, so there is no surface model, and nothing that is made from it.")
    sources = depth_sources(maps, frame.world_from_model)
    area = read_world_area(inputs.parts.get("georef.boundary"))
    photos = load_photo_list(inputs["ingest.photos"]).photos
    placed = place(read_flown(inputs["georef.model"]), photos, math.inf, report) if maps else []
    finer = times_finer(maps, placed)
    site = survey_site(sources, finer, area, inputs.machine.threads)
    if site is None:
        save_site(out / "site.json", None)
        if maps:
            report.warning("No place is seen well by three photos, so there is no surface model.")
        return {"cells": 0}
    cell_m = config.cell_m or max(CELL_GSD, statistics.median(finer)) * site.gsd_m
    save_site(out / "site.json", site, cell_m)
    task = DsmTask(frame, site, sources, area, cell_m, inputs.machine.threads)
    return {**make_dsm(task, out / "sheets", out / "files", report), "gsd_m": round(site.gsd_m, 5)}
