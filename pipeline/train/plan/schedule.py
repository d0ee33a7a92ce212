"""The training schedule: what changes at which iteration, resolved once from options and photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from splatpipe.pipeline.train.densify import PRUNE_SCREEN_PX, DensitySchedule
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.lengths import (
    UNTIL,
    IterationScale,
    Length,
    PhotoSizes,
    Stretch,
    growth_until,
    lengths_of,
    stretches,
)
from splatpipe.pipeline.train.plan.rates import PUBLISHED, Rates, rates_of
from splatpipe.pipeline.train.plan.windows import TrainingSize
from splatpipe.pipeline.train.random_numbers import BACKGROUND, uniform

FEW_PHOTOS, MANY_PHOTOS = 16, 32  # training photos: overfitting to single photos up to the first, none from the second
FEW_DROPOUT = 0.2
RESET_EVERY = 3000  # iterations, published: opacities need them to recover from a reset
GRADIENT = 1.2e-3  # image-plane magnitudes (NDC) above which Gaussians are densified
PUBLISHED_GRADIENT = 2e-4  # norm of the signed sum of image-plane gradients (NDC) above which Gaussians are densified
BUDGET_SHARE = 0.5  # factor on the threshold under a time budget: Gaussians follow the forecast, but not into noise
RESET_VISITS = 15  # visits to every photo between resets, at least: what RESET_EVERY is on the published captures
TAIL_SHARE = 0.1  # length of the tail after a flat loss, as a share of the iterations done by then

UNKNOWN = PhotoSizes(((1, 1, MANY_PHOTOS),))
"""Photos that fit into one window and are not few."""

RGB = tuple[float, float, float]
BACKGROUNDS: dict[str, RGB | None] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "random": None}


@dataclass(frozen=True)
class ScheduleStep:
    """The schedule's values for one iteration.

    Attributes:
        iteration: Its number, from 1.
        place: The schedule's iteration whose rates apply: it runs ahead in the tail after a flat loss.
        share: Fraction of the schedule done, 0..1.
        seed: Seed of all random numbers.
        sh_degree: SH degree being trained.
        background: Colour behind the Gaussians: red, green, blue.
        means_rate: Learning rate of positions, to be multiplied by the scene's extent.
        is_observed: Whether density control collects statistics.
    """

    iteration: int
    place: int
    share: float
    seed: int
    sh_degree: int
    background: RGB
    means_rate: float
    is_observed: bool

    def colour(self, stream: int) -> RGB:
        """A random colour for this iteration; ``stream`` as in ``draws``."""
        return random_colour(self.seed, self.iteration, stream)


@dataclass(frozen=True)
class Schedule:
    """What changes in the course of a training, and when.

    Attributes:
        iterations: Number of iterations until the rates reach their final values.
        seed: Seed of all random numbers.
        sh_degree: Degree of the spherical harmonics at the end.
        sh_every: Iterations between increments of the trained SH degree.
        stretches: Training sizes with their iteration ranges, in order; the last one also covers everything after it.
        dropout: Share of the Gaussians dropped at the end.
        background: Colour behind the Gaussians: red, green, blue; None for a random colour each iteration.
        rates: Learning rates.
        density: The density-control schedule.
    """

    iterations: int
    seed: int
    sh_degree: int
    sh_every: int
    stretches: tuple[Stretch, ...]
    dropout: float
    background: RGB | None
    rates: Rates
    density: DensitySchedule

    @staticmethod
    def from_json(fields: Mapping[str, Any]) -> Schedule:
        """Rebuild a schedule from ``dataclasses.asdict``'s values.

        Raises:
            KeyError, TypeError: if they are not those of a schedule.
        """
        parts = {"rates": Rates(**fields["rates"]), "density": DensitySchedule(**fields["density"])}
        parts |= {"stretches": tuple(Stretch(**each) for each in fields["stretches"])}
        behind = fields["background"]
        return Schedule(**{**fields, **parts, "background": None if behind is None else tuple(behind)})

    def at(self, iteration: int, flat_at: int = 0) -> ScheduleStep:
        """The schedule's values for an iteration.

        Args:
            iteration: Its number, from 1.
            flat_at: Iteration after which the tail of a flat training began; 0 if it has not.
        """
        place = self.place(iteration, flat_at)
        share = min(1.0, place / self.iterations)
        return ScheduleStep(
            iteration=iteration,
            place=place,
            share=share,
            seed=self.seed,
            sh_degree=self.sh_degree_at(iteration),
            background=self.background or random_colour(self.seed, iteration, BACKGROUND),
            means_rate=self.rates.means_at(share),
            is_observed=self.density.on and iteration <= self.density.last,
        )

    def place(self, iteration: int, flat_at: int) -> int:
        """The schedule's iteration whose rates apply: in the tail it runs ahead, up to the last one."""
        if flat_at == 0 or iteration <= flat_at:
            return iteration
        return flat_at + (iteration - flat_at) * (self.iterations - flat_at) // tail_of(flat_at)

    def sh_degree_at(self, iteration: int) -> int:
        """The degree trained at an iteration (from 1): one more every ``sh_every``."""
        return min(self.sh_degree, iteration // self.sh_every)

    def training_size_at(self, iteration: int) -> TrainingSize:
        """The training size of an iteration (from 1)."""
        return self.stretches[self.stretch_at(iteration)].training_size

    def stretch_at(self, iteration: int) -> int:
        """The index of the stretch that contains an iteration (from 1)."""
        untils = (number for number, each in enumerate(self.stretches) if iteration <= each.until)
        return next(untils, len(self.stretches) - 1)

    def without_rest(self, iteration: int, worth: float) -> Schedule:
        """The schedule with the next stretch starting after this iteration; the last one gets the time saved.

        Args:
            iteration: In any stretch but the last.
            worth: Number of iterations of the last stretch that cost as much as one of this stretch.
        """
        number = self.stretch_at(iteration)
        spared = self.stretches[number].until - iteration
        changed = [
            *self.stretches[:number],
            *(replace(each, until=each.until - spared) for each in self.stretches[number:]),
        ]
        total = self.iterations - spared + int(worth * spared)
        changed[-1] = replace(changed[-1], until=total)
        finest_from, resets = changed[-2].until, self.density.reset_until
        density = replace(
            self.density,
            last=max(1, finest_from + int(UNTIL * (total - finest_from))),
            reset_until=resets - spared if resets > iteration else resets,
        )
        return replace(self, iterations=total, stretches=tuple(changed), density=density)

    def training_sizes_until(self, last: int) -> list[TrainingSize]:
        """``training_size_at`` for every iteration from 1 to ``last``."""
        return [self.training_size_at(iteration) for iteration in range(1, last + 1)]

    @property
    def finest(self) -> TrainingSize:
        """The training size at the end."""
        return self.stretches[-1].training_size

    @property
    def finest_from(self) -> int:
        """The last iteration before those of the finest size."""
        return self.stretches[-2].until if len(self.stretches) > 1 else 0


def tail_of(flat_at: int) -> int:
    """Length of the tail after the loss became flat, iterations."""
    return max(1, round(TAIL_SHARE * flat_at))


def random_colour(seed: int, iteration: int, stream: int) -> RGB:
    """A random colour per iteration; ``stream`` as in ``draws``."""
    red, green, blue = uniform(seed, iteration, stream, [0, 1, 2]).tolist()
    return red, green, blue


def share_of_few(photos: int) -> float:
    """Weight of the few-photos settings: 1 up to FEW_PHOTOS, falling to 0 at MANY_PHOTOS."""
    return min(1.0, max(0.0, (MANY_PHOTOS - photos) / (MANY_PHOTOS - FEW_PHOTOS)))


def resolve_schedule(config: TrainConfig, footage: PhotoSizes = UNKNOWN) -> Schedule:
    """The published schedule, adapted to short runs and to few or many photos.

    Args:
        config: The training options.
        footage: The photos that are trained on.
    """
    return schedule_of(config, footage, lengths_of(config, footage))


def schedule_of(config: TrainConfig, footage: PhotoSizes, each: list[Length]) -> Schedule:
    """The same for given sizes and iterations.

    Args:
        config: The training options.
        footage: The photos that are trained on.
        each: Levels and their iterations, in training order.
    """
    scale = IterationScale.of(config, footage)
    few = FEW_DROPOUT * share_of_few(footage.photos)
    return Schedule(
        iterations=sum(count for _level, count in each),
        seed=config.seed,
        sh_degree=config.sh_degree,
        sh_every=scale.scaled_length(1000, 5),
        stretches=stretches(footage, each, config.coarse_levels),
        dropout=round(few, 4) if config.dropout == "auto" else config.dropout,
        background=BACKGROUNDS[config.background],
        rates=PUBLISHED if config.density == "published" else rates_of(scale.iterations),
        density=_density(config, each, scale),
    )


def _density(config: TrainConfig, each: list[Length], scale: IterationScale) -> DensitySchedule:
    published = config.density == "published"
    gradient = PUBLISHED_GRADIENT if published else GRADIENT
    return DensitySchedule(
        on=config.densify,
        seed=config.seed,
        cap=config.max_gaussians,
        first=scale.scaled_length(500, 5),
        last=max(1, growth_until(each)),
        every=scale.scaled_length(100, 10),
        gradient=gradient * (BUDGET_SHARE if config.time_budget_s else 1.0),
        reset_every=max(RESET_EVERY, RESET_VISITS * scale.photos) if published else 0,
        reset_until=each[0][1] if len(each) > 1 else 0,
        prune_screen_px=PRUNE_SCREEN_PX if published else 0.0,
        prune_free_space=config.prune_free_space,
    )
