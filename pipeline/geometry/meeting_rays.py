"""Where many rays meet in many points, by linear least squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64


@dataclass(frozen=True)
class RayEquations:
    """For each ray, and summed for each point: ``whole @ point = side`` where the point is nearest to its rays.

    Attributes:
        across: Projection across each ray, times its weight.
        pulled: ``across`` times the ray's centre.
        whole: Sums of ``across``.
        side: Sums of ``pulled``.
    """

    across: Float64[np.ndarray, "n 3 3"]
    pulled: Float64[np.ndarray, "n 3"]
    whole: Float64[np.ndarray, "m 3 3"]
    side: Float64[np.ndarray, "m 3"]

    def solved(self, least_ratio: float) -> tuple[Float64[np.ndarray, "m 3"], Bool[np.ndarray, " m"]]:
        """Return the points, and the mask of those that their rays determine; the others are zeros.

        Args:
            least_ratio: Least ratio of a point's eigenvalues, of two rays about a quarter of the square of their angle.
        """
        values = np.linalg.eigvalsh(self.whole)
        meet = np.asarray(values[:, 0] > least_ratio * np.maximum(values[:, 2], 1e-300))
        points = np.zeros_like(self.side)
        points[meet] = np.linalg.solve(self.whole[meet], self.side[meet][:, :, None])[:, :, 0]
        return points, meet


def ray_equations(
    point: Int64[np.ndarray, " n"],
    count: int,
    centres: Float64[np.ndarray, "n 3"],
    directions: Float64[np.ndarray, "n 3"],
    weights: Float64[np.ndarray, " n"],
) -> RayEquations:
    """Set up the equations of points from their rays.

    Args:
        point: Row of each ray's point.
        count: Number of points.
        centres: Where the rays begin.
        directions: Unit vectors.
        weights: Weight of each ray, 1 / distance² for equal errors in angle.
    """
    across = weights[:, None, None] * (np.eye(3) - directions[:, :, None] * directions[:, None, :])
    pulled = np.einsum("nij,nj->ni", across, centres)
    return RayEquations(across, pulled, _summed(point, across, count), _summed(point, pulled, count))


def _summed(
    rows: Int64[np.ndarray, " n"], values: Float64[np.ndarray, "n ..."], count: int
) -> Float64[np.ndarray, "m ..."]:
    """Return the sums of the values of each row; ``np.add.at`` of blocks takes several times as long."""
    sums = np.zeros((count, *values.shape[1:]))
    for place in np.ndindex(values.shape[1:]):
        sums[:, *place] = np.bincount(rows, values[:, *place], count)
    return sums
