"""One surface a pixel: what a ray sees shall lie at one depth, not in layers that shine through each other.

The idea of the distortion loss of Barron et al., "Mip-NeRF 360" (CVPR 2022), as Huang et al., "2D Gaussian Splatting
for Geometrically Accurate Radiance Fields" (SIGGRAPH 2024) have it for splats, there by the squared distances of all
pairs along a ray: that sum is the variance of its depths, which two more pictures give (Σ z α T and Σ z² α T). Here
what is less than a pixel on the ground is free, and what is much more counts
no more than that: past a roof's edge a pixel rightly sees two depths.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.rasterizer import Render
from splatpipe.pipeline.train.options import TrainConfig

FIRST_SHARE = 0.2  # of the run, without it: the surface has to be found first
LEAST_ALPHA = 0.5  # below it a pixel shows more of the background than of a depth
FREE_PX = 0.5  # standard deviation that costs nothing, pixels on the ground
HALF_PX = 10.0  # beyond it at which half of the most is reached


def is_spread_counted(options: TrainConfig, place: int) -> bool:
    """Whether an iteration's loss has a part for the spread of depths.

    Args:
        options: The training's.
        place: Of the iteration in the schedule, from 1.
    """
    return options.distortion_weight > 0.0 and place > FIRST_SHARE * options.iterations


def depth_origin(means: Float[Tensor, "n 3"], camera: Camera) -> float:
    """Where depths are measured from: that of the Gaussians' mean."""
    pose = camera.cam_from_world
    x, y, z = means.detach().mean(dim=0).tolist()
    return float(pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3])


def spread_loss(rendered: Render, origin: float, camera: Camera) -> Float[Tensor, ""]:
    """How far the depths along each ray are apart, 0 to 1, mean over the pixels that show a surface.

    Args:
        rendered: With depths, squared from ``origin``.
        origin: World units along the view axis.
        camera: The photo's.
    """
    seen = rendered.alpha.detach() >= LEAST_ALPHA
    alpha = torch.where(seen, rendered.alpha, 1.0)
    mean = torch.where(seen, rendered.depth_sum, 0.0) / alpha - origin
    variance = torch.where(seen, rendered.depth_square_sum, 0.0) / alpha - torch.where(seen, mean, 0.0).square()
    pixel = torch.where(seen, (mean.detach() + origin) / camera.fx, 1.0)  # on the ground, world units
    excess = torch.relu(variance / pixel.square() - FREE_PX**2)
    return torch.where(seen, excess / (excess + HALF_PX**2), 0.0).mean()
