"""Triangles as a graph: which share an edge, and groups of which no two do."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int32, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

SCRAMBLE = np.uint64(
    0x9E3779B97F4A7C15
)  # 2^64 over the golden ratio (Knuth, TAOCP 3, 6.4): spreads consecutive numbers


def adjacent_faces(triangles: Int64[np.ndarray, "m 3"]) -> Int32[np.ndarray, "m 3"]:
    """The triangle beyond each edge (from a corner to the next), -1 at a border.

    Where more than two triangles meet at an edge, only the first two are neighbours.
    """
    count = len(triangles)
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    first = same.copy()
    first[1:] &= ~same[:-1]  # the first two of an edge
    one, other = order[:-1][first], order[1:][first]
    beyond = np.full(3 * count, -1, np.int32)
    beyond[one], beyond[other] = other // 3, one // 3
    return beyond.reshape(count, 3)


def independent_groups(beyond: Int32[np.ndarray, "m 3"]) -> list[Int64[np.ndarray, " k"]]:
    """Groups of triangles without common edges; they are the same on every machine.

    Jones, Plassmann: A parallel graph coloring heuristic, SIAM J. Sci. Comput. 14(3), 1993: a triangle takes the first
    free group once all of its neighbours with a higher priority have one.
    """
    count = len(beyond)
    priority = (np.arange(count, dtype=np.uint64) + np.uint64(1)) * SCRAMBLE
    group = np.full(count, -1, np.int8)
    left = np.arange(count)
    while left.size:
        near = beyond[left]
        waits = (near >= 0) & (group[near] < 0) & (priority[near] > priority[left][:, None])
        ready = left[~waits.any(axis=1)]
        taken = np.where(beyond[ready] >= 0, group[beyond[ready]], -1)
        free = np.stack([(taken != number).all(axis=1) for number in range(4)], axis=1)  # three neighbours: four groups
        group[ready] = free.argmax(axis=1)
        left = left[waits.any(axis=1)]
    return [np.flatnonzero(group == number) for number in range(4)]


def connected_parts(
    beyond: Int32[np.ndarray, "m 3"], joined: Bool[np.ndarray, "m 3"]
) -> tuple[int, Int32[np.ndarray, " m"]]:
    """Number the parts of triangles that are joined across edges, in the order of their first triangles.

    Args:
        beyond: From ``adjacent_faces``.
        joined: Edges across which triangles belong together; it is enough if one of both says so.
    """
    count = len(beyond)
    face, edge = np.nonzero(joined & (beyond >= 0))
    graph = coo_array((np.ones(len(face), np.int8), (face, beyond[face, edge])), shape=(count, count))
    number, part = connected_components(graph, directed=False)
    _, first, part = np.unique(part, return_index=True, return_inverse=True)
    rank = np.empty(number, np.int32)
    rank[np.argsort(first, kind="stable")] = np.arange(number, dtype=np.int32)
    return number, rank[part]
