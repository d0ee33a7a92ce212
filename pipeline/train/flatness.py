"""Early end: where the loss on the training photos is flat, larger photos come at once, or the schedule is run down.

A size is flat where training on with it, for all iterations that are left, would take too little off its loss.
Epochs are compared, in which every photo counts once with all of its windows, by a straight line through the logarithms
of their mean losses over the logarithm of the iteration. Such a power law has no unit, and it foretells too much gain
rather than too little, for a real curve bends towards its floor: on four captures it was 1.5 to 2 times what came.
Learning rates that have not fallen yet hide a part of the gain, so the end is not abrupt: the schedule's remainder is
compressed into a short tail. Only losses and iterations have a say, no clock and no held-out photo.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from splatpipe.pipeline.train.history import History
from splatpipe.pipeline.train.plan import TrainingPlan
from splatpipe.pipeline.train.schedule import Schedule, tail_of

WINDOW_SHARE = 0.25  # of the iterations done: what the line is drawn through
FEWEST_EPOCHS = 8  # in it, so that their scatter is known
STANDARD_ERRORS = 2.0  # the line is taken so much steeper: noise does not end a training that still gains


def settled_from(schedule: Schedule) -> int:
    """Iteration after which only the rates change: all Gaussians, all degrees and the photos' finest size are there.

    Args:
        schedule: The training schedule.
    """
    density = schedule.density.last if schedule.density.on else 0
    return max(density, schedule.finest_from, schedule.sh_degree * schedule.sh_every)


def judged_from(schedule: Schedule, iteration: int, resets: Sequence[int]) -> int:
    """Iteration since which losses tell whether the size that is trained on at one has more to give.

    Before the finest size growth has to have begun only: what it adds later, it adds to larger photos as well.

    Args:
        schedule: The training schedule.
        iteration: The current iteration.
        resets: Iterations after which opacities were reset.
    """
    number = schedule.stretch_at(iteration)
    if number == len(schedule.stretches) - 1:
        return settled_from(schedule)
    begun = schedule.stretches[number - 1].until if number else 0
    grown = schedule.density.first if schedule.density.on else 0
    return max(begun, grown, *resets[-1:])


def expected_gain(epochs: Sequence[tuple[int, float]], last: int) -> float:
    """Share of the loss that training on would take off it, rather too large than too small.

    Args:
        epochs: Middle iteration and mean loss of each, in order; at least three.
        last: Iteration until which it would go on.

    Returns:
        At most 1; below 0 where the loss rises. 1 where a loss is not above 0, so nothing can be said.
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
    """Whether `stop_when_flat` ends the size that is trained on here, or the training after a tail that begins here.

    Args:
        epochs: Middle iteration and mean loss of all since ``judged_from``.
        plan: The training plan.
        iteration: Now, the last one of an epoch.
    """
    scheduled = plan.schedule.iterations
    recent = [epoch for epoch in epochs if epoch[0] > (1.0 - WINDOW_SHARE) * iteration]
    recent = list(epochs[-max(FEWEST_EPOCHS, len(recent)) :])
    number = plan.schedule.stretch_at(iteration)
    is_finest = number == len(plan.schedule.stretches) - 1
    end = iteration + tail_of(iteration) if is_finest else iteration
    if len(recent) < FEWEST_EPOCHS or end >= plan.schedule.stretches[number].until:
        return False
    return expected_gain(recent, scheduled) < plan.options.stop_when_flat


def end_epoch(history: History, plan: TrainingPlan, iteration: int, length: int) -> None:
    """Close an epoch, and note where its loss ends a size or begins the training's tail.

    Args:
        history: Changed in place.
        plan: The current training plan.
        iteration: The last one of an epoch.
        length: Iterations that the epoch has.
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
    """The last iteration.

    Args:
        plan: The training plan.
        flat_at: Iteration after which the tail began; 0 where it did not.
    """
    return min(plan.last_iteration, flat_at + tail_of(flat_at)) if flat_at else plan.last_iteration
