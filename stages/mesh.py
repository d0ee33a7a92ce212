"""mesh: a triangle mesh of the surface on which the depth maps agree, with the photos on it."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.surface.depths.run_sources import open_surveyed
from splatpipe.pipeline.surface.options import MeshConfig
from splatpipe.pipeline.surface.shapes.surface_mesh import MeshTask
from splatpipe.pipeline.surface.texture.mesh_product import TexturedMeshTask, make_mesh
from splatpipe.pipeline.surface.texture.textured_mesh import save_textured_mesh

VOXEL_GSD = 2.0  # voxel size over the photos' GSD
MEGA = 1_000_000


def run(config: MeshConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `files/mesh/` (glTF, OBJ, PLY, texture pages, georef.json) and `textured.npz`, which other products read.

    Both are empty if there is no site.

    Raises:
        SplatpipeError: if no surface is seen by enough photos, or a depth map is broken.
        MachineError: if open3d is not installed, or the disk is full.
    """
    (out / "files").mkdir(exist_ok=True)
    opened = open_surveyed(config.enabled, inputs, report)
    if opened is None:
        save_textured_mesh(out / "textured.npz", None)
        return {"triangles": 0}
    surface, site, _ = opened
    shape = MeshTask(surface, site, VOXEL_GSD * site.gsd_m, config.triangles, inputs.machine.threads)
    task = TexturedMeshTask(shape, site.gsd_m, config.texture_megapixels * MEGA)
    return make_mesh(task, out / "work", out, report)
