"""A limit on needles, which few views cannot tell from a surface.

The idea of Xie et al., "PhysGaussian", CVPR 2024, as a limit instead of a penalty, so that it needs no weight, and of
the longest axis against the middle one, not the shortest: a disc is what a wall is made of.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.train.options import TrainConfig


def limit_needles(log_scales: Float[Tensor, "n 3"], options: TrainConfig) -> None:
    """Leave no axis longer than `max_anisotropy` times the middle one, in place; 0: no limit."""
    if options.max_anisotropy > 0.0:
        a, b, c = log_scales.unbind(dim=1)
        low, high = torch.minimum(a, b), torch.maximum(a, b)
        middle = torch.maximum(low, torch.minimum(high, c))
        torch.minimum(log_scales, (middle + math.log(max(1.0, options.max_anisotropy)))[:, None], out=log_scales)
