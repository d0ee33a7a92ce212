"""How the iterations of a training are divided among the coarse pass and the blocks.

The coarse pass takes those at the first size, whole photos. A block goes on from there with the finer sizes, window by
window: as many visits of each of its windows as without blocks. Where photos have one size only, the coarse pass takes
a part of its iterations, and the blocks go on at the same size with the rest. Rates go on where they would be by then;
that of positions has to rise for it, for the coarse pass has run down its own: it is a model that is drawn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from splatpipe.pipeline.train.blocks.lengths import coarse_lengths, finer_lengths
from splatpipe.pipeline.train.lengths import Footage, Length
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.rates import Rates
from splatpipe.pipeline.train.schedule import Schedule, schedule_of


def block_lengths(config: TrainConfig, footage: Footage, parts: Mapping[int, int]) -> list[Length]:
    """Iterations of a block, the first size first; a size at which it sees nothing is left out.

    Args:
        config: The options.
        footage: All photos.
        parts: The block's windows at each level.
    """
    return [
        (level, max(1, math.ceil(count * parts[level] / footage.parts(level))))
        for level, count in finer_lengths(config, footage)
        if parts.get(level, 0)
    ]


def coarse_schedule(config: TrainConfig, footage: Footage) -> Schedule:
    """That of the coarse pass.

    Args:
        config: The options.
        footage: All photos.
    """
    return schedule_of(config, footage, coarse_lengths(config, footage))


def block_schedule(config: TrainConfig, footage: Footage, seen: Footage, parts: Mapping[int, int]) -> Schedule:
    """That of a block.

    Args:
        config: The options.
        footage: All photos.
        seen: Those that the block sees.
        parts: The block's windows at each level.
    """
    made = schedule_of(config.model_copy(update={"coarse_levels": 0}), seen, block_lengths(config, footage, parts))
    done, left = (sum(n for _, n in each(config, footage)) for each in (coarse_lengths, finer_lengths))
    density = replace(made.density, first=made.density.every, reset_every=0)
    dropout = coarse_schedule(config, footage).dropout  # a block sees few photos where the site has many
    return replace(made, sh_every=1, dropout=dropout, density=density, rates=_begun(made.rates, done / (done + left)))


def _begun(rates: Rates, share: float) -> Rates:
    """Rates that begin as they are at a share of the schedule."""
    return replace(rates, means=rates.means_at(share) / rates.boost)
