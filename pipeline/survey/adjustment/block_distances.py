"""Measured distances between points of a block: scale bars."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float64, Int64


@dataclass(frozen=True)
class Distances:
    """Measured distances between points of a block.

    Attributes:
        ends: Indices of the two points of each.
        lengths: Metres.
        sigmas: Their standard deviations.
    """

    ends: Int64[np.ndarray, "b 2"]
    lengths: Float64[np.ndarray, " b"]
    sigmas: Float64[np.ndarray, " b"]

    def __len__(self) -> int:
        return len(self.lengths)

    def residuals(self, points: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, " b"]:
        """Distance less measured one, over the standard deviations."""
        apart = points[self.ends[:, 0]] - points[self.ends[:, 1]]
        return np.asarray((np.linalg.norm(apart, axis=1) - self.lengths) / self.sigmas)

    def design(self, points: Float64[np.ndarray, "p 3"]) -> scipy.sparse.csr_array:
        """(b, 3p) derivatives of the residuals by the points."""
        apart = points[self.ends[:, 0]] - points[self.ends[:, 1]]
        way = apart / np.linalg.norm(apart, axis=1, keepdims=True) / self.sigmas[:, None]
        columns = (3 * self.ends[:, :, None] + np.arange(3)).reshape(len(way), 6)
        rows = np.repeat(np.arange(len(way)), 6)
        at = (rows, columns.ravel())
        return scipy.sparse.csr_array((np.hstack([way, -way]).ravel(), at), shape=(len(way), 3 * len(points)))

    def of_points(self, kept: Bool[np.ndarray, " p"]) -> Distances:
        """Those of which both ends are kept, by their new indices."""
        both = kept[self.ends].all(axis=1)
        return Distances((np.cumsum(kept) - 1)[self.ends[both]], self.lengths[both], self.sigmas[both])


NO_DISTANCES = Distances(np.zeros((0, 2), dtype=np.int64), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class JoinedPoints:
    """What distances add to tie points that were eliminated one by one (Woodbury's identity).

    Attributes:
        design: (b, 3p) derivatives of the distances.
        spread: (3p, b) the points' own covariance times its transpose.
        inverse: (b, b) inverse covariance of the distances as the points have them, and as measured.
    """

    design: scipy.sparse.csr_array
    spread: scipy.sparse.csr_array
    inverse: Float64[np.ndarray, "b b"]

    @classmethod
    def of(
        cls, distances: Distances, points: Float64[np.ndarray, "p 3"], own: Float64[np.ndarray, "p 3 3"]
    ) -> JoinedPoints:
        """Join points.

        Args:
            distances: Between them.
            points: Their positions.
            own: Their covariance without the distances, for known cameras.
        """
        design, p = distances.design(points), len(points)
        blocks = scipy.sparse.bsr_array((own, np.arange(p), np.arange(p + 1)), shape=(3 * p, 3 * p))
        spread = scipy.sparse.csr_array(blocks @ design.T)
        return cls(design, spread, np.linalg.inv(np.eye(len(distances)) + (design @ spread).todense()))

    def corrected(self, step: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
        """The points' step with the distances."""
        return np.asarray(step - (self.spread @ (self.inverse @ (self.design @ step.ravel()))).reshape(-1, 3))
