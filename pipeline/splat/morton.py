"""Places along a Morton curve: what is near in space is near on it."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor

BITS = 21  # an axis: three of them and the sign fill 64
_SPREAD = (  # how far bits are moved, and those that stay: two zeros between each two in the end
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_keys(
    means: Float[Tensor, "n 3"], lowest: Float[Tensor, " 3"], size: Float[Tensor, " 3"]
) -> Int64[Tensor, " n"]:
    """Places along a Morton curve through a box; the first axis has the lowest bit.

    Args:
        means: Points, world frame and units; one that is no number lies at the lowest end.
        lowest: The box's corner.
        size: Of its sides; along one of no length all points are at one place.
    """
    cells = torch.where(size > 0.0, (1 << BITS) / size, 0.0)
    places = ((means - lowest) * cells).nan_to_num_(0.0).clamp_(0.0, (1 << BITS) - 1)
    keys = torch.zeros(len(means), dtype=torch.int64, device=means.device)
    for axis in range(3):
        bits = places[:, axis].to(torch.int64)
        for shift, kept in _SPREAD:
            bits = (bits | bits << shift).bitwise_and_(kept)
        keys |= bits << axis
    return keys
