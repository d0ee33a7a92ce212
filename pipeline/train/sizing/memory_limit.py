"""``--max-memory`` as the windows and the cap on Gaussians of a training."""

from __future__ import annotations

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.heap import return_free_heap
from splatpipe.pipeline.engine.machine import resident_bytes
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.train.plan.budget import MIN_GAUSSIANS
from splatpipe.pipeline.train.plan.limits import (
    FIXED_BYTES,
    PIXEL_BYTES,
    bytes_per_gaussian,
    device_bytes_per_gaussian,
    window_within,
)
from splatpipe.pipeline.train.plan.plan import TrainingPlan

RESIDENT_STEP = 16_000_000  # resident memory is rounded up to it: a few pages more or less change no plan


def within_memory(plan: TrainingPlan, sparse: int, report: Reporter, on_cuda: bool = False) -> TrainingPlan:
    """The plan with windows and a cap on Gaussians that keep the process, or a device's tensors, within the limit.

    Args:
        plan: The plan without the limit, which is ``max_memory_bytes`` of its options.
        sparse: Number of initial Gaussians from sparse points; dense ones are dropped first, without a warning.
        report: Receives a warning if those from sparse points have to be thinned.
        on_cuda: Whether the training's tensors are on a CUDA device.

    Raises:
        MachineError: if not even the minimum fits beside what the process already uses.
    """
    return_free_heap()
    limit, taken = plan.options.max_memory_bytes, -(-resident_bytes() // RESIDENT_STEP) * RESIDENT_STEP
    of_one = bytes_per_gaussian(plan.options.sh_degree)
    if on_cuda:
        taken, of_one = 0, device_bytes_per_gaussian(plan.options.sh_degree)
    room = limit - taken - FIXED_BYTES
    plan = plan.within_windows(window_within(room, plan.window_pixels))
    pixels = max(plan.footage.largest(stretch.training_size) for stretch in plan.schedule.stretches)
    most = (room - PIXEL_BYTES * pixels) // of_one
    if most < min(MIN_GAUSSIANS, sparse):
        least = limit - room + PIXEL_BYTES * pixels + MIN_GAUSSIANS * of_one
        raise MachineError(
            f"Training cannot keep to {limit / 1e9:.2f} GB: the process takes {taken / 1e9:.2f} GB already, "
            f"and {pixels / 1e6:.2f} megapixels of a photo need memory as well.",
            hint=f"Give --max-memory at least {least / 1e6 + 1:.0f}M.",
        )
    if most < sparse:
        report.warning(
            f"{limit / 1e9:.2f} GB hold {most:,} Gaussians, fewer than the {sparse:,} sparse points: "
            "every part of the scene is thinned evenly.",
            hint="For a finer model, give more with --max-memory.",
        )
    cap = min(plan.options.max_gaussians, int(most))
    return plan.of(plan.options.model_copy(update={"max_gaussians": cap}))
