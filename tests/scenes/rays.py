"""Rays into a mesh, for true depths and points."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def first_hits(origin: Array, directions: Array, corners: Array) -> Array:
    """Return the distance to the first triangle (m, 3, 3) along each ray (n, 3); Möller and Trumbore 1997."""
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    from_a = origin - a
    q = np.cross(from_a, ab)
    distances = []
    for direction in directions:
        p = np.cross(direction, ac)
        determinant = np.einsum("ij,ij->i", ab, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("ij,ij->i", from_a, p) / determinant
            v = q @ direction / determinant
            t = np.einsum("ij,ij->i", q, ac) / determinant
        inside = (u >= -1e-6) & (v >= -1e-6) & (u + v <= 1 + 1e-6) & (t > 1e-3)
        distances.append(t[inside].min(initial=np.inf))
    return np.array(distances)
