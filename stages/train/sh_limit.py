"""The degree of spherical harmonics that a Gaussian may have, from the directions that photos really saw it from.

A photo gives a Gaussian one colour, so fewer photos than coefficients leave some free; and within a narrow fan of
directions a band looks like those below it, so that it has to be large to show at all, and is anything elsewhere.
Published trainers raise the degree with the iteration alone; the angles are judgement.

A Gaussian is really seen where the photo's loss has a gradient for it: neither outside the picture nor behind what is
opaque. A test of the frustums alone would count the cameras on a building's other side.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatpipe.pipeline.scene.camera import Camera
from splatpipe.pipeline.scene.sh import MAX_DEGREE, coefficient_count

FAN_RAD = tuple(math.radians(degrees) for degrees in (15.0, 35.0, 70.0))
"""Width of directions from which degrees 1, 2 and 3 are allowed. Over a fan of width w the band of degree l differs
from the bands below it by about (w / 2)^l of its size: 0.13, 0.09 and 0.23 at these widths."""


class Coverage:
    """Directions over the photos of the epoch, and the degree that the last epoch allows.

    An epoch has each photo once, so the count is of different photos. Before the first has ended no degree is known
    and none is allowed.

    Attributes:
        directions: (n, 3) sum of the unit directions from the cameras that saw each Gaussian.
        seen: (n,) how many did.
        degree: (n,) allowed, 0..3.
    """

    def __init__(self, count: int) -> None:
        self.directions = torch.zeros(count, 3)
        self.seen = torch.zeros(count)
        self.degree = torch.zeros(count)

    def observe(self, means: Float[Tensor, "n 3"], camera: Camera, seen: Bool[Tensor, " n"]) -> None:
        """Add a photo.

        Args:
            means: Of the Gaussians, world units.
            camera: The photo's.
            seen: Which of them it saw.
        """
        ray = means - torch.from_numpy(camera.centre()).to(means.dtype)
        length = torch.linalg.vector_norm(ray, dim=1, keepdim=True).clamp(min=1e-30)
        self.directions += torch.where(seen[:, None] & torch.isfinite(length), ray / length, 0.0)
        self.seen += seen

    def end_epoch(self) -> None:
        """Take the degrees from the epoch's sums, and begin the next; what no photo saw keeps its degree."""
        self.degree = torch.where(self.seen > 0.0, allowed_degree(self.directions, self.seen), self.degree)
        self.directions.zero_()
        self.seen.zero_()

    def select(self, source: Int64[Tensor, " m"]) -> None:
        """Go with the rows of density control: a child has what its parent has."""
        self.directions, self.seen, self.degree = self.directions[source], self.seen[source], self.degree[source]

    def clear(self, sh: Float[Tensor, "n k 3"]) -> None:
        """Set to zero, in place, what the degrees do not allow: of coefficients, their gradients or moments."""
        for degree in range(1, math.isqrt(sh.shape[1])):
            band = sh[:, coefficient_count(degree - 1) : coefficient_count(degree)]
            band.masked_fill_((self.degree < degree)[:, None, None], 0.0)

    def to_arrays(self) -> dict[str, Tensor]:
        """Its tensors by name, for a checkpoint."""
        return {"directions": self.directions, "seen": self.seen, "degree": self.degree}

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """The inverse of ``to_arrays``.

        Raises:
            KeyError: if something is missing.
            RuntimeError: if it is of another number of Gaussians.
        """
        for name, tensor in self.to_arrays().items():
            if arrays[name].shape != tensor.shape:
                raise RuntimeError(f"{name} is {tuple(arrays[name].shape)}, not {tuple(tensor.shape)}")
            tensor.copy_(arrays[name])


def allowed_degree(directions: Float[Tensor, "n 3"], seen: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """The degree that a Gaussian's views can tell.

    Args:
        directions: Sums of unit directions.
        seen: How many photos are in each sum.
    """
    width = fan_rad(directions, seen)
    degree = torch.zeros_like(seen)
    for more, least in enumerate(FAN_RAD, start=1):
        degree += (width >= least) & (seen >= coefficient_count(more))
    return degree.clamp(max=MAX_DEGREE)


def fan_rad(directions: Float[Tensor, "n 3"], seen: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Width of the even fan of directions that has the same mean resultant length R, radians; 0 for one direction.

    An even fan of width w has R = sin(w/2) / (w/2) ≈ 1 - w²/24 (Mardia, Jupp: "Directional Statistics").
    """
    resultant = torch.linalg.vector_norm(directions, dim=1) / seen.clamp(min=1.0)
    return torch.sqrt(24.0 * (1.0 - resultant).clamp(min=0.0)) * (seen > 1.0)
