"""Step lengths by distance: far Gaussians move as many pixels in their photo as near ones.

The published learning rates of positions are a share of the scene's extent: a step is as many millimetres on a façade
as on the hills behind it, where that is a small fraction of a pixel. Distant objects then never reach the depth at
which their photos agree, and are learned as separate images, one per photo: good in the training views, wrong between
them. Here, beyond the extent, a step across the ray grows with the distance (the same angle everywhere) and along the
ray with its square, as the depth uncertainty of a pixel of parallax does. Nearer steps stay as published: shorter ones
made ground in nadir flights slightly softer.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.cuda import kernels_of


@contextmanager
def lengthen_far_steps(
    means: Float[Tensor, "n 3"], rows: Bool[Tensor, " n"] | None, camera: Camera, unit: float
) -> Iterator[None]:
    """Lengthen the steps taken in the body for positions farther than ``unit`` from the camera.

    Args:
        means: Positions, world units; changed in place.
        rows: Rows that are stepped; None for all.
        camera: Camera of the photo that causes the step.
        unit: Distance up to which a step has the length given by its rate, world units.
    """
    on_device = kernels_of(means.device) is not None  # counting rows would synchronize, and using all is cheap there
    chosen = slice(None) if rows is None or on_device else torch.nonzero(rows).flatten()
    ray = means[chosen].clone()
    for axis, value in enumerate(camera.centre().tolist()):
        ray[:, axis] -= value
    distance = torch.linalg.vector_norm(ray, dim=1, keepdim=True)
    if isinstance(chosen, Tensor):
        far = torch.nonzero(distance[:, 0] > unit).flatten()
        chosen, ray, distance = chosen[far], ray[far], distance[far]
    before = means[chosen].clone()
    yield
    ray.div_(distance.clamp(min=1e-30))
    factor = distance.div_(unit).clamp_(min=1.0)
    moved = (means[chosen] - before).mul_(factor)
    along = (moved * ray).sum(dim=1, keepdim=True).mul_(factor - 1.0)
    means[chosen] = before.add_(moved).addcmul_(ray, along)
