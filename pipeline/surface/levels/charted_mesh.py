"""Triangles of a textured mesh, cut out and cut up: vertices are shared by all parts, texture places are their own."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64


@dataclass(frozen=True, eq=False)
class ChartedMesh:
    """Triangles with their places in texture pages.

    Attributes:
        vertices: East, north, up, metres; of all parts of a mesh, so that an index means the same in each.
        triangles: Three vertex indices each, counter-clockwise seen from outside.
        corners: Column and row of each triangle's corners in its chart's page, pixels.
        charts: Chart of each triangle. All triangles of a chart that meet at a vertex have it at the same place.
    """

    vertices: Float64[np.ndarray, "n 3"]
    triangles: Int64[np.ndarray, "m 3"]
    corners: Float64[np.ndarray, "m 3 2"]
    charts: Int64[np.ndarray, " m"]

    def __len__(self) -> int:
        return len(self.triangles)

    def select(self, rows: np.ndarray) -> ChartedMesh:
        """The triangles of these rows."""
        return ChartedMesh(self.vertices, self.triangles[rows], self.corners[rows], self.charts[rows])

    def joined(self, *others: ChartedMesh) -> ChartedMesh:
        """These triangles and those of other parts of the same mesh."""
        every = (self, *others)
        arrays = (
            np.concatenate([getattr(each, name) for each in every]) for name in ("triangles", "corners", "charts")
        )
        return ChartedMesh(self.vertices, *arrays)

    def wedges(self) -> tuple[Int64[np.ndarray, " w"], Int64[np.ndarray, "m 3"]]:
        """Rows of the corners (counted through all triangles) that are different in vertex or chart.

        Returns:
            One row of each, and which of them each triangle's corners are.
        """
        keys = self.triangles * (int(self.charts.max(initial=0)) + 1) + self.charts[:, None]
        _, first, corner = np.unique(keys, return_index=True, return_inverse=True)
        return first, corner.reshape(-1, 3)


def cut_along(mesh: ChartedMesh, axis: int, lines: Float64[np.ndarray, " k"]) -> ChartedMesh:
    """Cut triangles along lines in plan, so that none crosses one; both sides of a cut get the same vertices.

    Args:
        mesh: A mesh; its vertices are kept and new ones added behind.
        axis: 0 to cut along lines to the north, at eastings; 1 for the others.
        lines: Their eastings or northings, metres; new vertices lie on them exactly.
    """
    for line in lines.tolist():
        mesh = _cut(mesh, axis, line)
    return mesh


def _cut(mesh: ChartedMesh, axis: int, line: float) -> ChartedMesh:
    side = np.sign(mesh.vertices[mesh.triangles, axis] - line).astype(np.int64)
    crossed = (side.min(axis=1) < 0) & (side.max(axis=1) > 0)
    if not crossed.any():
        return mesh
    part, side = mesh.select(crossed), side[crossed]
    alone = np.where(
        (side == 0).any(axis=1), np.argmin(np.abs(side), axis=1), np.argmax(side == -_majority(side), axis=1)
    )
    turn = (alone[:, None] + np.arange(3)) % 3
    part = ChartedMesh(
        mesh.vertices,
        np.take_along_axis(part.triangles, turn, 1),
        np.take_along_axis(part.corners, turn[..., None], 1),
        part.charts,
    )
    through = np.take_along_axis(side, turn, 1)[:, 0] == 0  # the line goes through the first corner
    pieces = _pieces(part, through, axis, line)
    return replace(mesh.select(~crossed), vertices=pieces[0].vertices).joined(*pieces)


def _majority(side: Int64[np.ndarray, "m 3"]) -> Int64[np.ndarray, "m 1"]:
    """The side on which two corners lie."""
    return np.asarray(np.sign(side.sum(axis=1, keepdims=True)))


def _pieces(part: ChartedMesh, through: Bool[np.ndarray, " m"], axis: int, line: float) -> list[ChartedMesh]:
    """Two pieces of triangles whose first corner the line goes through, three of those with it alone on its side."""
    two, three = part.select(through), part.select(~through)
    ends = np.concatenate([two.triangles[:, [1, 2]], three.triangles[:, [0, 1]], three.triangles[:, [0, 2]]])
    low, high = ends.min(axis=1), ends.max(axis=1)
    pairs, which = np.unique(np.stack([low, high], axis=1), axis=0, return_inverse=True)
    a, b = part.vertices[pairs[:, 0]], part.vertices[pairs[:, 1]]
    share = (line - a[:, axis]) / (b[:, axis] - a[:, axis])
    made = a + share[:, None] * (b - a)
    made[:, axis] = line
    vertices = np.concatenate([part.vertices, made])
    at = len(part.vertices) + which.ravel()
    share = share[which.ravel()]
    split = len(two)
    first, second, third = at[:split], at[split : split + len(three)], at[split + len(three) :]

    def place(mesh: ChartedMesh, ends: tuple[int, int], rows: slice) -> Float64[np.ndarray, "k 2"]:
        """Where cut edges are cut in the pages, from the end with the lower index, as in the triangle beyond."""
        turned = mesh.triangles[:, ends[0]] > mesh.triangles[:, ends[1]]
        p, q = mesh.corners[:, ends[0]], mesh.corners[:, ends[1]]
        p, q = np.where(turned[:, None], q, p), np.where(turned[:, None], p, q)
        return np.asarray(p + share[rows, None] * (q - p))

    def piece(mesh: ChartedMesh, indices: list[np.ndarray], places: list[np.ndarray]) -> ChartedMesh:
        return ChartedMesh(vertices, np.stack(indices, axis=1), np.stack(places, axis=1), mesh.charts)

    (a0, a1, a2), (p0, p1, p2) = two.triangles.T, two.corners.transpose(1, 0, 2)
    pm = place(two, (1, 2), slice(0, split))
    (b0, b1, b2), (q0, q1, q2) = three.triangles.T, three.corners.transpose(1, 0, 2)
    qm = place(three, (0, 1), slice(split, split + len(three)))
    qn = place(three, (0, 2), slice(split + len(three), None))
    return [
        piece(two, [a0, a1, first], [p0, p1, pm]),
        piece(two, [a0, first, a2], [p0, pm, p2]),
        piece(three, [b0, second, third], [q0, qm, qn]),
        piece(three, [second, b1, b2], [qm, q1, q2]),
        piece(three, [second, b2, third], [qm, q2, qn]),
    ]
