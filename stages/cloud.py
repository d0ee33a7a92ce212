"""cloud: the dense point cloud from the photos' depth maps, classified by the terrain model."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.surface.depths.run_sources import RunSurface, open_surveyed
from splatpipe.pipeline.surface.depths.site_extent import SiteExtent
from splatpipe.pipeline.surface.ground.dtm import noise_gsd
from splatpipe.pipeline.surface.ground.point_classes import PointClassifier
from splatpipe.pipeline.surface.heights.surface_file import open_surface
from splatpipe.pipeline.surface.options import CloudConfig
from splatpipe.pipeline.surface.rasters.grid import make_grid
from splatpipe.pipeline.surface.shapes.dense_cloud import Classify, CloudTask, make_cloud


def run(config: CloudConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `files/cloud.laz`; nothing if there is no site.

    Raises:
        SplatpipeError: if the site is absurdly large, or a depth map or a terrain model is broken.
        MachineError: if the disk is full.
    """
    (out / "files").mkdir(exist_ok=True)
    opened = open_surveyed(config.enabled, inputs, report)
    if opened is None:
        return {"points": 0}
    surface, site, dsm_cell_m = opened
    classify = _classifier(inputs, surface, site, dsm_cell_m)
    if classify is None:
        report.note("There is no terrain model, so the points are not classified.")
    task = CloudTask(surface, site, config.spacing_m or site.gsd_m, inputs.machine.threads, classify)
    return make_cloud(task, out / "parts", out / "files", report)


def _classifier(inputs: Inputs, surface: RunSurface, site: SiteExtent, cell_m: float) -> Classify | None:
    terrain, cover = inputs["dtm.files"] / "dtm.tif", inputs["dtm.cover"] / "cover.tif"
    if not (terrain.is_file() and cover.is_file()):
        return None
    grid = make_grid(surface.frame, site.box, cell_m)
    top, ground, shown = (open_surface(path) for path in (inputs["dsm.files"] / "dsm.tif", terrain, cover))
    return PointClassifier(top, ground, shown, grid, noise_gsd(site.gsd_m, grid)).classify
