"""Meshes with fewer triangles, and with none that is too long for its photo."""

from __future__ import annotations

import importlib
import sys
from typing import Any

import numpy as np

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.surface.shapes.triangles import TriangleMesh

ROUNDS = 12  # of splitting: each halves an edge
AGGRESSIVENESS = 7.0  # the library's default: with 3, the demo's mesh takes four times as long and is no closer


def simplifier() -> Any:
    """Import fast_simplification.

    Raises:
        MachineError: if it is not installed.
    """
    try:
        return importlib.import_module("fast_simplification")
    except ImportError as error:
        raise MachineError(
            "The mesh is reduced by fast-simplification, which is not installed.",
            hint=f"Install it: {sys.executable} -m pip install 'splatpipe[mesh]'",
        ) from error


def decimate(mesh: TriangleMesh, most: int) -> TriangleMesh:
    """Decimate a mesh to a maximum number of triangles (quadric error metrics; Garland and Heckbert 1997).

    Planes keep few triangles, and edges and open borders their place; one thread, and the same bits each time.

    Args:
        mesh: Mesh in canonical order.
        most: Maximum number of triangles.

    Raises:
        MachineError: if fast_simplification is not installed.
    """
    if len(mesh.triangles) <= most:
        return mesh
    low = mesh.vertices.min(axis=0)  # float32 is finer near zero
    vertices, triangles = (mesh.vertices - low).astype(np.float32), mesh.triangles.astype(np.int32)
    reduce = simplifier().simplify
    found, corners = reduce(vertices, triangles, target_count=most, agg=AGGRESSIVENESS, preserve_border=True)
    whole = TriangleMesh(found.astype(np.float64) + low, corners.astype(np.int64))
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
