"""How many Gaussians fit into a memory limit, and whether the process keeps to it.

| of a Gaussian with SH of degree 3 (59 numbers, float32) | bytes |
|---|---|
| parameters | 236 |
| their gradients | 236 |
| Adam's two moments | 472 |
| statistics of density control | 12 |
| **state of training** | **956** |
| while density control copies parameters and moments, and the model is written | 860 |

On a CUDA device gradients are never stored, and density control moves one tensor at a time:

| of the same Gaussian on a CUDA device | bytes |
|---|---|
| parameters and moments | 708 |
| statistics of density control | 12 |
| **state of training** | **720** |
| a frame with its pairs in the smallest chunks (see `frame.h`), radii, gradients on the screen | 201 |
| or, later, density control: a copy of the harmonics, places, scores, an index and its sort | 320 |
"""

from __future__ import annotations

import contextlib
import ctypes
from pathlib import Path

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.raster.device import free_bytes
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.sh import coefficient_count
from splatpipe.pipeline.train.budget import FEWEST_GAUSSIANS
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan import Plan

FLOAT_BYTES = 4
SHAPE_NUMBERS = 11  # of a Gaussian besides its colour: position, scales, rotation, opacity
STATE_COPIES = 4  # a parameter has a gradient and two moments
STATISTICS_BYTES = 12
PEAK_SHARE = 0.9  # of the state: what density control and the writer copy of it, with the allocator's waste
PIXEL_BYTES = 300  # of the largest photo: decoded thrice ahead, rendered, compared, each with its gradient
DEVICE_COPIES = 3  # a parameter has two moments there
DEVICE_PASSING_BYTES = 320  # the larger of what a frame and density control take
FIXED_BYTES = 120_000_000  # buffers of the kernels, of torch and of decoders, whatever the size
RESIDENT_STEP = 16_000_000  # what the process has is rounded up to it: a few pages more or less change no plan
GROWTH_STOPS_AT = 0.97  # of the limit: more at rest after a step of density control was no surprise in the next one


def bytes_per_gaussian(options: TrainConfig) -> int:
    """Most that a Gaussian takes at any time of a training on the CPU."""
    numbers = SHAPE_NUMBERS + 3 * coefficient_count(options.sh_degree)
    state = STATE_COPIES * FLOAT_BYTES * numbers + STATISTICS_BYTES
    return int(state * (1.0 + PEAK_SHARE))


def device_bytes_per_gaussian(sh_degree: int) -> int:
    """The same on a CUDA device."""
    numbers = SHAPE_NUMBERS + 3 * coefficient_count(sh_degree)
    return DEVICE_COPIES * FLOAT_BYTES * numbers + STATISTICS_BYTES + DEVICE_PASSING_BYTES


def within_memory(plan: Plan, largest_pixels: int, sparse: int, report: Reporter, on_cuda: bool = False) -> Plan:
    """The plan with a cap on Gaussians that keeps the process, or a device's tensors, within ``max_memory_bytes``.

    Args:
        plan: Without it.
        largest_pixels: Of a training photo.
        sparse: Gaussians of sparse points at the start; the sweep's go before they do, and nobody misses those.
        report: Is told where those of sparse points have to be thinned.
        on_cuda: The training's tensors are a CUDA device's.

    Raises:
        MachineError: if not even the fewest fit beside what the process has already.
    """
    return_free_heap()
    limit, taken = plan.options.max_memory_bytes, -(-resident_bytes() // RESIDENT_STEP) * RESIDENT_STEP
    of_one = bytes_per_gaussian(plan.options)
    if on_cuda:
        taken, of_one = 0, device_bytes_per_gaussian(plan.options.sh_degree)
    room = limit - taken - FIXED_BYTES - PIXEL_BYTES * largest_pixels
    most = room // of_one
    if most < min(FEWEST_GAUSSIANS, sparse):
        least = limit - room + FEWEST_GAUSSIANS * of_one
        raise MachineError(
            f"Training cannot keep to {limit / 1e9:.2f} GB: the process takes {taken / 1e9:.2f} GB of them already, "
            f"and photos of {largest_pixels / 1e6:.1f} megapixels need room, too.",
            hint=f"Give --max-memory at least {least / 1e6 + 1:.0f}M, or lower undistort.max_megapixels.",
        )
    if most < sparse:
        report.warning(
            f"{limit / 1e9:.2f} GB hold {most:,} Gaussians, fewer than the {sparse:,} sparse points: "
            "every part of the scene is thinned evenly.",
            hint="Give more with --max-memory for a finer model.",
        )
    cap = min(plan.options.max_gaussians, int(most))
    return plan.of(plan.options.model_copy(update={"max_gaussians": cap}))


def within_room(wanted: int, gaussians: Gaussians) -> int:
    """The most Gaussians, up to those wanted, that the free memory of their device holds; all of them on the CPU.

    Where it is fewer, growth ends for the rest of the training and its checkpoints, and that is told.
    """
    free, count = free_bytes(gaussians.means.device), len(gaussians)
    if free is None:
        return wanted
    passing = DEVICE_PASSING_BYTES * count  # those that are there have their state already
    more = (free - passing) // device_bytes_per_gaussian(gaussians.sh_degree)
    return min(wanted, count + max(0, int(more)))


def over_memory(options: TrainConfig) -> bool:
    """Whether the process is about to pass its limit: asked after every step of density control.

    The plan's cap should never let it come to that. Where it does, growth ends for the rest of the training and its
    checkpoints: besides the deadline the one thing that a machine may change in a planned training, and it is told.
    """
    limit = options.max_memory_bytes
    if limit == 0 or resident_bytes() <= GROWTH_STOPS_AT * limit:
        return False
    return_free_heap()
    return resident_bytes() > GROWTH_STOPS_AT * limit


def return_free_heap() -> None:
    """Give back what the stages before have freed: glibc keeps it for the process."""
    with contextlib.suppress(OSError, AttributeError):  # another libc
        ctypes.CDLL(None).malloc_trim(0)


def resident_bytes() -> int:
    """Memory of this process now, bytes; 0 where the system does not say."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) * 1024
    except (OSError, StopIteration, ValueError):
        return 0
