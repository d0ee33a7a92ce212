"""The schedule of a training: what is done from which iteration on, resolved once from options and photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from splatpipe.pipeline.train.densify import PRUNE_SCREEN_PX, DensitySchedule
from splatpipe.pipeline.train.draws import BACKGROUND, uniform
from splatpipe.pipeline.train.lengths import UNTIL, Length, PhotoSizes, Stretch, growth_until, lengths_of, stretches
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.rates import PUBLISHED, Rates, rates_of
from splatpipe.pipeline.train.windows import TrainingSize

FEW_PHOTOS, MANY_PHOTOS = 16, 32  # trained on: up to where a model leans on single photos, from where it does not
FEW_DROPOUT = 0.2
RESET_EVERY = 3000  # iterations, published: what is reset needs them to come back
GRADIENT = 1.2e-3  # image-plane magnitudes (NDC) above which Gaussians are densified
PUBLISHED_GRADIENT = 2e-4  # the same of the signed sum
BUDGET_SHARE = 0.5  # of the threshold under a time budget: Gaussians follow the forecast, but not into noise
RESET_VISITS = 15  # of every photo between two resets at least: the same, on the captures of that method
TAIL_SHARE = 0.1  # of the iterations done when the loss is flat: what the rest of the schedule is compressed into

UNKNOWN = PhotoSizes(((1, 1, MANY_PHOTOS),))
"""Photos that fit into a window and are neither few nor many."""

RGB = tuple[float, float, float]
BACKGROUNDS: dict[str, RGB | None] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "random": None}


@dataclass(frozen=True)
class ScheduleStep:
    """What the schedule says of one iteration.

    Attributes:
        iteration: Which, from 1.
        place: The iteration of the schedule whose rates it has: in the tail of a flat training it runs ahead.
        share: Of the schedule that is done, 0..1.
        seed: Of everything random.
        sh_degree: That is trained.
        background: What is behind the Gaussians, red, green, blue.
        means_rate: Learning rate of positions, times the scene's extent.
        is_observed: Whether density control looks on.
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
        """A random colour of the iteration's own; ``stream`` as in ``draws``."""
        return random_colour(self.seed, self.iteration, stream)


