"""Distortion loss: everything along a ray should lie at one depth, not in translucent layers.

The idea is from Barron et al., "Mip-NeRF 360" (CVPR 2022), as adapted to splats by Huang et al., "2D Gaussian Splatting
for Geometrically Accurate Radiance Fields" (SIGGRAPH 2024), there with the squared distances of all pairs along a ray:
that sum is the variance of its depths, which two more images give (Σ z α T and Σ z² α T). Here a spread below the GSD
is free, and the penalty saturates for a large one: past a roof's edge a pixel rightly sees two depths.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.rasterizer import Render, RenderOptions
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.hooks import RenderedView, Technique
from splatpipe.pipeline.train.photos.stream import EVERYWHERE
from splatpipe.pipeline.train.plan.schedule import ScheduleStep

FIRST_SHARE = 0.2  # first share of a run from sparse points, without this loss: the surface has to form first
MIN_ALPHA = 0.5  # below it a pixel shows more background than surface
FREE_PX = 0.5  # standard deviation without penalty, in GSD
HALF_PX = 10.0  # excess in GSD at which half of the maximum penalty is reached
CENTRE_EVERY = 500  # iterations between updates of the model's centre on a device: it hardly moves


class DistortionLoss(Technique):
    """Adds the spread of the depths along each ray to the loss.

    Args:
        weight: Weight in the loss.
        after: Iterations of the schedule without this loss.
        about_median: As for ``spread_loss``.
    """

    name = "distortion"

    def __init__(self, weight: float, after: int, about_median: bool = False) -> None:
        self._weight, self._after, self._about_median = weight, after, about_median
        self._centre = torch.full((3,), torch.nan, dtype=torch.float64)  # kept on the CPU

    def is_counted(self, place: int) -> bool:
        """Whether the loss is active at a place of the schedule, from 1."""
        return place > self._after

    def settings(self, settings: RenderOptions, model: Gaussians, camera: Camera, now: ScheduleStep) -> RenderOptions:
        """Turn on depths, with an origin at which float32 is most precise."""
        if not self.is_counted(now.place):
            return settings
        if self._is_stale(model, now):
            self._centre = model.means.detach().mean(dim=0).double().cpu()
        return replace(settings, depth=True, depth_origin=depth_along(self._centre, camera))

    def _is_stale(self, model: Gaussians, now: ScheduleStep) -> bool:
        """Whether to recompute the model's centre: rarely on a device, because that synchronizes."""
        if model.means.device.type == "cpu":
            return True
        return now.iteration % CENTRE_EVERY == 0 or bool(self._centre.isnan().any())

    def to_arrays(self) -> dict[str, Tensor]:
        """The centre, which affects the rounding of depths."""
        return {"centre": self._centre}

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """The inverse of ``to_arrays``; a missing centre is recomputed."""
        if "centre" in arrays:
            self._centre = arrays["centre"].clone()

    def penalty(self, rendered_view: RenderedView) -> Float[Tensor, ""] | None:
        """The spread of depths along the photo's rays, weighted."""
        if not self.is_counted(rendered_view.now.place):
            return None
        photo, origin = rendered_view.photo, rendered_view.settings.depth_origin
        return self._weight * spread_loss(
            rendered_view.rendered, origin, photo.camera, photo.inside, self._about_median
        )


def depth_origin(means: Float[Tensor, "n 3"], camera: Camera) -> float:
    """Origin of depths: the depth of the Gaussians' mean, world units."""
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
    """Spread of the depths along each ray, 0 to 1; the mean over the pixels, 0 where no surface is shown.

    Args:
        rendered: With depths, squared from ``origin``.
        origin: World units along the view axis.
        camera: The photo's camera.
        inside: Rows and columns that count.
        about_median: Measure the spread about the ray's median depth, not the mean, which distant background shining
            through pulls behind the surface.
    """
    seen = rendered.alpha.detach() >= MIN_ALPHA
    alpha = torch.where(seen, rendered.alpha, 1.0)
    mean = torch.where(seen, rendered.depth_sum, 0.0) / alpha - origin
    square = torch.where(seen, rendered.depth_square_sum, 0.0) / alpha
    if about_median:
        middle = torch.where(seen, rendered.median_depth, 0.0) - origin
        variance = torch.where(seen, square - 2.0 * middle * mean + middle.square(), 0.0)
    else:
        variance = square - torch.where(seen, mean, 0.0).square()
    pixel = torch.where(seen, (mean.detach() + origin) / camera.fx, 1.0)  # GSD, world units
    excess = torch.relu(variance / pixel.square() - FREE_PX**2)
    return torch.where(seen, excess / (excess + HALF_PX**2), 0.0)[inside].mean()
