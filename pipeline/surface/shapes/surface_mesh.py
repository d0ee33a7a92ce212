"""The surface of a capture as a mesh: fused from depths and cleaned, with colours from the photos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8
from scipy.spatial import cKDTree

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.surface.depths.photo_set import PhotoSet, SurfacePieces
from splatpipe.pipeline.surface.depths.run_sources import RunSurface
from splatpipe.pipeline.surface.depths.site_extent import SiteExtent
from splatpipe.pipeline.surface.shapes.blocks import surface_blocks
from splatpipe.pipeline.surface.shapes.point_colours import point_colours
from splatpipe.pipeline.surface.shapes.triangles import TriangleMesh, remove_small_components
from splatpipe.pipeline.surface.shapes.tsdf import tsdf_mesh

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
