"""cloud: the dense cloud of the photos' depths."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.surface.dense_cloud import CloudTask, make_cloud
from splatpipe.pipeline.surface.options import CloudConfig
from splatpipe.pipeline.surface.run_sources import open_surveyed


def run(config: CloudConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `files/cloud.laz`; nothing where there is no site.

    Raises:
        SplatpipeError: if the site is absurdly large, or depths are broken.
        MachineError: if the disk is full.
    """
    (out / "files").mkdir(exist_ok=True)
    opened = open_surveyed(inputs, report) if config.enabled else None
    if opened is None:
        report.progress(1, 1, "nothing is made", "steps")
        return {"points": 0}
    surface, site, _ = opened
    spacing_m = config.spacing_m or site.gsd_m
    task = CloudTask(surface.frame, site, surface.photos, surface.area, spacing_m, inputs.machine.threads)
    return make_cloud(task, out / "parts", out / "files", report)
