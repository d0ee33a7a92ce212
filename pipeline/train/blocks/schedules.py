"""How the iterations of a training are divided among the coarse pass and the blocks.

The coarse pass takes those at the first size, with whole photos. A block continues with the finer sizes, window by
window, with as many visits to each of its windows as without blocks. If there is only one size, the coarse pass takes
part of its iterations and the blocks continue at the same size with the rest.

The coarse pass ends with a low rate of positions, because its model is rendered. A block raises it to that of a whole
training that has the same share of its Gaussians: new Gaussians have to find their position too, and one of many
blocks begins with few.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from splatpipe.pipeline.train.blocks.lengths import coarse_lengths, finer_lengths
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.lengths import Length, PhotoSizes, lengths_of
from splatpipe.pipeline.train.plan.rates import Rates
from splatpipe.pipeline.train.plan.schedule import Schedule, schedule_of


def block_lengths(config: TrainConfig, footage: PhotoSizes, parts: Mapping[int, int]) -> list[Length]:
    """Iterations of a block, first size first; sizes without windows are left out.

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
    """The schedule of the coarse pass.

    Args:
        config: The training options.
        footage: All photos.
    """
    return schedule_of(config, footage, coarse_lengths(config, footage))


def block_schedule(
    config: TrainConfig, footage: PhotoSizes, seen: PhotoSizes, parts: Mapping[int, int], begun: float
) -> Schedule:
    """The schedule of a block.

    Args:
        config: The training options.
        footage: All photos.
        seen: The photos of the block.
        parts: The block's windows at each level.
        begun: Share of its Gaussians that it begins with, 0..1.
    """
    made = schedule_of(config.model_copy(update={"coarse_levels": 0}), seen, block_lengths(config, footage, parts))
    density = replace(made.density, first=made.density.every, reset_every=0)
    dropout = coarse_schedule(config, footage).dropout  # a block has few photos even if the site has many
    rates = _begun(made.rates, share_at(config, footage, begun))
    return replace(made, sh_every=1, dropout=dropout, density=density, rates=rates)


def share_at(config: TrainConfig, footage: PhotoSizes, begun: float) -> float:
    """Share of the schedule that a whole training has done when it has a given share of its Gaussians.

    This is the inverse of ``densify.room_at`` for a training that begins with hardly any; at most what is done when
    blocks begin.

    Args:
        config: The training options.
        footage: All photos.
        begun: The share of its Gaussians, 0..1.
    """
    done, left = (sum(n for _, n in each(config, footage)) for each in (coarse_lengths, finer_lengths))
    growth = schedule_of(config, footage, lengths_of(config, footage)).density
    steps = 1.0 - math.sqrt(1.0 - min(1.0, max(0.0, begun)))
    iteration = growth.first + steps * max(0, growth.last - growth.first)
    return min(iteration, done) / (done + left)


def _begun(rates: Rates, share: float) -> Rates:
    """Rates that begin at their values at a share of the schedule."""
    return replace(rates, means=rates.means_at(share) / rates.boost)
