"""cloud: the dense point cloud from the photos' depth maps."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.surface.depths.run_sources import open_surveyed
from splatpipe.pipeline.surface.options import CloudConfig
from splatpipe.pipeline.surface.shapes.dense_cloud import CloudTask, make_cloud


def run(config: CloudConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `files/cloud.laz`; nothing if there is no site.

    Raises:
        SplatpipeError: if the site is absurdly large, or a depth map is broken.
        MachineError: if the disk is full.
    """
    (out / "files").mkdir(exist_ok=True)
    opened = open_surveyed(config.enabled, inputs, report)
    if opened is None:
        return {"points": 0}
    surface, site, _ = opened
    task = CloudTask(surface, site, config.spacing_m or site.gsd_m, inputs.machine.threads)
    return make_cloud(task, out / "parts", out / "files", report)
