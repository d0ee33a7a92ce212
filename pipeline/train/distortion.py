"""One surface a pixel: what a ray sees shall lie at one depth, not in layers that shine through each other.

The idea of the distortion loss of Barron et al., "Mip-NeRF 360" (CVPR 2022), as Huang et al., "2D Gaussian Splatting
for Geometrically Accurate Radiance Fields" (SIGGRAPH 2024) have it for splats, there by the squared distances of all
pairs along a ray: that sum is the variance of its depths, which two more pictures give (Σ z α T and Σ z² α T). Here
what is less than a pixel on the ground is free, and what is much more counts no more than that: past a roof's edge a
pixel rightly sees two depths.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.rasterizer import Render, RenderOptions
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.train.hooks import Shot, Technique
from splatpipe.pipeline.train.schedule import Moment

FIRST_SHARE = 0.2  # of the run, without it: the surface has to be found first
LEAST_ALPHA = 0.5  # below it a pixel shows more of the background than of a depth
FREE_PX = 0.5  # standard deviation that costs nothing, pixels on the ground
HALF_PX = 10.0  # beyond it at which half of the most is reached


class Distortion(Technique):
    """Adds the spread of the depths along each ray to the loss.

    Args:
        weight: In the loss.
        iterations: Of the schedule.
    """

    name = "distortion"

    def __init__(self, weight: float, iterations: int) -> None:
        self._weight, self._iterations = weight, iterations

    def is_counted(self, place: int) -> bool:
        """Whether it has a part in the loss at a place of the schedule, from 1."""
        return place > FIRST_SHARE * self._iterations

    def settings(self, settings: RenderOptions, model: Gaussians, camera: Camera, now: Moment) -> RenderOptions:
        """With depths, measured from where float32 tells them best."""
        if not self.is_counted(now.place):
            return settings
        return replace(settings, depth=True, depth_origin=depth_origin(model.means, camera))

    def penalty(self, shot: Shot) -> Float[Tensor, ""] | None:
        """The spread of the photo's rays, weighted."""
        if not self.is_counted(shot.now.place):
            return None
        return self._weight * spread_loss(shot.rendered, shot.settings.depth_origin, shot.photo.camera)


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
