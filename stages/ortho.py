"""ortho: the true orthophoto, projected from the original photos onto the surface model."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.surface.depths.run_sources import open_surveyed
from splatpipe.pipeline.surface.options import OrthoConfig
from splatpipe.pipeline.surface.ortho.ortho import OrthoTask, make_ortho


def run(config: OrthoConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `files/ortho.tif`; nothing if there is no surface model.

    Raises:
        SplatpipeError: if the grid would be absurdly large, a photo has changed, or a depth map is broken.
        MachineError: if the disk is full.
    """
    (out / "files").mkdir(exist_ok=True)
    opened = open_surveyed(config.enabled, inputs, report)
    if opened is None:
        return {"pixels": 0}
    surface, site, dsm_cell_m = opened
    dsm, gsd_m = inputs["dsm.files"] / "dsm.tif", config.gsd_m or site.gsd_m
    task = OrthoTask(surface, site, dsm, dsm_cell_m, gsd_m, inputs.machine.threads)
    return make_ortho(task, out / "sheets", out / "files", report)
