"""Step lengths by distance: far Gaussians move as many pixels in their photo as near ones.

The published learning rates of positions are a share of the scene's extent: a step is as many millimetres on a façade
as on the hills behind it, where that is a small fraction of a pixel. Distant objects then never reach the depth at
which their photos agree, and are learned as separate images, one per photo: good in the training views, wrong between
them. Here, beyond the extent, a step across the ray grows with the distance (the same angle everywhere) and along the
ray with its square, as the depth uncertainty of a pixel of parallax does. Nearer steps stay as published: shorter ones
made ground in nadir flights slightly softer.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.raster.cuda.cuda import kernels_of

NO_DISTANCE = 1e-30  # keeps the direction of a Gaussian in the camera's centre finite


@dataclass(frozen=True)
class FarSteps:
    """Lengthens the steps of positions that are farther from a camera than a distance.

    Attributes:
        centre: Centre of the camera whose photo causes the step, world units.
        unit: Distance up to which a step has the length given by its rate, world units.
    """

    centre: tuple[float, float, float]
    unit: float

    @contextmanager
    def lengthened(self, means: Float[Tensor, "n 3"], rows: Bool[Tensor, " n"] | None) -> Iterator[None]:
        """Lengthen the steps taken in the body; the kernels that fuse a step with it compute the same bits.

        Args:
            means: Positions, world units; changed in place.
            rows: Rows that are stepped; None for all.
        """
        on_device = kernels_of(means.device) is not None  # choosing rows would synchronize; all are cheap there
        columns = [means[:, axis] - self.centre[axis] for axis in range(3)]
        distance = _dot(columns, columns).double().sqrt_().float()  # torch's root of floats is off by a last bit
        far: Tensor | slice = slice(None)
        if not on_device:
            is_far = distance > self.unit
            far = torch.nonzero(is_far if rows is None else is_far & rows).flatten()
        before = means[far].clone()
        distance, columns = distance[far], [column[far] for column in columns]
        yield
        factor = (distance / self.unit).clamp_(min=1.0)
        moved = (means[far] - before).mul_(factor[:, None])
        ray = [column / distance.clamp(min=NO_DISTANCE) for column in columns]
        along = _dot(list(moved.unbind(1)), ray).mul_(factor - 1.0)
        means[far] = before.add_(moved).add_(torch.stack([along * axis for axis in ray], dim=1))


def _dot(first: Sequence[Float[Tensor, " n"]], second: Sequence[Float[Tensor, " n"]]) -> Float[Tensor, " n"]:
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]
