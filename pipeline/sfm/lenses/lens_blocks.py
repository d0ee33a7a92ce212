"""What every adjustment keeps fixed in a lens: the ratio of its focal lengths, and the distortion's denominator.

COLMAP's larger models have a focal length for each axis, and FULL_OPENCV has rational distortion: photos of a scene
cannot determine either along with the other parameters.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pyceres
import pycolmap

TIE_SIGMA_PX = 1e-3  # between the two focal lengths of one lens
DENOMINATOR = {"FULL_OPENCV": (9, 10, 11)}  # k4, k5, k6


class _Tie(pyceres.CostFunction):  # type: ignore[misc]
    """Residual that keeps the ratio of two focal lengths."""

    def __init__(self, size: int, ratio: float) -> None:
        super().__init__()
        self.set_num_residuals(1)
        self.set_parameter_block_sizes([size])
        self._row = np.zeros(size)
        self._row[:2] = ratio / TIE_SIGMA_PX, -1.0 / TIE_SIGMA_PX

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        """Evaluate the residual; Ceres' interface."""
        residuals[0] = float(self._row[:2] @ np.asarray(parameters[0][:2]))
        if jacobians is not None and jacobians[0] is not None:
            jacobians[0][:] = self._row
        return True


def tie_focals(problem: Any, camera: pycolmap.Camera) -> list[object]:
    """Keep the ratio of a camera's focal lengths; return the objects to keep alive until the problem is solved."""
    params = camera.params
    if len(camera.focal_length_idxs()) != 2 or not problem.has_parameter_block(params):
        return []
    cost = _Tie(len(params), float(params[1] / params[0]))
    problem.add_residual_block(cost, None, [params])
    return [cost, params]


def hold(problem: Any, camera: pycolmap.Camera, held: list[int]) -> list[object]:
    """Hold some of a camera's parameters and free the others; return the objects to keep alive."""
    params = camera.params
    if len(held) == len(params):
        problem.set_parameter_block_constant(params)
        return [params]
    manifold = pyceres.SubsetManifold(len(params), held) if held else None
    if manifold is not None:
        problem.set_manifold(params, manifold)
    return [params, manifold]


def keep_shape(problem: Any, camera: pycolmap.Camera, principal_point: bool = False) -> list[object]:
    """Tie a camera's focal lengths, and hold its denominator and, unless it is free, its principal point.

    A camera with a single focal length is left as COLMAP set it up. Returns the objects to keep alive.
    """
    if len(camera.focal_length_idxs()) != 2 or not problem.has_parameter_block(camera.params):
        return []
    held = [] if principal_point else list(camera.principal_point_idxs())
    held += DENOMINATOR.get(camera.model_name, ())
    return [*hold(problem, camera, sorted(held)), *tie_focals(problem, camera)]
