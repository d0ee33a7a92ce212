"""Smoothness loss: depths of neighbouring rays should lie on a plane, except at depth discontinuities.

The inverse depth of a plane is linear over an image, so its second difference tells how far a point lies off the
straight line between its neighbours on either side, whatever the slant of the surface. As in depth–normal consistency
(Huang et al., "2D Gaussian Splatting for Geometrically Accurate Radiance Fields", SIGGRAPH 2024), a Gaussian's
orientation is pulled towards that of the surface formed by its neighbours; here through the depths at which rays meet
it, which depend on its orientation, so that no normal map has to be rendered: on the demo both were equally good, and
this took half the time. The penalty saturates, so edges and steps of many pixels cost no more.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.rasterizer import Render
from splatpipe.pipeline.train.hooks import RenderedView, Technique
from splatpipe.pipeline.train.photos.stream import EVERYWHERE
from splatpipe.pipeline.train.techniques.distortion_loss import MIN_ALPHA

REACHES_PX = (1, 4, 12)  # distances to the neighbours on either side: from roughness to waviness
HALF_PX = 1.0  # deviation, in GSD, at which half of the maximum penalty is reached


class SmoothnessLoss(Technique):
    """Adds the unevenness of depths to the loss; requires ``DistortionLoss``, which turns depths on.

    Args:
        weight: Weight in the loss.
    """

    name = "evenness"

    def __init__(self, weight: float) -> None:
        self._weight = weight

    def penalty(self, rendered_view: RenderedView) -> Float[Tensor, ""] | None:
        """The unevenness of the photo's depths, weighted."""
        return self._weight * unevenness(rendered_view.rendered, rendered_view.photo.camera, rendered_view.photo.inside)


def unevenness(
    rendered: Render, camera: Camera, inside: tuple[slice, slice] = EVERYWHERE, reaches: tuple[int, ...] = REACHES_PX
) -> Float[Tensor, ""]:
    """Deviation of depths from the line between their neighbours, 0 to 1 per reach and direction, summed.

    Each is the mean over the pixels that have neighbours; where one of the three shows no surface, it is 0.

    Args:
        rendered: With depths.
        camera: The photo's camera.
        inside: Rows and columns that count.
        reaches: Pixels between a pixel and its neighbours; reaches too large for the image are left out.
    """
    seen = (rendered.alpha.detach() >= MIN_ALPHA)[inside]
    inverse = torch.where(seen, rendered.alpha[inside], 1.0) / torch.where(seen, rendered.depth_sum[inside], 1.0)
    ground = camera.fx / inverse.detach()  # converts a difference of inverse depths to GSD
    total = inverse.new_zeros(())
    for reach in reaches:
        for axis in (0, 1):
            count = inverse.shape[axis] - 2 * reach
            if count < 1:
                continue
            before, here, after = (inverse.narrow(axis, start, count) for start in (0, reach, 2 * reach))
            whole = [seen.narrow(axis, start, count) for start in (0, reach, 2 * reach)]
            off = (before + after - 2.0 * here) * ground.narrow(axis, reach, count)
            share = off.square() / (off.square() + HALF_PX**2)
            total = total + torch.where(whole[0] & whole[1] & whole[2], share, 0.0).mean()
    return total
