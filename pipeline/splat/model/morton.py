"""Morton codes: points close on the curve are close in space."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor

BITS = 21  # per axis: three times 21 and the sign make 64
_SPREAD = (  # shifts and masks that insert two zeros between bits
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_keys(
    means: Float[Tensor, "n 3"], lowest: Float[Tensor, " 3"], size: Float[Tensor, " 3"]
) -> Int64[Tensor, " n"]:
    """Morton codes of points in a box; the first axis has the lowest bit.

    Args:
        means: Points, world frame and units; NaN coordinates count as 0 after scaling, the lowest end.
        lowest: Lowest corner of the box.
        size: Side lengths of the box; along a side of length zero all points coincide.
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
