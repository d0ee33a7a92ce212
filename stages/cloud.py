"""cloud: the dense cloud of the photos' depths."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.surface.dense_cloud import CloudTask, make_cloud
from splatpipe.pipeline.surface.options import CloudConfig
from splatpipe.pipeline.surface.run_sources import open_run_surface
from splatpipe.pipeline.surface.site import load_site


def run(config: CloudConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `files/cloud.laz`; nothing where there is no site.

    Raises:
        SplatpipeError: if the site is absurdly large, or depths are broken.
        MachineError: if the disk is full.
    """
    (out / "files").mkdir(exist_ok=True)
    surveyed = load_site(inputs["dsm.site"]) if config.enabled else None
    surface = None if surveyed is None else open_run_surface(inputs, report)
    if surveyed is None or surface is None:
        return {"points": 0}
    site = surveyed[0]
    spacing_m = config.spacing_m or site.gsd_m
    task = CloudTask(surface.frame, site, surface.photos, surface.area, spacing_m, inputs.machine.threads)
    return make_cloud(task, out / "parts", out / "files", report)
