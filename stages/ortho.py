"""ortho: the true orthophoto, on the surface model, from the photos as flown."""

from __future__ import annotations

import math
from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.geometry.plan_area import read_world_area
from splatpipe.pipeline.mvs.depth_maps import kept_depth_maps
from splatpipe.pipeline.photos.dataset import load_views
from splatpipe.pipeline.photos.photo_list import load_photo_list
from splatpipe.pipeline.photos.undistortion import place, read_flown
from splatpipe.pipeline.surface.options import OrthoConfig
from splatpipe.pipeline.surface.ortho import OrthoTask, make_ortho
from splatpipe.pipeline.surface.run_sources import depth_sources, photo_sources
from splatpipe.pipeline.surface.site import load_site
from splatpipe.pipeline.survey.frames import load_frame


def run(config: OrthoConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `files/ortho.tif`; nothing where there is no surface model.

    Raises:
        SplatpipeError: if its grid would be absurdly large, or a photo is no longer what it was.
        StageError: if the depths cannot be read.
        MachineError: if the disk is full.
    """
    (out / "files").mkdir(exist_ok=True)
    surveyed = load_site(inputs["dsm.site"]) if config.enabled else None
    if surveyed is None:
        return {"pixels": 0}
    site, dsm_cell_m = surveyed
    frame, views = load_frame(inputs["georef.frame"]), load_views(inputs["undistort.dataset"])
    maps = kept_depth_maps(inputs["depths.maps"], views)
    depths = dict(zip((kept.camera.name for kept in maps), depth_sources(maps, frame.world_from_model), strict=True))
    flown = place(read_flown(inputs["georef.model"]), load_photo_list(inputs["ingest.photos"]).photos, math.inf, report)
    photos = photo_sources(flown, depths, frame.world_from_model, (inputs["ingest.photos"], inputs.photos_dir))
    area = read_world_area(inputs.parts.get("georef.boundary"))
    task = OrthoTask(
        frame,
        site,
        photos,
        inputs["dsm.files"] / "dsm.tif",
        dsm_cell_m,
        area,
        config.gsd_m or site.gsd_m,
        inputs.machine.threads,
    )
    return make_ortho(task, out / "sheets", out / "files", report)
