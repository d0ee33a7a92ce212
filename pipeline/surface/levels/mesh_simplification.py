"""Simplifies a textured mesh by collapsing edges: vertices go, none moves, and locked ones stay.

A vertex is merged into a neighbour where the planes that met at the two are missed least (quadric error metrics;
Garland and Heckbert 1997). As it takes the neighbour's place in all of its charts, textures stay where they were: so a
vertex between two charts goes only along their border, one at an edge of the mesh only along that edge. Many edges
collapse at once, those that are cheaper than all around them, in passes whose order depends on nothing but the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import csr_array

from splatpipe.pipeline.surface.levels.charted_mesh import ChartedMesh

EDGE_WEIGHT = 4.0  # of the planes through open edges and chart borders, over those of triangles of their size
LENGTH_WEIGHT = 1e-3  # of an edge's squared length: on level ground, short edges go first
MIN_TURN = 0.3  # least cosine between a triangle's normals before and after
CHEAPEST = 0.6  # share of the vertices that are candidates in a pass
MAX_PASSES = 60
BATCH = 1 << 16  # edges at a time: their planes take 0.4 KB each
MIN_GAIN = 0.005  # a pass that removes less of the triangles is the last


@dataclass(frozen=True, eq=False)
class _Edges:
    """The directed edges of a mesh along which a vertex may go.

    Attributes:
        gone: The vertex that would go.
        kept: The one that it would be merged into.
    """

    gone: Int64[np.ndarray, " e"]
    kept: Int64[np.ndarray, " e"]

    def select(self, rows: np.ndarray) -> _Edges:
        """The edges of these rows."""
        return _Edges(self.gone[rows], self.kept[rows])


def simplified(mesh: ChartedMesh, locked: Bool[np.ndarray, " n"], most: int) -> tuple[ChartedMesh, float]:
    """Simplify a mesh as far as it goes without moving what is locked.

    Args:
        mesh: Part of a mesh.
        locked: Whether each vertex must stay.
        most: Number of triangles at which it ends.

    Returns:
        The simplified part, with the same vertices, and the largest distance from a plane that was missed, metres.
    """
    used, local = np.unique(mesh.triangles, return_inverse=True)
    small = ChartedMesh(mesh.vertices[used], local.reshape(-1, 3), mesh.corners, mesh.charts)
    fixed, quadrics, error = locked[used], _Quadrics(small), 0.0
    refused = np.zeros(0, np.int64)
    for _ in range(MAX_PASSES):
        if len(small) <= most:
            break
        before = len(small)
        edges, costs = _candidates(small, fixed, quadrics, refused)
        chosen = _cheapest_around(small, edges, costs)
        keeps = _keeps_shape(small, chosen)
        refused = np.concatenate([refused, _keys(chosen.select(~keeps), len(used))])
        good = chosen.select(np.flatnonzero(keeps)[: (before - most) // 2 + 1])  # a collapse takes two triangles
        error = max(error, quadrics.merge(good))
        small = _collapsed(small, good)
        little = MIN_GAIN * before
        if not len(chosen.gone) or max(before - len(small), len(chosen.gone)) < min(little, before - most):
            break
    return ChartedMesh(mesh.vertices, used[small.triangles], small.corners, small.charts), error


class _Quadrics:
    """Sums of the squared distances from planes, for each vertex.

    Args:
        mesh: The mesh before any collapse.
    """

    def __init__(self, mesh: ChartedMesh) -> None:
        self._low = mesh.vertices.min(axis=0) if len(mesh.vertices) else np.zeros(3)
        self._places = mesh.vertices - self._low
        a, b, c = (self._places[mesh.triangles[:, corner]] for corner in range(3))
        cross = np.cross(b - a, c - a)
        size = np.linalg.norm(cross, axis=1)
        normal = cross / np.maximum(size, 1e-30)[:, None]
        self._sums = np.zeros((len(self._places), 4, 4))
        self._weights = np.zeros(len(self._places))
        self._add(mesh.triangles, normal, -(normal * a).sum(axis=1), size / 2.0)
        ends, sides = _border_edges(mesh)
        p, q = self._places[ends[:, 0]], self._places[ends[:, 1]]
        across = np.cross(q - p, normal[sides])
        length = np.linalg.norm(across, axis=1)
        across = across / np.maximum(length, 1e-30)[:, None]
        self._add(ends, across, -(across * p).sum(axis=1), EDGE_WEIGHT * length**2, counts=False)

    def _add(
        self, vertices: np.ndarray, normal: np.ndarray, offset: np.ndarray, weight: np.ndarray, counts: bool = True
    ) -> None:
        plane = np.concatenate([normal, offset[:, None]], axis=1)
        for corner in range(vertices.shape[1]):
            for row in range(4):
                for column in range(4):
                    values = weight * plane[:, row] * plane[:, column]
                    self._sums[:, row, column] += np.bincount(vertices[:, corner], values, len(self._places))
            if counts:
                self._weights += np.bincount(vertices[:, corner], weight, len(self._places))

    def costs(self, edges: _Edges) -> Float64[np.ndarray, " e"]:
        """What each edge's collapse misses: square metres of triangles times squared metres."""
        length = ((self._places[edges.gone] - self._places[edges.kept]) ** 2).sum(axis=1)
        return np.asarray(self._missed(edges) + LENGTH_WEIGHT * length * self._weights[edges.gone])

    def merge(self, edges: _Edges) -> float:
        """Carry collapses out; returns the largest distance missed, metres, as the mean over a vertex's planes."""
        if not len(edges.gone):
            return 0.0
        weight = self._weights[edges.gone] + self._weights[edges.kept]
        missed = np.sqrt(np.maximum(self._missed(edges), 0.0) / np.maximum(weight, 1e-30))
        np.add.at(self._sums, edges.kept, self._sums[edges.gone])
        np.add.at(self._weights, edges.kept, self._weights[edges.gone])
        return float(missed.max())

    def _missed(self, edges: _Edges) -> Float64[np.ndarray, " e"]:
        missed = np.empty(len(edges.gone))
        for start in range(0, len(missed), BATCH):
            part = np.s_[start : start + BATCH]
            gone, kept = edges.gone[part], edges.kept[part]
            place = np.concatenate([self._places[kept], np.ones((len(kept), 1))], axis=1)
            missed[part] = np.einsum("ei,eij,ej->e", place, self._sums[gone] + self._sums[kept], place)
        return missed


