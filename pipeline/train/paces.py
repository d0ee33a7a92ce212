"""How far a step moves a Gaussian: what is far moves as many pixels of its photo as what is near.

Learning rates of positions are published as a share of the scene's extent: a step is as many millimetres on a façade
as on the hills behind it, where these are a small part of a pixel. What is far then never comes to the depth at which
its photos agree, and is learned as so many pictures, one for each of them: good in what is trained on, wrong between
them. Here, beyond the extent, a step across the ray grows with the distance, the same angle everywhere; along the ray
it grows with its square, as the depth does that a pixel of parallax leaves open. Nearer it stays as published: shorter
steps over ground that is flown over straight down left it a little softer.
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
def by_distance(
    means: Float[Tensor, "n 3"], rows: Bool[Tensor, " n"] | None, camera: Camera, unit: float
) -> Iterator[None]:
    """Positions that are stepped in the body go further where they are further than the unit from the camera.

    Args:
        means: Changed in place, world units.
        rows: Those that are stepped; None for all.
        camera: Of the photo that asks for the step.
        unit: Distance at which a step is as long as its rate says, world units.
    """
    on_device = kernels_of(means.device) is not None  # there, to count rows is to wait, and all of them cost little
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
    pace = distance.div_(unit).clamp_(min=1.0)
    moved = (means[chosen] - before).mul_(pace)
    along = (moved * ray).sum(dim=1, keepdim=True).mul_(pace - 1.0)
    means[chosen] = before.add_(moved).addcmul_(ray, along)
