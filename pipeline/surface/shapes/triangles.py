"""Triangle meshes: canonical order, connected pieces, areas and normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A triangle mesh.

    Attributes:
        vertices: East, north, up, metres.
        triangles: Three vertex indices each, counter-clockwise seen from outside.
    """

    vertices: Float64[np.ndarray, "n 3"]
    triangles: Int64[np.ndarray, "m 3"]

    def select(self, kept: Bool[np.ndarray, " m"]) -> TriangleMesh:
        """The chosen triangles, with only the vertices that they use."""
        rows, triangles = np.unique(self.triangles[kept], return_inverse=True)
        return TriangleMesh(self.vertices[rows], triangles.reshape(-1, 3))

    def crosses(self) -> Float64[np.ndarray, "m 3"]:
        """Normals of the triangles, with length twice their areas."""
        a, b, c = (self.vertices[self.triangles[:, corner]] for corner in range(3))
        return np.asarray(np.cross(b - a, c - a))

    def areas(self) -> Float64[np.ndarray, " m"]:
        """Areas of the triangles, square metres."""
        return np.asarray(np.linalg.norm(self.crosses(), axis=1) / 2.0)

    def normals(self) -> Float64[np.ndarray, "n 3"]:
        """Unit normals of the vertices: area-weighted over adjacent triangles; zero where there are none."""
        crosses = self.crosses()
        total = np.zeros_like(self.vertices)
        for axis in range(3):
            for corner in range(3):
                total[:, axis] += np.bincount(self.triangles[:, corner], crosses[:, axis], len(total))
        return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30))


@dataclass(frozen=True, eq=False)
class ColouredMesh:
    """A triangle mesh with vertex colours.

    Attributes:
        mesh: The mesh.
        colours: Colours of the vertices: red, green, blue (sRGB).
    """

    mesh: TriangleMesh
    colours: UInt8[np.ndarray, "n 3"]

    def select(self, kept: Bool[np.ndarray, " m"]) -> ColouredMesh:
        """The chosen triangles, with only the vertices that they use."""
        rows = np.unique(self.mesh.triangles[kept])
        return ColouredMesh(self.mesh.select(kept), self.colours[rows])


def in_order(mesh: TriangleMesh) -> TriangleMesh:
    """Sort vertices by position and triangles by vertex, and drop degenerate triangles."""
    order = np.lexsort(mesh.vertices.T[::-1])
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    triangles = rank[mesh.triangles]
    triangles = triangles[
        (triangles[:, 0] != triangles[:, 1])
        & (triangles[:, 1] != triangles[:, 2])
        & (triangles[:, 2] != triangles[:, 0])
    ]
    first = np.argmin(triangles, axis=1)
    turned = np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, axis=1)
    return TriangleMesh(mesh.vertices[order], turned[np.lexsort(turned.T[::-1])])


def remove_small_components(mesh: TriangleMesh, least_m2: float) -> TriangleMesh:
    """The mesh without connected pieces below an area.

    Args:
        mesh: The mesh.
        least_m2: Smallest area of a piece to keep, square metres.
    """
    size = len(mesh.vertices)
    sides = np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]]])
    graph = coo_array((np.ones(len(sides), np.int8), (sides[:, 0], sides[:, 1])), shape=(size, size))
    count, label = connected_components(graph, directed=False)
    piece = label[mesh.triangles[:, 0]]
    area = np.bincount(piece, mesh.areas(), count)
    return mesh.select(area[piece] >= least_m2)
