"""How the iterations of a training are divided among the coarse pass and the blocks.

The coarse pass takes those at the first size, whole photos. A block goes on from there with the finer sizes, window by
window: as many visits of each of its windows as without blocks. Where photos have one size only, the coarse pass takes
a part of its iterations, and the blocks go on at the same size with the rest.

The rate of positions, which the coarse pass has run down, for it is a model that is drawn, rises to where it is in a
training of the whole that has as large a part of its Gaussians: what a block grows has to find its place, too, and one
of many blocks begins with few.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from splatpipe.pipeline.train.blocks.lengths import coarse_lengths, finer_lengths
from splatpipe.pipeline.train.lengths import Length, PhotoSizes, lengths_of
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.rates import Rates
from splatpipe.pipeline.train.schedule import Schedule, schedule_of


def block_lengths(config: TrainConfig, footage: PhotoSizes, parts: Mapping[int, int]) -> list[Length]:
    """Iterations of a block, the first size first; a size at which it sees nothing is left out.

    Args:
        config: The training options.
        footage: All photos.
        parts: The block's windows at each level.
    """
    return [
        (level, max(1, math.ceil(count * parts[level] / footage.parts(level))))
        for level, count in finer_lengths(config, footage)
        if parts.get(level, 0)
    ]


def coarse_schedule(config: TrainConfig, footage: PhotoSizes) -> Schedule:
    """That of the coarse pass.

    Args:
        config: The training options.
        footage: All photos.
    """
    return schedule_of(config, footage, coarse_lengths(config, footage))


def block_schedule(
    config: TrainConfig, footage: PhotoSizes, seen: PhotoSizes, parts: Mapping[int, int], begun: float
) -> Schedule:
    """That of a block.

    Args:
        config: The training options.
        footage: All photos.
        seen: Those that the block sees.
        parts: The block's windows at each level.
        begun: The part of its Gaussians that it begins with, 0..1.
    """
    made = schedule_of(config.model_copy(update={"coarse_levels": 0}), seen, block_lengths(config, footage, parts))
    density = replace(made.density, first=made.density.every, reset_every=0)
    dropout = coarse_schedule(config, footage).dropout  # a block sees few photos where the site has many
    rates = _begun(made.rates, share_at(config, footage, begun))
    return replace(made, sh_every=1, dropout=dropout, density=density, rates=rates)


def share_at(config: TrainConfig, footage: PhotoSizes, begun: float) -> float:
    """How much of its schedule a training of the whole has done when it has that part of its Gaussians.

    That is ``densify.room_at`` turned around, for a training that begins with hardly any; no more than is done when
    blocks begin.

    Args:
        config: The training options.
        footage: All photos.
        begun: The part, 0..1.
    """
    done, left = (sum(n for _, n in each(config, footage)) for each in (coarse_lengths, finer_lengths))
    growth = schedule_of(config, footage, lengths_of(config, footage)).density
    steps = 1.0 - math.sqrt(1.0 - min(1.0, max(0.0, begun)))
    iteration = growth.first + steps * max(0, growth.last - growth.first)
    return min(iteration, done) / (done + left)


def _begun(rates: Rates, share: float) -> Rates:
    """Rates that begin as they are at a share of the schedule."""
    return replace(rates, means=rates.means_at(share) / rates.boost)
