"""Even surfaces: the depths that neighbouring rays meet shall go on straight, wherever they do not break off.

The inverse depth of a plane is linear over a picture, so its second difference tells, pixel by pixel, how far a place
lies off the straight line between two on either side: wherever surfaces are plain, and whatever their slant. As in
depth–normal consistency (Huang et al., "2D Gaussian Splatting for Geometrically Accurate Radiance Fields", SIGGRAPH
2024) a Gaussian's orientation is drawn to that of the surface which its neighbours make together; here through the
depths that rays meet in it, which turn with it, so that no second picture, of normals, has to be rendered: on the demo
both were as good, and this took half the time. Edges and steps are much more than a pixel, and cost no more than that.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.rasterizer import Render
from splatpipe.pipeline.train.distortion_loss import LEAST_ALPHA
from splatpipe.pipeline.train.hooks import Shot, Technique
from splatpipe.pipeline.train.stream import EVERYWHERE

REACHES_PX = (1, 4, 12)  # between a place and those on either side: from what is rough to what is wavy
HALF_PX = 1.0  # off the line, pixels on the ground, at which half of the most is reached


class SmoothnessLoss(Technique):
    """Adds how uneven the depths are to the loss; used with ``Distortion``, which asks for them.

    Args:
        weight: Weight in the loss.
    """

    name = "evenness"

    def __init__(self, weight: float) -> None:
        self._weight = weight

    def penalty(self, shot: Shot) -> Float[Tensor, ""] | None:
        """How uneven the photo's depths are, weighted."""
        return self._weight * unevenness(shot.rendered, shot.photo.camera, shot.photo.inside)


def unevenness(
    rendered: Render, camera: Camera, inside: tuple[slice, slice] = EVERYWHERE, reaches: tuple[int, ...] = REACHES_PX
) -> Float[Tensor, ""]:
    """How far depths are off the line between those on either side, 0 to 1 for each reach and direction, summed.

    Each is the mean over the places that have neighbours; where one of the three shows no surface, it is 0.

    Args:
        rendered: With depths.
        camera: The photo's camera.
        inside: Rows and columns that count.
        reaches: Pixels between a place and its neighbours; one that the picture is too small for is left out.
    """
    seen = (rendered.alpha.detach() >= LEAST_ALPHA)[inside]
    inverse = torch.where(seen, rendered.alpha[inside], 1.0) / torch.where(seen, rendered.depth_sum[inside], 1.0)
    ground = camera.fx / inverse.detach()  # pixels of depth that a difference of inverse depths is
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
