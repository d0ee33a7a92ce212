"""Whether a growing model still fits: in a device's free memory, and in the process's memory limit."""

from __future__ import annotations

from splatpipe.pipeline.engine.heap import return_free_heap
from splatpipe.pipeline.engine.machine import resident_bytes
from splatpipe.pipeline.raster.device import free_bytes
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.limits import (
    DEVICE_PASSING_BYTES,
    device_bytes_per_gaussian,
    device_frozen_passing_bytes,
)

# share of the limit in use at rest, after density control: above it the next step may exceed it
MAX_GROWTH_MEMORY_SHARE = 0.97


def within_room(wanted: int, gaussians: Gaussians, frozen: int = 0) -> int:
    """Number of Gaussians, at most ``wanted``, that fit in the free memory of their device; ``wanted`` on the CPU.

    If it is fewer, growth ends for the rest of the training and its checkpoints, and that is reported.

    Args:
        wanted: Number of trained Gaussians.
        gaussians: The trained Gaussians now.
        frozen: Number of those rendered around them.
    """
    free, count = free_bytes(gaussians.means.device), len(gaussians)
    if free is None:
        return wanted
    # All of them already have what they hold between two iterations.
    passing = DEVICE_PASSING_BYTES * count + device_frozen_passing_bytes(gaussians.sh_degree) * frozen
    more = (free - passing) // device_bytes_per_gaussian(gaussians.sh_degree)
    return min(wanted, count + max(0, int(more)))


def over_memory(options: TrainConfig) -> bool:
    """Whether the process is about to exceed its limit; checked after every step of density control.

    The plan's cap should prevent that. If it happens, growth ends for the rest of the training and its checkpoints, and
    that is reported: besides the deadline this is the only thing that a machine may change in a planned training.
    """
    limit = options.max_memory_bytes
    if limit == 0 or resident_bytes() <= MAX_GROWTH_MEMORY_SHARE * limit:
        return False
    return_free_heap()
    return resident_bytes() > MAX_GROWTH_MEMORY_SHARE * limit
