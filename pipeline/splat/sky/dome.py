"""A panorama as a dome of Gaussians around the scene, for viewers that only show splats."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float64

from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import rgb_to_dc
from splatpipe.pipeline.splat.sky.panorama import COLUMNS, FULL_FROM_DEG, Panorama
from splatpipe.pipeline.splat.sky.sky_mask import horizontal_axes

SPACING_RAD = 2.0 * math.pi / COLUMNS / 4.0  # a quarter of a cell: neighbours differ by about one 8-bit step at most
SIGMA_PER_SPACING = 0.8  # the smallest without gaps between the Gaussians; larger values blur
OPACITY_LOGIT = 6.0  # above the rasterizers' cap of 0.99
SCENE_QUANTILE = 0.999  # quantile of the Gaussians' distances that is the scene's size: a few stray ones lie anywhere
RADIUS_PER_SCENE = 2.0  # the dome lies well outside the scene and hides none of it
RADIUS_PER_CAMERAS = 10.0  # limits the sky's parallax between the cameras to 6°, one cell
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


def sky_dome(panorama: Panorama, scene: Gaussians, cameras: Float64[np.ndarray, "n 3"]) -> Gaussians:
    """Opaque round Gaussians that show a panorama where it fully covers, as seen from among the cameras.

    Args:
        panorama: In the scene's frame.
        scene: The scene, which must stay inside the dome; finite.
        cameras: Camera centres, world units; at least one.

    Returns:
        Gaussians of SH degree 0 in the scene's frame.
    """
    centre = cameras.mean(axis=0)
    radius = dome_radius(scene, cameras, centre)
    rays = dome_directions(panorama.up)
    dome = Gaussians.empty(len(rays), sh_degree=0)
    dome.means = torch.from_numpy((centre + radius * rays).astype(np.float32))
    dome.log_scales.fill_(math.log(SIGMA_PER_SPACING * SPACING_RAD * radius))
    dome.opacity_logits.fill_(OPACITY_LOGIT)
    dome.sh = rgb_to_dc(panorama.at(rays).detach().to(torch.float32))[:, None].contiguous()
    return dome


def dome_radius(scene: Gaussians, cameras: Float64[np.ndarray, "n 3"], centre: Float64[np.ndarray, " 3"]) -> float:
    """Radius of the dome about the cameras' mean, world units, > 0."""
    spread = float(np.linalg.norm(cameras - centre, axis=1).max())
    distances = np.linalg.norm(scene.means.detach().numpy().astype(np.float64) - centre, axis=1)
    reach = float(np.quantile(distances, SCENE_QUANTILE, method="lower")) if len(distances) else 0.0
    return max(RADIUS_PER_SCENE * reach, RADIUS_PER_CAMERAS * spread) or 1.0


def dome_directions(up: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "n 3"]:
    """Unit vectors about ``SPACING_RAD`` apart, from the zenith to where the panorama ends: a Fibonacci lattice.

    R. Swinbank, R. J. Purser: "Fibonacci grids: a novel approach to global modelling" (2006).
    """
    lowest = math.sin(math.radians(FULL_FROM_DEG))
    count = math.ceil(2.0 * math.pi * (1.0 - lowest) / SPACING_RAD**2)  # equal areas of one spacing squared each
    index = np.arange(count)
    height = 1.0 - (1.0 - lowest) * (index + 0.5) / count
    level = np.sqrt(1.0 - height**2)
    east, north = horizontal_axes(up)
    turn = GOLDEN_ANGLE * index
    x, y = level * np.cos(turn), level * np.sin(turn)
    return np.asarray(x[:, None] * east + y[:, None] * north + height[:, None] * up)
