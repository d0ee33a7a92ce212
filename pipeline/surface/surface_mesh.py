"""The mesh of a capture: joined from depths, cleaned, decimated to a budget, coloured from the photos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8
from scipy.spatial import cKDTree

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.surface.blocks import Box, surface_blocks
from splatpipe.pipeline.surface.photo_set import Facing, PhotoSet
from splatpipe.pipeline.surface.point_colours import point_colours
from splatpipe.pipeline.surface.triangles import ColouredMesh, TriangleMesh, without_crumbs
from splatpipe.pipeline.surface.tsdf import open3d, tsdf_mesh

MOST_BLOCKS = 120_000  # of voxels: 0.5 GB, and about 5 million triangles before decimation; beyond it voxels are larger
CRUMB_VOXELS = 200.0  # faces of voxels: a piece of a smaller area hangs in the air, or is nobody's interest
GREY = 128  # of what no photo shows, where nothing near has a colour


@dataclass(frozen=True)
class MeshPlan:
    """How fine a mesh is.

    Attributes:
        voxel_m: Side of the voxels, metres: 2 GSD; larger where the site is.
        most_triangles: In the end.
    """

    voxel_m: float
    most_triangles: int

    def __post_init__(self) -> None:
        if not (self.voxel_m > 0.0 and np.isfinite(self.voxel_m)) or self.most_triangles < 1:
            raise ValueError(f"{self.most_triangles} triangles of voxels of {self.voxel_m} m")


def make_mesh(
    photos: PhotoSet, box: Box, area: PlanArea | None, plan: MeshPlan, threads: int, report: Reporter
) -> ColouredMesh:
    """The mesh of what photos see: the same bits for any number of threads.

    Args:
        photos: With their depths.
        box: What of the world counts.
        area: A boundary: triangles all of whose corners lie inside are kept. None for all.
        plan: How fine.
        threads: Photos at a time.
        report: Told of progress.

    Raises:
        MachineError: if open3d is not there.
        SplatpipeError: if there is no surface that enough photos see.
    """
    open3d()
    blocks = surface_blocks(photos, box, plan.voxel_m, MOST_BLOCKS, threads)
    if blocks.voxel_m > plan.voxel_m:
        report.note(f"The mesh has voxels of {blocks.voxel_m:.3g} m instead of {plan.voxel_m:.3g} m: the site is large.")
    mesh = tsdf_mesh(photos, box, blocks, threads, report)
    if area is not None:
        mesh = mesh.select(area.contains(mesh.vertices)[mesh.triangles].all(axis=1))
    mesh = without_crumbs(mesh, CRUMB_VOXELS * blocks.voxel_m**2)
    if not len(mesh.triangles):
        raise SplatpipeError(
            "There is no surface for a mesh that three photos see.", "Add overlap, or make it with a wider boundary."
        )
    report.progress(0, 1, "decimating the mesh", "meshes")
    mesh = decimated(mesh, plan.most_triangles)
    report.progress(1, 1, "decimating the mesh", "meshes")
    return ColouredMesh(mesh, vertex_colours(photos, mesh))


def decimated(mesh: TriangleMesh, most: int) -> TriangleMesh:
    """The mesh with so many triangles at most, fewer where it is flat (quadric errors; Garland and Heckbert 1997).

    Args:
        mesh: In order.
        most: Triangles.
    """
    size = len(mesh.triangles)
    if size <= most:
        return mesh
    o3d = open3d()
    low = mesh.vertices.min(axis=0)  # float32 is finer near zero
    vertices, triangles = (mesh.vertices - low).astype(np.float32), mesh.triangles.astype(np.int32)
    fine = o3d.t.geometry.TriangleMesh(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles))
    coarse = fine.simplify_quadric_decimation(1.0 - most / size)
    found = coarse.vertex.positions.numpy().astype(np.float64) + low
    whole = TriangleMesh(found, coarse.triangle.indices.numpy().astype(np.int64))
    return whole.select(whole.areas() > 0.0)


def vertex_colours(photos: PhotoSet, mesh: TriangleMesh) -> UInt8[np.ndarray, "n 3"]:
    """Colours of a mesh's vertices from the photos; of what none sees, those of the nearest vertex that one does."""
    pieces = Facing(np.ascontiguousarray(mesh.vertices.T), np.ascontiguousarray(mesh.normals().T))
    spacing_m = float(np.sqrt(mesh.areas().sum() / len(mesh.vertices)))
    colours, known = point_colours(photos, photos.with_depths(), pieces, spacing_m)
    return _spread(mesh, colours, known)


def _spread(
    mesh: TriangleMesh, colours: UInt8[np.ndarray, "n 3"], known: Bool[np.ndarray, " n"]
) -> UInt8[np.ndarray, "n 3"]:
    if not known.any():
        return np.full_like(colours, GREY)
    nearest = cKDTree(mesh.vertices[known]).query(mesh.vertices[~known])[1]
    colours = colours.copy()
    colours[~known] = colours[known][nearest]
    return colours
