"""Filling a time budget: the forecast cost of an iteration, and the plan that meets the time.

The forecast comes from real iterations on throw-away states (``measure``). It is used only before training: afterwards
the plan determines what every iteration computes, and the clock only after which iteration the training ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from splatpipe.pipeline.train.densify import room_at
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.lengths import PhotoSizes, lengths
from splatpipe.pipeline.train.plan.limits import MAX_ITERATIONS, MIN_ITERATIONS, worthwhile_iterations
from splatpipe.pipeline.train.plan.plan import footage_of
from splatpipe.pipeline.train.plan.schedule import Schedule, resolve_schedule
from splatpipe.pipeline.train.plan.start import started
from splatpipe.pipeline.train.plan.windows import TrainingSize

# None of the values up to COARSEST_MEGAPIXELS was tuned on held-out quality: they are judgement, for the given reasons.
SMALLEST_MEGAPIXELS = 0.1  # below it a photo of a building has too few pixels for its edges
SIZE_STEP = 1.5  # ratio of the sizes tried: fine enough to use the time, coarse enough for a short list
FULL_SHARE = 0.9  # size over the dataset's that is as good as all of it, so resampling is skipped

FIRST_GROWTH = 1.5  # times the sparse points' Gaussians must fit in every plan before it uses larger photos
MIN_GAUSSIANS = 1000  # fewer cannot represent a building; the initial ones are thinned no further
COARSEST_MEGAPIXELS = 0.05  # photos are halved no further at the start of a training

EXPORT_GAUSSIAN_S = 8e-6  # seconds to move, write twice and hash a Gaussian of the model
COST_GROWTH = 1.1  # times the cost in the pilot: Gaussians spread in training; 1.0 to 1.2 on three captures, CPU time
SAMPLES = 60  # points at which a forecast samples a training: its schedules are linear or stepped
SCHEDULE_SHARE = 0.95  # share of the time for the planned schedule; the rest continues at its final learning rates
MAX_EXTRA_ITERATIONS_FACTOR = 1.5  # times the planned iterations at most, if the forecast was too high


@dataclass(frozen=True)
class Timing:
    """A measured iteration.

    Attributes:
        gaussians: Number of Gaussians in the model.
        pixels: Number of pixels compared.
        seconds: Wall-clock time.
        share: These pixels as a share of the photo.
    """

    gaussians: int
    pixels: int
    seconds: float
    share: float = 1.0


@dataclass(frozen=True)
class Speed:
    """Cost model of an iteration: base + Gaussians + pixels + pairs, where a pixel's pairs grow with the Gaussians.

    Attributes:
        base_s: Fixed cost, seconds.
        gaussian_s: Seconds per Gaussian, visible or not.
        pixel_s: Seconds per pixel: loss, and the pairs present even with few Gaussians.
        pair_s: Seconds per Gaussian times pixel.
        seen_s: Seconds per Gaussian times the window's share of the photo: projection, optimizer.
    """

    base_s: float
    gaussian_s: float
    pixel_s: float
    pair_s: float
    seen_s: float = 0.0

    def seconds(self, gaussians: int, pixels: int | float, share: float = 1.0) -> float:
        """Seconds of an iteration."""
        alone = self.base_s + (self.gaussian_s + self.seen_s * share) * gaussians
        return alone + self.pixel_s * pixels + self.pair_s * gaussians * pixels


def fit_speed(timings: Sequence[Timing]) -> Speed:
    """The speed that explains the timings best (relative least squares), with no cost below zero.

    Raises:
        ValueError: if there are no timings, or one is zero.
    """
    if not timings or min(timing.seconds for timing in timings) <= 0.0:
        raise ValueError("a speed needs timings of more than zero seconds")
    table = np.array([_terms(timing) for timing in timings])
    seconds = np.array([timing.seconds for timing in timings])
    scale = table.max(axis=0)  # normalizes the columns
    weighted = table / scale / seconds[:, None]
    costs = nnls(weighted, np.ones(len(timings)))[0] / scale
    return Speed(*costs.tolist())


def _terms(timing: Timing) -> npt.NDArray[np.float64]:
    gaussians, pixels = timing.gaussians, timing.pixels
    return np.array([1.0, gaussians, pixels, gaussians * pixels, gaussians * timing.share])


def forecast(speed: Speed, schedule: Schedule, initial: int, footage: PhotoSizes) -> float:
    """Seconds that a training takes.

    Args:
        speed: Of this machine on this scene.
        schedule: Of the training.
        initial: Gaussians at the start.
        footage: The photos at their training sizes.
    """
    total, start = 0.0, 0
    for stretch in schedule.stretches:
        count = stretch.until - start
        steps = min(SAMPLES, count)
        pixels, share = footage.pixels(stretch.training_size), footage.share(stretch.training_size)
        middles = [start + int((step + 0.5) * count / steps) + 1 for step in range(steps)]
        each = [speed.seconds(room_at(schedule.density, initial, middle), pixels, share) for middle in middles]
        total += sum(each) * count / steps
        start = stretch.until
    return total


@dataclass(frozen=True)
class BudgetTask:
    """The planning problem.

    Attributes:
        config: The options; its ``max_gaussians`` is the largest cap that may be planned.
        sparse: Number of Gaussians from sparse points at the start, which every plan keeps if it can.
        dense: Number of Gaussians from dense points, which only fill the room left by a cap.
        sizes: Width, height and count of the photos in the dataset.
        window_pixels: Most pixels of a photo that an iteration uses; 0 for the whole photo.
        speed: Of this machine on this scene.
        prepare_s: Time to decode every photo once, whatever sizes are made of it.
        seconds: Time left for the training.
    """

    config: TrainConfig
    sparse: int
    dense: int
    sizes: tuple[tuple[int, int, int], ...]
    window_pixels: int
    speed: Speed
    prepare_s: float
    seconds: float

    @property
    def megapixels(self) -> float:
        """Largest training size of photos: their mean size in the dataset, or what the options allow."""
        whole = 1e-6 * footage_of(self.sizes, None, 0).pixels(TrainingSize())
        return min(whole, self.config.max_megapixels or whole)

    def footage(self, megapixels: float) -> PhotoSizes:
        """The photos at a size; the largest size is the one set by the options."""
        most = self.config.max_megapixels or None
        return footage_of(self.sizes, most if megapixels >= self.megapixels else megapixels, self.window_pixels)

    def left(self, cap: int) -> float:
        """Seconds left for training if as many Gaussians as the cap allows are exported."""
        return self.seconds - EXPORT_GAUSSIAN_S * cap

    def takes(self, options: TrainConfig, megapixels: float) -> float:
        """Forecast time of a training, including the decoding of its photos, seconds."""
        initial, footage = started(self.sparse, self.dense, options.max_gaussians), self.footage(megapixels)
        return self.prepare_s + COST_GROWTH * forecast(self.speed, resolve_schedule(options, footage), initial, footage)


@dataclass(frozen=True)
class BudgetChoice:
    """The plan that meets the time.

    Attributes:
        options: The options with iterations, cap, photo size and initial halvings set.
        iterations: The iterations as a number.
        seconds: Time after which the training ends, done or not.
        forecast_s: Forecast time of the schedule.
        is_most: Whether neither larger photos nor more Gaussians are available.
    """

    options: TrainConfig
    iterations: int
    seconds: float
    forecast_s: float
    is_most: bool

    @property
    def last_iteration(self) -> int:
        """Maximum iterations: beyond the schedule until the time is up, unless the schedule has ``MAX_ITERATIONS``."""
        return (
            self.iterations if self.iterations >= MAX_ITERATIONS else int(MAX_EXTRA_ITERATIONS_FACTOR * self.iterations)
        )


def choose(task: BudgetTask) -> BudgetChoice:
    """Divide the time between photo size, iterations and Gaussians.

    Photos grow to the dataset's size first, as long as ``wanted_iterations`` and room for the first growth fit: a size
    whose parts would be seen too seldom loses to the next smaller one. Then the cap grows; the remaining time goes into
    iterations, up to ``MAX_ITERATIONS``. Only if everything is at its maximum may a flat loss end the training early;
    otherwise it ends a photo size, and larger photos come earlier.
    """
    most = task.config.max_gaussians
    first = min(most, max(MIN_GAUSSIANS, int(FIRST_GROWTH * task.sparse)))
    size, cap = SMALLEST_MEGAPIXELS, first
    for size in reversed(sizes(task.megapixels)):
        if _fits(task, size, first, wanted_iterations(task, size)):
            break
    iterations = wanted_iterations(task, size)
    if _fits(task, size, first, iterations):
        cap = first
        if size >= task.megapixels:
            cap = _largest(first, most, lambda gaussians: _fits(task, size, gaussians, iterations))
    else:  # too little time for even that: fewer iterations, then fewer Gaussians
        least = min(first, MIN_GAUSSIANS)
        cap = _largest(least, first, lambda gaussians: _fits(task, size, gaussians, MIN_ITERATIONS))
    iterations = _largest(MIN_ITERATIONS, max(MAX_ITERATIONS, iterations), lambda count: _fits(task, size, cap, count))
    options = planned_options(task, size, cap, iterations)
    is_most = size >= task.megapixels and cap >= most
    return BudgetChoice(options, iterations, task.left(cap), task.takes(options, size), is_most)


def sizes(megapixels: float) -> list[float]:
    """Candidate photo sizes, megapixels, smallest first; the last one is the given maximum."""
    ladder = []
    size = SMALLEST_MEGAPIXELS
    while size < FULL_SHARE * megapixels:
        ladder.append(round(size, 4))
        size *= SIZE_STEP
    return [*ladder, megapixels]


def wanted_iterations(task: BudgetTask, megapixels: float) -> int:
    """Iterations that take priority over larger photos and more Gaussians: every part is seen often enough."""
    least = worthwhile_iterations(task.seconds)
    return sum(count for _level, count in lengths(task.footage(megapixels), least))


def planned_options(task: BudgetTask, megapixels: float, cap: int, iterations: int) -> TrainConfig:
    """The options of a planned training."""
    config, first = task.config, megapixels / 4.0 ** task.footage(megapixels).first_level
    halvings = int(max(0.0, math.log(first / COARSEST_MEGAPIXELS, 4)))
    planned = {
        "iterations": iterations,
        "least_iterations": worthwhile_iterations(task.seconds),
        "max_megapixels": config.max_megapixels if megapixels >= task.megapixels else megapixels,
        "max_gaussians": cap,
        "coarse_levels": max(config.coarse_levels, min(2, halvings)),
    }
    return config.model_copy(update=planned)


def _fits(task: BudgetTask, megapixels: float, cap: int, iterations: int) -> bool:
    options = planned_options(task, megapixels, cap, iterations)
    return task.takes(options, megapixels) <= SCHEDULE_SHARE * task.left(cap)


def _largest(least: int, most: int, fits: Callable[[int], bool]) -> int:
    """The largest count from ``least`` to ``most`` that fits, to 0.1 %; ``least`` if none does."""
    if most <= least or not fits(least):
        return least
    if fits(most):
        return most
    while most - least > max(1, least // 1000):
        middle = (least + most) // 2
        least, most = (middle, most) if fits(middle) else (least, middle)
    return least
