"""One surface a pixel: what a ray sees shall lie at one depth, not in layers that shine through each other.

The idea of the distortion loss of Barron et al., "Mip-NeRF 360" (CVPR 2022), as Huang et al., "2D Gaussian Splatting
for Geometrically Accurate Radiance Fields" (SIGGRAPH 2024) have it for splats, there by the squared distances of all
pairs along a ray: that sum is the variance of its depths, which two more pictures give (Σ z α T and Σ z² α T). Here
what is less than a pixel on the ground is free, and what is much more counts no more than that: past a roof's edge a
pixel rightly sees two depths.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.rasterizer import Render, RenderOptions
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.train.hooks import Shot, Technique
from splatpipe.pipeline.train.schedule import ScheduleStep
from splatpipe.pipeline.train.stream import EVERYWHERE

FIRST_SHARE = 0.2  # of a run from sparse points, without it: the surface has to be found first
LEAST_ALPHA = 0.5  # below it a pixel shows more of the background than of a depth
FREE_PX = 0.5  # standard deviation that costs nothing, pixels on the ground
HALF_PX = 10.0  # beyond it at which half of the most is reached
CENTRE_EVERY = 500  # iterations between looks for the model's centre on a device: by then it hardly moves


class DistortionLoss(Technique):
    """Adds the spread of the depths along each ray to the loss.

    Args:
        weight: Weight in the loss.
        after: Iterations of the schedule that pass without it.
        about_median: As of ``spread_loss``.
    """

    name = "distortion"

    def __init__(self, weight: float, after: int, about_median: bool = False) -> None:
        self._weight, self._after, self._about_median = weight, after, about_median
        self._centre = torch.full((3,), torch.nan, dtype=torch.float64)  # kept on the CPU

    def is_counted(self, place: int) -> bool:
        """Whether it has a part in the loss at a place of the schedule, from 1."""
        return place > self._after

    def settings(self, settings: RenderOptions, model: Gaussians, camera: Camera, now: ScheduleStep) -> RenderOptions:
        """With depths, measured from where float32 tells them best."""
        if not self.is_counted(now.place):
            return settings
        if self._is_worn(model, now):
            self._centre = model.means.detach().mean(dim=0).double().cpu()
        return replace(settings, depth=True, depth_origin=depth_along(self._centre, camera))

    def _is_worn(self, model: Gaussians, now: ScheduleStep) -> bool:
        """Whether the model's centre has to be looked for again: on a device seldom, for that waits for it."""
        if model.means.device.type == "cpu":
            return True
        return now.iteration % CENTRE_EVERY == 0 or bool(self._centre.isnan().any())

    def to_arrays(self) -> dict[str, Tensor]:
        """The centre, by which depths are rounded."""
        return {"centre": self._centre}

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """The inverse of ``to_arrays``; where there is no centre, it is looked for again."""
        if "centre" in arrays:
            self._centre = arrays["centre"].clone()

    def penalty(self, shot: Shot) -> Float[Tensor, ""] | None:
        """The spread of the photo's rays, weighted."""
        if not self.is_counted(shot.now.place):
            return None
        photo, origin = shot.photo, shot.settings.depth_origin
        return self._weight * spread_loss(shot.rendered, origin, photo.camera, photo.inside, self._about_median)


def depth_origin(means: Float[Tensor, "n 3"], camera: Camera) -> float:
    """Where depths are measured from: that of the Gaussians' mean."""
    return depth_along(means.detach().mean(dim=0).double(), camera)


def depth_along(point: Float64[Tensor, " 3"], camera: Camera) -> float:
    """A world point's depth along the camera's axis, world units."""
    pose = camera.cam_from_world
    x, y, z = point.tolist()
    return float(pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3])


def spread_loss(
    rendered: Render,
    origin: float,
    camera: Camera,
    inside: tuple[slice, slice] = EVERYWHERE,
    about_median: bool = False,
) -> Float[Tensor, ""]:
    """How far the depths along each ray are apart, 0 to 1, mean over the pixels that show a surface.

    Args:
        rendered: With depths, squared from ``origin``.
        origin: World units along the view axis.
        camera: The photo's camera.
        inside: Rows and columns that count.
        about_median: Depths are to lie at the ray's median, not at their mean, which what shines through from far
            behind draws behind the surface.
    """
    seen = rendered.alpha.detach() >= LEAST_ALPHA
    alpha = torch.where(seen, rendered.alpha, 1.0)
    mean = torch.where(seen, rendered.depth_sum, 0.0) / alpha - origin
    square = torch.where(seen, rendered.depth_square_sum, 0.0) / alpha
    if about_median:
        middle = torch.where(seen, rendered.median_depth, 0.0) - origin
        variance = torch.where(seen, square - 2.0 * middle * mean + middle.square(), 0.0)
    else:
        variance = square - torch.where(seen, mean, 0.0).square()
    pixel = torch.where(seen, (mean.detach() + origin) / camera.fx, 1.0)  # on the ground, world units
    excess = torch.relu(variance / pixel.square() - FREE_PX**2)
    return torch.where(seen, excess / (excess + HALF_PX**2), 0.0)[inside].mean()
