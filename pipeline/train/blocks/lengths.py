"""How a training's iterations are divided between the coarse pass over the whole and its blocks. Light to import.

The coarse pass takes those at the first size, whole photos; blocks go on from there with the finer sizes, window by
window. Where photos have one size only, the coarse pass takes a part of its iterations, and the blocks go on with the
rest.
"""

from __future__ import annotations

import math

from splatpipe.pipeline.train.lengths import Length, PhotoSizes, lengths_of
from splatpipe.pipeline.train.options import TrainConfig

COARSE_PART = 0.5  # of the iterations where there is one size only


def coarse_lengths(config: TrainConfig, footage: PhotoSizes) -> list[Length]:
    """Iterations of the coarse pass.

    Args:
        config: The training options.
        footage: All photos.
    """
    (first, count), *finer = lengths_of(config, footage)
    return [(first, count if finer else math.ceil(COARSE_PART * count))]


def finer_lengths(config: TrainConfig, footage: PhotoSizes) -> list[Length]:
    """Iterations of all that comes after the coarse pass, if no window were in two blocks, the first size first.

    Args:
        config: The training options.
        footage: All photos.
    """
    (first, count), *finer = lengths_of(config, footage)
    return finer or [(first, count - math.ceil(COARSE_PART * count))]
