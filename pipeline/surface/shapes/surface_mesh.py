"""The mesh of a capture: fused from depths, cleaned, decimated to a budget, coloured from the photos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8
from scipy.spatial import cKDTree

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.mvs.array_file import save_arrays
from splatpipe.pipeline.splat.containers.archives import open_archive
from splatpipe.pipeline.surface.depths.photo_set import PhotoSet, SurfacePieces
from splatpipe.pipeline.surface.depths.run_sources import RunSurface
from splatpipe.pipeline.surface.depths.site_extent import SiteExtent
from splatpipe.pipeline.surface.shapes.blocks import surface_blocks
from splatpipe.pipeline.surface.shapes.mesh_files import write_mesh
from splatpipe.pipeline.surface.shapes.point_colours import photo_set, point_colours
from splatpipe.pipeline.surface.shapes.triangles import ColouredMesh, TriangleMesh, remove_small_components
from splatpipe.pipeline.surface.shapes.tsdf import open3d, tsdf_mesh

# Blocks of voxels: 0.25 GB, and 2.5 million triangles before decimation; beyond it voxels are larger.
MAX_BLOCKS = 55_000
CRUMB_VOXELS = 200.0  # area in voxel faces: smaller pieces are floating noise or not worth keeping
GREY = 128  # colour value for a mesh that no photo shows


@dataclass(frozen=True, eq=False)
class MeshTask:
    """Inputs of a mesh.

    Attributes:
        surface: The run's photos and depths; triangles with all corners inside of its area are kept.
        site: The area that they cover.
        voxel_m: Voxel size, 2 GSD, metres; increased for large sites.
        most_triangles: Maximum number of triangles after decimation.
        threads: Photos in parallel.
    """

    surface: RunSurface
    site: SiteExtent
    voxel_m: float
    most_triangles: int
    threads: int


def make_mesh(task: MeshTask, work: Path, out: Path, report: Reporter) -> dict[str, Any]:
    """Write `mesh.glb`, `mesh.ply` and `georef.json`; bit-identical for any number of threads.

    A killed run resumes from the full mesh before decimation, if it got that far.

    Args:
        task: Inputs.
        work: Folder for intermediate files.
        out: Output folder.
        report: Receives progress.

    Returns:
        Statistics: triangles, vertices, area, voxel size.

    Raises:
        MachineError: if open3d is not installed, or the disk is full.
        SplatpipeError: if there is no surface that enough photos see.
        ValueError: if depths or pixels do not fit their camera.
    """
    open3d()
    photos = photo_set(task.surface.photos, task.voxel_m, task.threads)
    work.mkdir(exist_ok=True)
    kept = work / "fine.npz"
    if not kept.is_file():
        _save_fine(kept, *fine_mesh(task, photos, report))
    mesh, voxel_m = _load_fine(kept)
    report.progress(0, 1, "decimating the mesh", "meshes")
    mesh = decimate(mesh, task.most_triangles)
    report.progress(1, 1, "decimating the mesh", "meshes")
    made = ColouredMesh(mesh, vertex_colours(photos, mesh, task.threads))
    write_mesh(out, made, task.surface.frame, task.surface.boundary)
    return {
        "triangles": len(mesh.triangles),
        "vertices": len(mesh.vertices),
        "area_m2": round(float(mesh.areas().sum()), 1),
        "voxel_m": round(voxel_m, 6),
    }


def _save_fine(path: Path, mesh: TriangleMesh, voxel_m: float) -> None:
    save_arrays(path, vertices=mesh.vertices, triangles=mesh.triangles, voxel_m=np.array(voxel_m))


def _load_fine(path: Path) -> tuple[TriangleMesh, float]:
    with open_archive(path) as kept:
        return TriangleMesh(kept["vertices"], kept["triangles"]), float(kept["voxel_m"])


def fine_mesh(task: MeshTask, photos: PhotoSet, report: Reporter) -> tuple[TriangleMesh, float]:
    """The mesh before decimation, and its voxel size in metres."""
    box = task.site.box
    blocks = surface_blocks(photos, box, task.voxel_m, MAX_BLOCKS, task.threads)
    if blocks.voxel_m > task.voxel_m:
        report.note(f"The mesh has voxels of {blocks.voxel_m:.3g} m, not {task.voxel_m:.3g} m: the site is large.")
    mesh = tsdf_mesh(photos, box, blocks, task.threads, report)
    if task.surface.area is not None:
        mesh = mesh.select(task.surface.area.contains(mesh.vertices)[mesh.triangles].all(axis=1))
    mesh = remove_small_components(mesh, CRUMB_VOXELS * blocks.voxel_m**2)
    if not len(mesh.triangles):
        raise SplatpipeError(
            "No surface is seen by three photos, so there is no mesh.", "Add overlap, or use a wider boundary."
        )
    return mesh, blocks.voxel_m


def decimate(mesh: TriangleMesh, most: int) -> TriangleMesh:
    """Decimate a mesh to a maximum number of triangles (quadric error metrics; Garland and Heckbert 1997).

    Args:
        mesh: Mesh in canonical order.
        most: Maximum number of triangles.
    """
    if len(mesh.triangles) <= most:
        return mesh
    o3d = open3d()
    low = mesh.vertices.min(axis=0)  # float32 is finer near zero
    vertices, triangles = (mesh.vertices - low).astype(np.float32), mesh.triangles.astype(np.int32)
    coarse = o3d.t.geometry.TriangleMesh(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles))
    size, before = len(triangles), 0
    while size > most and size != before:  # one pass over a large mesh leaves more than requested
        coarse = coarse.simplify_quadric_decimation(1.0 - most / size)
        size, before = len(coarse.triangle.indices), size
    found = coarse.vertex.positions.numpy().astype(np.float64) + low
    whole = TriangleMesh(found, coarse.triangle.indices.numpy().astype(np.int64))
    return whole.select(whole.areas() > 0.0)


def vertex_colours(photos: PhotoSet, mesh: TriangleMesh, threads: int) -> UInt8[np.ndarray, "n 3"]:
    """Colours of a mesh's vertices from the photos; unseen vertices get the colour of the nearest seen one."""
    pieces = SurfacePieces(np.ascontiguousarray(mesh.vertices.T), np.ascontiguousarray(mesh.normals().T))
    spacing_m = float(np.sqrt(mesh.areas().sum() / len(mesh.vertices)))
    colours, known = point_colours(photos, pieces, spacing_m, threads)
    return _fill_unseen(mesh, colours, known)


def _fill_unseen(
    mesh: TriangleMesh, colours: UInt8[np.ndarray, "n 3"], known: Bool[np.ndarray, " n"]
) -> UInt8[np.ndarray, "n 3"]:
    if not known.any():
        return np.full_like(colours, GREY)
    nearest = cKDTree(mesh.vertices[known]).query(mesh.vertices[~known])[1]
    colours = colours.copy()
    colours[~known] = colours[known][nearest]
    return colours
