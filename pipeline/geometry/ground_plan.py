"""Plan view in any frame: the plane normal to gravity with two axes of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

PlanPoints = Float64[np.ndarray, "n 2"]


@dataclass(frozen=True, eq=False)
class GroundPlan:
    """Plan coordinates and heights of points.

    Attributes:
        axes: Unit vectors of the plan's two axes in the points' frame; right-handed with ``up``.
        up: Unit vector opposite to gravity.
    """

    axes: Float64[np.ndarray, "2 3"]
    up: Float64[np.ndarray, " 3"]

    @staticmethod
    def across(up: Float64[np.ndarray, " 3"]) -> GroundPlan:
        """The plan perpendicular to a direction, with axes as near to the frame's own as possible.

        Args:
            up: The up direction, of any non-zero length.
        """
        z = np.asarray(up, np.float64) / np.linalg.norm(up)
        least = int(np.argmin(np.abs(z)))  # the frame's axis that lies flattest
        x = np.eye(3)[least] - z[least] * z
        x /= np.linalg.norm(x)
        return GroundPlan(np.stack([x, np.cross(z, x)]), z)

    def places(self, points: Float64[np.ndarray, "n 3"]) -> PlanPoints:
        """Plan coordinates, in the points' units; a point's bits depend neither on the others nor on threads."""
        x, y, z = points.T
        return np.stack([a * x + b * y + c * z for a, b, c in self.axes.tolist()], axis=1)

    def heights(self, points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Heights of points along ``up``, in their units."""
        x, y, z = points.T
        a, b, c = self.up.tolist()
        return np.asarray(a * x + b * y + c * z)

    def points(self, places: PlanPoints, heights: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
        """The inverse of ``places`` and ``heights``."""
        return np.asarray(places @ self.axes + heights[:, None] * self.up)
