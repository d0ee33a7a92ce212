"""Meshes with fewer triangles, and with none that is too long for its photo."""

from __future__ import annotations

import numpy as np

from splatpipe.pipeline.surface.shapes.triangles import TriangleMesh
from splatpipe.pipeline.surface.shapes.tsdf import open3d

ROUNDS = 12  # of splitting: each halves an edge


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


def split_long_edges(mesh: TriangleMesh, longest_m: float) -> TriangleMesh:
    """Split triangles until no edge is longer than a limit; neighbours stay joined at all corners.

    Args:
        mesh: The mesh.
        longest_m: Limit, metres.
    """
    for _ in range(ROUNDS):
        start, end = mesh.triangles, np.roll(mesh.triangles, -1, axis=1)
        low, high = np.minimum(start, end), np.maximum(start, end)
        length = np.linalg.norm(mesh.vertices[high] - mesh.vertices[low], axis=2)  # the same bits from both sides
        long = length > longest_m
        if not long.any():
            break
        edges, middle = np.unique(np.stack([low[long], high[long]], axis=1), axis=0, return_inverse=True)
        middles = np.full(start.shape, -1, np.int64)
        middles[long] = len(mesh.vertices) + middle.ravel()
        vertices = np.concatenate([mesh.vertices, mesh.vertices[edges].mean(axis=1)])
        mesh = TriangleMesh(vertices, _split(mesh.triangles, middles))
    return mesh


def _split(triangles: np.ndarray, middles: np.ndarray) -> np.ndarray:
    """Triangles split at the middles of their edges (from a corner to the next), where there are any."""
    count = (middles >= 0).sum(axis=1)
    parts = [triangles[count == 0]]
    for number in (1, 2, 3):
        rows = np.flatnonzero(count == number)
        # turned so that the split edges come first
        there = middles[rows] >= 0
        first = np.where(number == 1, there.argmax(axis=1), (np.argmin(there, axis=1) + 1) % 3 if number == 2 else 0)
        turn = (first[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(triangles[rows], turn, axis=1).T
        ab, bc, ca = np.take_along_axis(middles[rows], turn, axis=1).T
        pieces = {
            1: [(a, ab, c), (ab, b, c)],
            2: [(ab, b, bc), (a, ab, bc), (a, bc, c)],
            3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
        }[number]
        parts += [np.stack(piece, axis=1) for piece in pieces]
    return np.concatenate(parts)
