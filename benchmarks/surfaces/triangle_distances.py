"""Measure distances of points to triangles, and sample triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

Points = Float64[np.ndarray, "n 3"]
Triangles = Float64[np.ndarray, "m 3 3"]

CANDIDATES = 8  # number of nearest samples whose triangles are measured
AT_ONCE = 50_000  # points


def areas(triangles: Triangles) -> Float64[np.ndarray, " m"]:
    """Return the triangles' areas."""
    sides = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return np.asarray(0.5 * np.linalg.norm(np.cross(*sides), axis=1))


def spread(triangles: Triangles, count: int, rng: np.random.Generator) -> tuple[Points, Int64[np.ndarray, " n"]]:
    """Sample triangles uniformly at random; return the samples and the row of each one's triangle."""
    area = areas(triangles)
    rows = rng.choice(len(triangles), count, p=area / area.sum())
    first, second = rng.random((2, count))
    beyond = first + second > 1.0  # the other half of the parallelogram
    first, second = np.where(beyond, 1.0 - first, first), np.where(beyond, 1.0 - second, second)
    a, b, c = (triangles[rows, k] for k in range(3))
    return np.asarray(a + first[:, None] * (b - a) + second[:, None] * (c - a)), rows


def point_triangle(points: Points, triangles: Float64[np.ndarray, "n 3 3"]) -> Float64[np.ndarray, " n"]:
    """Return each point's distance to its own triangle: to the plane if it projects inside, else to a side."""
    a, b, c = (triangles[:, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    square = (normal**2).sum(axis=1)
    safe = np.where(square > 0.0, square, 1.0)
    over = square > 0.0
    for start, end in ((a, b), (b, c), (c, a)):
        over &= (np.cross(end - start, points - start) * normal).sum(axis=1) >= 0.0
    plane = np.abs(((points - a) * normal).sum(axis=1)) / np.sqrt(safe)
    sides = [_to_segment(points, *side) for side in ((a, b), (b, c), (c, a))]
    return np.asarray(np.where(over, plane, np.minimum.reduce(sides)))


def _to_segment(points: Points, start: Points, end: Points) -> Float64[np.ndarray, " n"]:
    along = end - start
    length = np.maximum((along**2).sum(axis=1), 1e-30)
    share = np.clip(((points - start) * along).sum(axis=1) / length, 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - start - share[:, None] * along, axis=1))


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles prepared for distance queries.

    Attributes:
        triangles: Their corners.
        rows: Triangle of each place in the tree: samples, and the centre of each triangle.
        tree: Tree of these places.
    """

    triangles: Triangles
    rows: Int64[np.ndarray, " k"]
    tree: cKDTree

    def distances(self, points: Points) -> Float64[np.ndarray, " n"]:
        """Return the distances of points to the nearest of their candidate triangles.

        Exact near the surface, if a sample of the nearest triangle is among the candidates; never too short.
        """
        found = np.empty(len(points))
        for first in range(0, len(points), AT_ONCE):
            part = points[first : first + AT_ONCE]
            _, near = self.tree.query(part, k=min(CANDIDATES, len(self.rows)))
            near = self.rows[near.reshape(len(part), -1)]
            each = [point_triangle(part, self.triangles[near[:, k]]) for k in range(near.shape[1])]
            found[first : first + AT_ONCE] = np.minimum.reduce(each)
        return found


def surface_of(triangles: Triangles, spacing_m: float, rng: np.random.Generator) -> Surface:
    """Prepare triangles with samples spread over them, one per square of the spacing."""
    places, rows = spread(triangles, max(1, round(float(areas(triangles).sum()) / spacing_m**2)), rng)
    places = np.concatenate([places, triangles.mean(axis=1)])
    rows = np.concatenate([rows, np.arange(len(triangles))])
    return Surface(triangles, rows, cKDTree(places, balanced_tree=False))


def thinned(points: Points, cell_m: float) -> Points:
    """Keep one point per cube, so that places measured repeatedly count only once."""
    if len(points) == 0:
        return points
    cells = np.floor((points - points.min(axis=0)) / cell_m).astype(np.int64)
    _, first = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)), return_index=True)
    return points[np.sort(first)]
