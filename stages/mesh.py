"""mesh: a triangle mesh of the surface on which the depth maps agree, coloured from the photos."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.surface.depths.run_sources import open_surveyed
from splatpipe.pipeline.surface.options import MeshConfig
from splatpipe.pipeline.surface.shapes.surface_mesh import MeshTask, make_mesh

VOXEL_GSD = 2.0  # voxel size over the photos' GSD


def run(config: MeshConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `files/mesh/`: mesh.glb, mesh.ply and georef.json; nothing if there is no site.

    Raises:
        SplatpipeError: if no surface is seen by enough photos, or a depth map is broken.
        MachineError: if open3d is not installed, or the disk is full.
    """
    (out / "files").mkdir(exist_ok=True)
    opened = open_surveyed(config.enabled, inputs, report)
    if opened is None:
        return {"triangles": 0}
    surface, site, _ = opened
    folder = out / "files" / "mesh"
    folder.mkdir(exist_ok=True)
    task = MeshTask(surface, site, VOXEL_GSD * site.gsd_m, config.triangles, inputs.machine.threads)
    return make_mesh(task, out / "work", folder, report)
