"""How a training's iterations are divided between the coarse pass over the whole and its blocks. Cheap to import.

The coarse pass takes those at the first size, with whole photos; blocks continue with the finer sizes, window by
window. If there is only one size, the coarse pass takes part of its iterations and the blocks take the rest.
"""

from __future__ import annotations

import math

from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.lengths import Length, PhotoSizes, lengths_of

COARSE_PART = 0.5  # share of the iterations for the coarse pass if there is only one size


def coarse_lengths(config: TrainConfig, footage: PhotoSizes) -> list[Length]:
    """Iterations of the coarse pass.

    Args:
        config: The training options.
        footage: All photos.
    """
    (first, count), *finer = lengths_of(config, footage)
    return [(first, count if finer else math.ceil(COARSE_PART * count))]


def finer_lengths(config: TrainConfig, footage: PhotoSizes) -> list[Length]:
    """Iterations after the coarse pass, first size first, counting each window once even if several blocks share it.

    Args:
        config: The training options.
        footage: All photos.
    """
    (first, count), *finer = lengths_of(config, footage)
    return finer or [(first, count - math.ceil(COARSE_PART * count))]
