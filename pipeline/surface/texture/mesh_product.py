"""The mesh of a capture as files: fused from depths, decimated to a budget, with the photos on it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatpipe.pipeline.engine.heap import return_free_heap
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.mvs.array_file import save_arrays
from splatpipe.pipeline.splat.containers.archives import open_archive
from splatpipe.pipeline.surface.shapes.decimation import decimate, simplifier, split_long_edges
from splatpipe.pipeline.surface.shapes.point_colours import photo_set, without_depths
from splatpipe.pipeline.surface.shapes.surface_mesh import MeshTask, fine_mesh, vertex_colours
from splatpipe.pipeline.surface.shapes.triangles import ColouredMesh, TriangleMesh, in_order
from splatpipe.pipeline.surface.shapes.tsdf import open3d
from splatpipe.pipeline.surface.texture.mesh_files import write_mesh
from splatpipe.pipeline.surface.texture.texture import TextureTask, texture_mesh
from splatpipe.pipeline.surface.texture.textured_mesh import FOLDER, save_textured_mesh

LONGEST_VOXELS = 16.0  # edges of triangles: over longer ones, a photo's perspective and what hides parts would show


@dataclass(frozen=True, eq=False)
class TexturedMeshTask:
    """Inputs of a textured mesh.

    Attributes:
        shape: Inputs of the mesh.
        cell_m: GSD of the photos, metres.
        most_texels: Limit on the texels of its pages.
    """

    shape: MeshTask
    cell_m: float
    most_texels: float


def make_mesh(task: TexturedMeshTask, work: Path, out: Path, report: Reporter) -> dict[str, Any]:
    """Write the mesh's files and pages to `files/mesh/`, and `textured.npz`; bit-identical for any number of threads.

    A killed run resumes from the full mesh, the decimated one, the choice of photos, or the last page.

    Args:
        task: Inputs.
        work: Folder for intermediate files.
        out: Output folder, with `files/mesh/`.
        report: Receives progress.

    Returns:
        Statistics: triangles, vertices, area, voxel size, texture pages and their pixels.

    Raises:
        MachineError: if open3d or fast-simplification is not installed, or the disk is full.
        SplatpipeError: if there is no surface that enough photos see.
        ValueError: if depths or pixels do not fit their camera.
    """
    open3d()
    simplifier()
    shape = task.shape
    photos = photo_set(shape.surface.photos, shape.voxel_m, shape.threads)
    work.mkdir(parents=True, exist_ok=True)
    fine, reduced = work / "fine.npz", work / "mesh.npz"
    if not fine.is_file() and not reduced.is_file():
        mesh, voxel_m = fine_mesh(shape, photos, report)
        save_arrays(fine, vertices=mesh.vertices, triangles=mesh.triangles, voxel_m=np.array(voxel_m))
    if not reduced.is_file():
        photos = without_depths(photos)  # reducing takes a gigabyte
        mesh, voxel_m = _load_mesh(fine)
        report.progress(0, 1, "decimating the mesh", "meshes")
        mesh = _decimate(mesh, shape.most_triangles, voxel_m)
        return_free_heap()
        colours = vertex_colours(photos, mesh, shape.threads)
        arrays = {"vertices": mesh.vertices, "triangles": mesh.triangles, "colours": colours}
        save_arrays(reduced, **arrays, voxel_m=np.array(voxel_m))
        report.progress(1, 1, "decimating the mesh", "meshes")
    mesh, voxel_m = _load_mesh(reduced)
    with open_archive(reduced) as kept:
        coloured = ColouredMesh(mesh, kept["colours"])
    folder = out / "files" / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    texturing = TextureTask(photos, task.cell_m, task.most_texels, shape.threads)
    made = texture_mesh(texturing, coloured, work, folder, report)
    mesh = made.coloured.mesh
    write_mesh(folder, made, shape.surface.frame, shape.surface.boundary)
    save_textured_mesh(out / "textured.npz", made)
    return {
        "triangles": len(mesh.triangles),
        "vertices": len(mesh.vertices),
        "area_m2": round(float(mesh.areas().sum()), 1),
        "voxel_m": round(voxel_m, 6),
        "pages": len(made.pages),
        "texture_pixels": int(made.atlas.sizes.astype(np.int64).prod(axis=1).sum()),
    }


def _load_mesh(path: Path) -> tuple[TriangleMesh, float]:
    with open_archive(path) as kept:
        return TriangleMesh(kept["vertices"], kept["triangles"]), float(kept["voxel_m"])


def _decimate(mesh: TriangleMesh, most: int, voxel_m: float) -> TriangleMesh:
    """A mesh of at most so many triangles, without long ones where the limit allows that."""
    longest = LONGEST_VOXELS * voxel_m
    coarse = decimate(mesh, most)
    split = in_order(split_long_edges(coarse, longest))
    if len(split.triangles) > most:
        coarse = decimate(mesh, int(most * most / len(split.triangles)))
        split = in_order(split_long_edges(coarse, longest))
    return split if len(split.triangles) <= most else coarse
