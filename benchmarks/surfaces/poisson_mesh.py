"""Build a cloud's Poisson surface, to compare meshes: ``poisson_mesh cloud.laz OUT``; needs the extra ``mesh``.

Screened Poisson reconstruction (Kazhdan and Hoppe 2013) by open3d, from the cloud's own normals, relative to the
cloud's centre; parts far from any point are trimmed, as is usual. ``OUT/mesh.ply`` is in the truth's metres, so
``surface_truth OUT`` can measure it.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import laspy
import numpy as np
import trimesh
from jaxtyping import Float64, Int64
from surface_products import frames_of
from surface_truth import CRS

from splatpipe.pipeline.surface.shapes.tsdf import open3d

Points = Float64[np.ndarray, "n 3"]
SPARSEST = 0.02  # share of the vertices, those with the lowest density: the skin that Poisson spans over holes


def poisson_mesh(points: Points, normals: Points, cell_m: float) -> tuple[Points, Int64[np.ndarray, "m 3"]]:
    """Return vertices and triangles of the Poisson surface.

    Args:
        points: Points in any frame, metres.
        normals: Unit normals.
        cell_m: Side of the finest cells.
    """
    o3d = open3d()
    middle = points.mean(axis=0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points - middle))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    mesh, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, width=cell_m, n_threads=1)
    mesh.remove_vertices_by_mask(np.asarray(density) < np.quantile(density, SPARSEST))
    return np.asarray(mesh.vertices) + middle, np.asarray(mesh.triangles, np.int64)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("cloud", type=Path)
    options.add_argument("out", type=Path)
    options.add_argument("--run", type=Path, help="OUT that the cloud is of; without, its frame is the truth's")
    options.add_argument("--cell", type=float, default=0.056, help="side of the finest cells, metres")
    arguments = options.parse_args()
    began = time.process_time()
    true_from_crs = frames_of(arguments.run or arguments.out, CRS, "none").true_from_crs
    cloud = laspy.read(arguments.cloud)
    coordinates = np.asarray(cloud.xyz, np.float64)
    normals = np.stack([np.asarray(cloud[f"Normal{axis}"], np.float64) for axis in "XYZ"], axis=1)
    points = true_from_crs(coordinates)
    turned = true_from_crs(coordinates + normals) - points
    turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
    vertices, triangles = poisson_mesh(points, turned, arguments.cell)
    arguments.out.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(vertices, triangles, process=False).export(arguments.out / "mesh.ply")
    print(f"{len(triangles):,} triangles of {len(points):,} points in {time.process_time() - began:.0f} CPU s")


if __name__ == "__main__":
    main()
