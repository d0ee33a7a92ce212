"""Projection through any of COLMAP's lens models, pixel centres at +0.5; ``Camera.project`` is for pinholes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

if TYPE_CHECKING:  # training and rendering do without it
    import pycolmap


def project_through_lens(
    camera: pycolmap.Camera, cam_from_world: Float64[np.ndarray, "3 4"], points: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
    """Project world points into a photo with lens distortion.

    Args:
        camera: The photo's camera model.
        cam_from_world: The photo's pose.
        points: World points, world units.

    Returns:
        Pixels, NaN behind the camera and not finite where the lens model has no solution; and depths along the optical
        axis, world units.
    """
    in_camera = points @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    pixels = np.full((len(points), 2), np.nan)
    ahead = np.isfinite(in_camera).all(axis=1) & (in_camera[:, 2] > 0.0)
    if ahead.any():
        pixels[ahead] = np.asarray(camera.img_from_cam(in_camera[ahead]), np.float64).reshape(-1, 2)
    return pixels, np.asarray(in_camera[:, 2])