def _keys(edges: _Edges, size: int) -> Int64[np.ndarray, " e"]:
    return np.asarray(edges.gone * size + edges.kept)


def _sides(mesh: ChartedMesh) -> tuple[Int64[np.ndarray, "s 2"], Int64[np.ndarray, " s"]]:
    """The three sides of all triangles, lower vertex first, and their triangles."""
    ends = np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]], mesh.triangles[:, [2, 0]]])
    return np.sort(ends, axis=1), np.tile(np.arange(len(mesh)), 3)


def _border_edges(mesh: ChartedMesh) -> tuple[Int64[np.ndarray, "s 2"], Int64[np.ndarray, " s"]]:
    """Sides at which the mesh or a chart ends, and their triangles."""
    ends, rows = _sides(mesh)
    _, which, counts = _unique_edges(ends, len(mesh.vertices))
    inner = counts[which] == 2
    charts = mesh.charts[rows]
    other = np.bincount(which, charts, len(counts))[which] - charts
    alone = ~inner | (other != charts)
    return ends[alone], rows[alone]


def _unique_edges(ends: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    keys, which, counts = np.unique(ends[:, 0] * size + ends[:, 1], return_inverse=True, return_counts=True)
    return np.stack([keys // size, keys % size], axis=1), which.ravel(), counts


def _candidates(
    mesh: ChartedMesh, fixed: Bool[np.ndarray, " n"], quadrics: _Quadrics, refused: Int64[np.ndarray, " r"]
) -> tuple[_Edges, Float64[np.ndarray, " e"]]:
    """The cheapest edge of each vertex that may go, and its cost."""
    size = len(mesh.vertices)
    ends, rows = _sides(mesh)
    edges, which, counts = _unique_edges(ends, size)
    charts = mesh.charts[rows]
    low, high = np.full(len(edges), np.iinfo(np.int64).max), np.full(len(edges), -1)
    np.minimum.at(low, which, charts)
    np.maximum.at(high, which, charts)
    open_edge, between = counts == 1, low != high
    at_edge, many = np.zeros(size, np.bool_), np.zeros(size, np.bool_)
    at_edge[edges[open_edge]] = True
    many[edges[counts > 2]] = True  # sheets that meet at an edge stay as they are
    corners, _ = mesh.wedges()
    charts_of = np.bincount(mesh.triangles.ravel()[corners], minlength=size)
    both = _Edges(np.concatenate([edges[:, 0], edges[:, 1]]), np.concatenate([edges[:, 1], edges[:, 0]]))
    open_edge, between = np.tile(open_edge, 2), np.tile(between, 2)
    allowed = ~fixed[both.gone] & ~many[both.gone] & (open_edge | ~at_edge[both.gone])
    allowed &= charts_of[both.gone] == 1 + between
    allowed &= ~np.isin(_keys(both, size), refused)
    both = both.select(allowed)
    costs = quadrics.costs(both)
    order = np.lexsort((both.kept, costs, both.gone))
    first = np.ones(len(order), np.bool_)
    first[1:] = both.gone[order][1:] != both.gone[order][:-1]
    best = order[first]
    return both.select(best), costs[best]


def _cheapest_around(mesh: ChartedMesh, edges: _Edges, costs: Float64[np.ndarray, " e"]) -> _Edges:
    """Edges whose vertices to go are no neighbours of each other, the cheapest first."""
    order = np.lexsort((edges.gone, costs))[: max(1, int(CHEAPEST * len(costs)))]
    rank = np.full(len(mesh.vertices), np.iinfo(np.int64).max)
    rank[edges.gone[order]] = np.arange(len(order))
    least = rank.copy()
    for a, b in ((0, 1), (1, 2), (2, 0)):
        p, q = mesh.triangles[:, a], mesh.triangles[:, b]
        np.minimum.at(least, p, rank[q])
        np.minimum.at(least, q, rank[p])
    return edges.select(order[least[edges.gone[order]] == np.arange(len(order))])


def _keeps_shape(mesh: ChartedMesh, edges: _Edges) -> Bool[np.ndarray, " e"]:
    """Whether each collapse keeps the surface in one sheet, and turns no triangle over, in space or in its page."""
    size = len(mesh.vertices)
    ends, _ = _sides(mesh)
    pairs, _, counts = _unique_edges(ends, size)
    ones = np.ones(2 * len(pairs), np.int32)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    near = csr_array((ones, (both[:, 0], both[:, 1])), shape=(size, size))
    common = near[edges.gone].multiply(near[edges.kept]).sum(axis=1)
    low, high = np.minimum(edges.gone, edges.kept), np.maximum(edges.gone, edges.kept)
    shared = counts[np.searchsorted(pairs[:, 0] * size + pairs[:, 1], low * size + high)]
    good = np.asarray(common).ravel() == shared
    number = np.full(size, -1)
    number[edges.gone] = np.arange(len(edges.gone))
    rows, after, places = _moved(mesh, edges)
    was = mesh.select(rows)
    bad = _turned(mesh.vertices[was.triangles], mesh.vertices[after], MIN_TURN)
    bad |= _area(places) * _area(was.corners) <= 0.0
    good[number[was.triangles].max(axis=1)[bad]] = False
    return np.asarray(good)


def _turned(before: Float64[np.ndarray, "m 3 3"], after: Float64[np.ndarray, "m 3 3"], least: float) -> np.ndarray:
    old, new = (np.cross(each[:, 1] - each[:, 0], each[:, 2] - each[:, 0]) for each in (before, after))
    cosine = (old * new).sum(axis=1)
    return np.asarray(cosine <= least * np.linalg.norm(old, axis=1) * np.linalg.norm(new, axis=1))


def _area(places: Float64[np.ndarray, "m 3 2"]) -> Float64[np.ndarray, " m"]:
    """Twice the signed areas of triangles in their pages."""
    a, b = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _moved(
    mesh: ChartedMesh, edges: _Edges
) -> tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, "k 3"], Float64[np.ndarray, "k 3 2"]]:
    """Triangles that a collapse changes and leaves: their rows, and their vertices and places afterwards."""
    goal = np.arange(len(mesh.vertices))
    goal[edges.gone] = edges.kept
    after = goal[mesh.triangles]
    changed = after != mesh.triangles
    alive = (after[:, 0] != after[:, 1]) & (after[:, 1] != after[:, 2]) & (after[:, 2] != after[:, 0])
    rows = np.flatnonzero(changed.any(axis=1) & alive)
    after, changed = after[rows], changed[rows]
    width = int(mesh.charts.max(initial=0)) + 1
    keys, first = np.unique(mesh.triangles * width + mesh.charts[:, None], return_index=True)
    wanted = after * width + mesh.charts[rows, None]
    found = mesh.corners.reshape(-1, 2)[first[np.searchsorted(keys, wanted[changed])]]
    places = mesh.corners[rows].copy()
    places[changed] = found
    return rows, after, places


def _collapsed(mesh: ChartedMesh, edges: _Edges) -> ChartedMesh:
    rows, after, places = _moved(mesh, edges)
    gone = np.zeros(len(mesh.vertices), np.bool_)
    gone[edges.gone] = True
    triangles, corners = mesh.triangles.copy(), mesh.corners.copy()
    triangles[rows], corners[rows] = after, places
    kept = ~gone[triangles].any(axis=1)
    return ChartedMesh(mesh.vertices, triangles[kept], corners[kept], mesh.charts[kept])