@dataclass(frozen=True)
class Schedule:
    """What changes in the course of a training, and when.

    Attributes:
        iterations: Until the rates' last values.
        seed: Of everything random.
        sh_degree: Degree of the spherical harmonics at the end.
        sh_every: Iterations until one degree more is trained.
        stretches: What iterations look at of their photos, in order; what comes after the last one is as it.
        dropout: Share of the Gaussians left out at the end.
        background: What is behind the Gaussians, red, green, blue; None for another colour each iteration.
        rates: Learning rates.
        density: Of density control.
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
        """Read ``dataclasses.asdict``'s values back.

        Raises:
            KeyError, TypeError: if they are no schedule's.
        """
        parts = {"rates": Rates(**fields["rates"]), "density": DensitySchedule(**fields["density"])}
        parts |= {"stretches": tuple(Stretch(**each) for each in fields["stretches"])}
        behind = fields["background"]
        return Schedule(**{**fields, **parts, "background": None if behind is None else tuple(behind)})

    def at(self, iteration: int, flat_at: int = 0) -> ScheduleStep:
        """What holds in an iteration.

        Args:
            iteration: From 1.
            flat_at: Iteration after which the tail of a flat training began; 0 where it did not.
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
        """The iteration of the schedule whose rates an iteration has: in the tail it runs ahead, to the last."""
        if flat_at == 0 or iteration <= flat_at:
            return iteration
        return flat_at + (iteration - flat_at) * (self.iterations - flat_at) // tail_of(flat_at)

    def sh_degree_at(self, iteration: int) -> int:
        """The degree trained at an iteration (from 1): one more every ``sh_every``."""
        return min(self.sh_degree, iteration // self.sh_every)

    def look_at(self, iteration: int) -> TrainingSize:
        """What an iteration (from 1) looks at of its photo."""
        return self.stretches[self.stretch_at(iteration)].look

    def stretch_at(self, iteration: int) -> int:
        """The number of the stretch that an iteration (from 1) is in."""
        untils = (number for number, each in enumerate(self.stretches) if iteration <= each.until)
        return next(untils, len(self.stretches) - 1)

    def without_rest(self, iteration: int, worth: float) -> Schedule:
        """The schedule where the next stretch begins after this iteration; the last one gets what that spares.

        Args:
            iteration: In any stretch but the last.
            worth: Iterations of the last stretch that one of this costs as much as.
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

    def looks_to(self, last: int) -> list[TrainingSize]:
        """``look_at`` for every iteration up to the last."""
        return [self.look_at(iteration) for iteration in range(1, last + 1)]

    @property
    def finest(self) -> TrainingSize:
        """What iterations look at in the end."""
        return self.stretches[-1].look

    @property
    def finest_from(self) -> int:
        """The last iteration before those of the finest size."""
        return self.stretches[-2].until if len(self.stretches) > 1 else 0


def tail_of(flat_at: int) -> int:
    """Iterations that a training goes on for after its loss was flat."""
    return max(1, round(TAIL_SHARE * flat_at))


def random_colour(seed: int, iteration: int, stream: int) -> RGB:
    """A colour of its own for every iteration; ``stream`` as in ``draws``."""
    red, green, blue = uniform(seed, iteration, stream, [0, 1, 2]).tolist()
    return red, green, blue


def share_of_few(photos: int) -> float:
    """How much of what few photos need a training takes: all of it up to FEW_PHOTOS, nothing from MANY_PHOTOS on."""
    return min(1.0, max(0.0, (MANY_PHOTOS - photos) / (MANY_PHOTOS - FEW_PHOTOS)))


def resolve_schedule(config: TrainConfig, footage: PhotoSizes = UNKNOWN) -> Schedule:
    """The published schedule, changed for short runs, few photos and many.

    Args:
        config: The options.
        footage: The photos that are trained on.
    """
    return schedule_of(config, footage, lengths_of(config, footage))


def schedule_of(config: TrainConfig, footage: PhotoSizes, each: list[Length]) -> Schedule:
    """The same for sizes and iterations that are given.

    Args:
        config: The options.
        footage: The photos that are trained on.
        each: Levels and their iterations, the first one first.
    """
    pace = Pace.of(config, footage)
    few = FEW_DROPOUT * share_of_few(footage.photos)
    return Schedule(
        iterations=sum(count for _level, count in each),
        seed=config.seed,
        sh_degree=config.sh_degree,
        sh_every=pace.lasting(1000, 5),
        stretches=stretches(footage, each, config.coarse_levels),
        dropout=round(few, 4) if config.dropout == "auto" else config.dropout,
        background=BACKGROUNDS[config.background],
        rates=PUBLISHED if config.density == "published" else rates_of(pace.iterations),
        density=_density(config, each, pace),
    )


@dataclass(frozen=True)
class Pace:
    """How fast a model is made.

    A site of more photos takes more iterations, but a Gaussian is seen no more often: what is made in so many steps
    keeps its pace, only that all photos have their turn first.

    Attributes:
        iterations: That the learning rates are for.
        photos: That have their turn in every phase at least.
    """

    iterations: int
    photos: int

    @staticmethod
    def of(config: TrainConfig, footage: PhotoSizes) -> Pace:
        """That of a training; one whose length was given keeps the published lengths, whatever the photos."""
        if config.iterations == "auto":
            return Pace(config.least_iterations, footage.photos)
        return Pace(config.iterations, 1)

    def lasting(self, published: int, shares: int) -> int:
        """How long a phase is: as published, in a short run one of so many shares."""
        return max(1, min(published, self.iterations // shares), self.photos)


def _density(config: TrainConfig, each: list[Length], pace: Pace) -> DensitySchedule:
    published = config.density == "published"
    gradient = PUBLISHED_GRADIENT if published else GRADIENT
    return DensitySchedule(
        on=config.densify,
        seed=config.seed,
        cap=config.max_gaussians,
        first=pace.lasting(500, 5),
        last=max(1, growth_until(each)),
        every=pace.lasting(100, 10),
        gradient=gradient * (BUDGET_SHARE if config.time_budget_s else 1.0),
        reset_every=max(RESET_EVERY, RESET_VISITS * pace.photos) if published else 0,
        reset_until=each[0][1] if len(each) > 1 else 0,
        prune_screen_px=PRUNE_SCREEN_PX if published else 0.0,
        prune_free_space=config.prune_free_space,
    )
