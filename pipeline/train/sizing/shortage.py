"""When an iteration does not fit in a device's memory: smaller chunks, then fewer Gaussians, always with a warning.

Before its step an iteration changes nothing that cannot be undone, and its peak of memory comes before the step, so it
can be restarted with less. Growth that does not fit is not such a case: it is foreseen (see ``memory.within_room``).
"""

from __future__ import annotations

import weakref

import torch

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, kernels_of
from splatpipe.pipeline.train.iteration import iterate
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.budget import MIN_GAUSSIANS
from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.state.state import TrainState

KEPT_SHARE = 0.9  # share of the Gaussians kept each time, the most opaque: those lost are the least visible
HINT = "Lower train.max_megapixels or train.max_gaussians, or close other programs that use the graphics card."


def iterate_within_memory(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto, report: Reporter) -> None:
    """Run an iteration, restarting it with less if the device's memory is too small.

    Args:
        state: As for ``iteration.iterate``.
        plan: The training plan.
        photo: The photo to train on.
        report: Receives warnings about what was reduced.

    Raises:
        MachineError: if there is nothing left to reduce.
    """
    kernels, now = kernels_of(state.gaussians.means.device), state.iteration + 1
    pairs = 0 if kernels is None else kernels.forecast.most_pairs
    while not _fits(state, plan, photo):
        # Not inside the except block: the error keeps the iteration's tensors alive.
        state.roll_back()
        if state.gaussians.means.device.type == "cuda":
            torch.cuda.empty_cache()  # torch's cached blocks may be too fragmented for the next request
        _reduce_memory(state, kernels, report)
    if kernels is not None and kernels.forecast.most_pairs < pairs:  # once, however often they were halved
        report.warning(
            f"The graphics card's memory is short in iteration {now:,}: each picture is processed in smaller parts, "
            "which is slower and gives the same result.",
            hint=HINT,
        )


def _fits(state: TrainState, plan: TrainingPlan, photo: TrainingPhoto) -> bool:
    steps, count = state.adam.step_count, len(state.gaussians)
    model = weakref.ref(state.gaussians)  # weak, because density control needs the old model's memory
    try:
        iterate(state, plan, photo)
    except torch.OutOfMemoryError as error:
        if state.adam.step_count == steps and state.gaussians is model():
            return False
        raise MachineError(f"The graphics card's memory does not hold {count:,} Gaussians.", hint=HINT) from error
    return True


def _reduce_memory(state: TrainState, kernels: CudaKernels | None, report: Reporter) -> None:
    """Reduce the next thing: chunks of pairs first, then the model."""
    count, now = len(state.gaussians), state.iteration + 1
    if kernels is not None and kernels.forecast.shrink():
        return
    fewer = max(int(KEPT_SHARE * count), MIN_GAUSSIANS)
    if fewer >= count:
        raise MachineError(f"The graphics card's memory does not hold even {count:,} Gaussians.", hint=HINT)
    state.history.growth_ended = state.history.growth_ended or max(1, state.iteration)
    try:
        state.keep_most_opaque(fewer)
    except torch.OutOfMemoryError as error:  # the model may be half the old one
        raise MachineError(f"The graphics card's memory does not hold even {fewer:,} Gaussians.", hint=HINT) from error
    report.warning(
        f"The graphics card's memory does not hold {count:,} Gaussians: training continues with the "
        f"{fewer:,} most opaque, and adds none from iteration {now:,} on.",
        hint=HINT,
    )
