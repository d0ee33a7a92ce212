"""Early stopping: once the training loss is flat, switch to larger photos, or end with a short tail of the schedule.

A size is flat if training with it for all remaining iterations would reduce its loss too little. The forecast is a
straight line through the logarithm of the epochs' mean losses over the logarithm of the iteration; an epoch has every
photo once with all of its windows. Such a power law has no unit, and it overestimates rather than underestimates the
gain, because a real curve bends towards its floor: on four captures it was 1.5 to 2 times the actual gain. Learning
rates that have not fallen yet hide part of the gain, so the end is not abrupt: the rest of the schedule is compressed
into a short tail. Only losses and iterations decide, not the clock or held-out views.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from splatpipe.pipeline.train.plan.plan import TrainingPlan
from splatpipe.pipeline.train.plan.schedule import Schedule, tail_of
from splatpipe.pipeline.train.state.history import History

WINDOW_SHARE = 0.25  # last share of the iterations done, to which the line is fitted
MIN_EPOCHS = 8  # epochs in the window, so that their scatter can be estimated
# standard errors by which the line is made steeper: noise must not end a training that still improves
STANDARD_ERRORS = 2.0


def final_phase_from(schedule: Schedule) -> int:
    """Iteration after which only the rates change: Gaussians, SH degree and photo size have reached their final state.

    Args:
        schedule: The training schedule.
    """
    density = schedule.density.last if schedule.density.on else 0
    return max(density, schedule.finest_from, schedule.sh_degree * schedule.sh_every)


def judged_from(schedule: Schedule, iteration: int, resets: Sequence[int]) -> int:
    """Iteration from which losses show whether the current photo size can still improve.

    Before the finest size, growth only has to have begun: Gaussians added later also serve larger photos.

    Args:
        schedule: The training schedule.
        iteration: The current iteration.
        resets: Iterations after which opacities were reset.
    """
    number = schedule.stretch_at(iteration)
    if number == len(schedule.stretches) - 1:
        return final_phase_from(schedule)
    begun = schedule.stretches[number - 1].until if number else 0
    grown = schedule.density.first if schedule.density.on else 0
    return max(begun, grown, *resets[-1:])


def expected_gain(epochs: Sequence[tuple[int, float]], last: int) -> float:
    """Share of the loss that further training would remove; an overestimate rather than an underestimate.

    Args:
        epochs: Middle iteration and mean loss of each epoch, in order; at least three.
        last: Iteration to forecast to.

    Returns:
        At most 1; below 0 if the loss rises. 1 if a loss is not positive, so that no forecast is possible.
    """
    losses = np.array([loss for _, loss in epochs])
    if not (losses > 0.0).all():
        return 1.0
    x, y = np.log([middle for middle, _ in epochs]), np.log(losses)
    x -= x.mean()
    slope = float((x * y).sum() / (x * x).sum())
    scatter = float(np.square(y - y.mean() - slope * x).sum()) / (len(x) - 2)
    slope -= STANDARD_ERRORS * math.sqrt(scatter / float((x * x).sum()))
    return 1.0 - math.exp(slope * math.log(last / epochs[-1][0]))


def is_flat(epochs: Sequence[tuple[int, float]], plan: TrainingPlan, iteration: int) -> bool:
    """Whether `stop_when_flat` ends the current photo size here, or starts the training's final tail.

    Args:
        epochs: Middle iteration and mean loss of all epochs since ``judged_from``.
        plan: The training plan.
        iteration: The current iteration, the last one of an epoch.
    """
    scheduled = plan.schedule.iterations
    recent = [epoch for epoch in epochs if epoch[0] > (1.0 - WINDOW_SHARE) * iteration]
    recent = list(epochs[-max(MIN_EPOCHS, len(recent)) :])
    number = plan.schedule.stretch_at(iteration)
    is_finest = number == len(plan.schedule.stretches) - 1
    end = iteration + tail_of(iteration) if is_finest else iteration
    if len(recent) < MIN_EPOCHS or end >= plan.schedule.stretches[number].until:
        return False
    return expected_gain(recent, scheduled) < plan.options.stop_when_flat


def end_epoch(history: History, plan: TrainingPlan, iteration: int, length: int) -> None:
    """Close an epoch, and record if its loss ends a photo size or begins the training's tail.

    Args:
        history: Changed in place.
        plan: The current training plan.
        iteration: The last one of an epoch.
        length: Number of iterations in the epoch.
    """
    since = judged_from(plan.schedule, iteration, history.resets)
    history.end_epoch(iteration - length // 2, iteration - length >= since)
    if history.flat_at or not is_flat([each for each in history.epochs if each[0] > since], plan, iteration):
        return
    if plan.schedule.stretch_at(iteration) < len(plan.schedule.stretches) - 1:
        history.sizes_ended.append(iteration)
    elif plan.ends_when_flat:
        history.flat_at = iteration


def ends_at(plan: TrainingPlan, flat_at: int) -> int:
    """The last iteration of the training.

    Args:
        plan: The training plan.
        flat_at: Iteration after which the tail began; 0 if it has not.
    """
    return min(plan.last_iteration, flat_at + tail_of(flat_at)) if flat_at else plan.last_iteration
