"""Distances from positions to the solid parts of a scene, so that a camera path does not fly through anything."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial import cKDTree

from splatpipe.pipeline.splat.model.gaussians import Gaussians

MIN_SOLID_OPACITY = 0.5  # minimum opacity of Gaussians that a camera must not fly through
MAX_POINTS = 400_000  # used for distances: more do not help at the scale of metres
MIN_NEAR_POINTS = 8  # minimum number of points that near: a few floaters are not a wall


class Clearance:
    """Distances to the solid parts of a scene."""

    def __init__(self, solid: Float64[np.ndarray, "n 3"]) -> None:
        """Index the points.

        Args:
            solid: Solid points, world units; non-finite ones are ignored.
        """
        solid = solid[np.isfinite(solid).all(axis=1)]
        solid = solid[:: max(1, -(-len(solid) // MAX_POINTS))]
        self._tree = cKDTree(solid) if len(solid) >= MIN_NEAR_POINTS else None

    def at(self, places: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, " m"]:
        """Distance from each place to the ``MIN_NEAR_POINTS``-th nearest point, world units; infinite without one."""
        if self._tree is None or len(places) == 0:
            return np.full(len(places), np.inf)
        return np.asarray(self._tree.query(places, [MIN_NEAR_POINTS])[0][:, 0])

    def between(
        self, start: Float64[np.ndarray, " 3"], end: Float64[np.ndarray, " 3"], step: float
    ) -> Float64[np.ndarray, " m"]:
        """The same along a straight line, both ends included.

        Args:
            start: Where it begins.
            end: Where it ends.
            step: Maximum spacing of the samples, world units, > 0.
        """
        count = int(np.clip(np.ceil(np.linalg.norm(end - start) / step), 1, 1000)) + 1
        return self.at(start + np.linspace(0.0, 1.0, count)[:, None] * (end - start))


def solid_places(gaussians: Gaussians) -> Float64[np.ndarray, "n 3"]:
    """Centres of the opaque Gaussians, in the model's frame."""
    opaque = torch.sigmoid(gaussians.opacity_logits.detach()) >= MIN_SOLID_OPACITY
    return gaussians.means.detach()[opaque].cpu().numpy().astype(np.float64)
