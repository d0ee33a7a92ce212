"""Blending at seams: across the triangles at a seam, photos change over into each other.

At a vertex, each photo weighs as much as the share of the triangles around it that show it; inside of a triangle the
weights are interpolated. So both sides of a seam have the same colours, wherever both photos see both triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int16, Int64

from splatpipe.pipeline.surface.shapes.triangles import TriangleMesh
from splatpipe.pipeline.surface.texture.face_choice import Labels
from splatpipe.pipeline.surface.texture.face_views import NONE


@dataclass(frozen=True, eq=False)
class Blends:
    """Photos that are mixed into triangles, sorted by triangle and photo; a triangle's own photo is among them.

    Attributes:
        face: The triangle.
        photo: The photo.
        weight: Its weights at the triangle's corners; they sum to one over the triangle's photos.
    """

    face: Int64[np.ndarray, " b"]
    photo: Int16[np.ndarray, " b"]
    weight: Float32[np.ndarray, "b 3"]

    def select(self, rows: np.ndarray) -> Blends:
        """Some of them."""
        return Blends(self.face[rows], self.photo[rows], self.weight[rows])


def blend_seams(mesh: TriangleMesh, label: Labels, photo: Int16[np.ndarray, "m k"]) -> Blends:
    """Find what is mixed into the triangles at seams.

    Args:
        mesh: The mesh.
        label: Photo of each triangle.
        photo: The photos that see each triangle.
    """
    seen = np.flatnonzero(label != NONE)
    vertex, shown = mesh.triangles[seen].ravel(), np.repeat(label[seen].astype(np.int64), 3)
    pairs, count = np.unique(vertex * (1 << 16) + shown, return_counts=True)
    at = pairs >> 16
    starts = np.searchsorted(at, np.arange(len(mesh.vertices) + 1))
    photos_at = np.diff(starts)
    share = (count / np.bincount(at, count, len(mesh.vertices))[at]).astype(np.float32)
    mixed = seen[(photos_at[mesh.triangles[seen]] > 1).any(axis=1)]
    faces, photos, corners, shares = [], [], [], []
    for corner in range(3):
        where = mesh.triangles[mixed, corner]
        repeats = photos_at[where]
        rows = np.repeat(starts[where], repeats) + _counts_up(repeats)
        faces.append(np.repeat(mixed, repeats))
        photos.append(pairs[rows] & 0xFFFF)
        corners.append(np.full(len(rows), corner))
        shares.append(share[rows])
    face, number, corner_of, weight_of = (np.concatenate(each) for each in (faces, photos, corners, shares))
    listed = (photo[face] == number[:, None]).any(axis=1)
    face, number, corner_of, weight_of = (each[listed] for each in (face, number, corner_of, weight_of))
    keys, row = np.unique(face * (1 << 16) + number, return_inverse=True)
    weight = np.zeros((len(keys), 3), np.float32)
    weight[row, corner_of] = weight_of
    found = keys >> 16
    total = np.stack([np.bincount(found, weight[:, k], len(label)) for k in range(3)], axis=1)
    weight /= np.maximum(total[found], 1e-6).astype(np.float32)
    return Blends(found, (keys & 0xFFFF).astype(np.int16), weight)


def _counts_up(repeats: np.ndarray) -> np.ndarray:
    """0, 1, … for each of the repeats."""
    ends = np.cumsum(repeats)
    return np.arange(int(ends[-1]) if len(ends) else 0) - np.repeat(ends - repeats, repeats)
