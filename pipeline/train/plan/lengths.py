"""The length of a training: a number of visits to every part of every photo, at every size. Plain arithmetic, cheap.

A training begins with whole photos, halved until they fit into a window, and then goes through the finer sizes window
by window. The number of visits follows from the photos, so captures of 11 and of 500 photos are seen equally often; the
cost of an iteration follows from the window. Starting with a long coarse phase agrees with others' experience: started
at full size, growth ends in blur (nerfstudio #2984, gaussian-splatting #958, #1146).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.windows import TrainingSize, windows_of

# Judgement, except where docs/measurements/training.md reports comparisons.
WHOLE_VISITS = 20  # minimum per photo at the size at which it fits whole
PART_VISITS = 16  # minimum per part of every photo at each finer size; 8 was worse, see docs/measurements/training.md
FIRST_SHARE = 0.5  # share of the minimum iterations at the first size, but for MAX_FIRST_ITERATIONS
MAX_FIRST_ITERATIONS = 3500  # cap on FIRST_SHARE where WHOLE_VISITS are fewer: the finest size is worth more
MIN_PART_VISITS = 10.0  # visits per part below which a run of a given length stays with the size before: it learns more
COARSE_SHARE = 0.5  # share of the first size's iterations that use photos halved further by `coarse_levels`

UNTIL = 0.5  # end of density control, as a share of the run (published), or of the finest size's part of it

WINDOW_PIXELS = {"cpu": 1 << 19, "cuda": 1 << 21}
"""Pixels of a window, by device. On a CPU an iteration's cost is proportional to its pixels, so small windows only add
the cost of their margins; a CUDA device is only fully used by larger ones. Powers of two slightly above half a
megapixel
and two, so that photos reduced to those sizes still fit whole."""


@dataclass(frozen=True)
class Stretch:
    """A run of iterations at one training size.

    Attributes:
        level: Number of times photos are halved.
        window_pixels: Most pixels of a photo that count in an iteration; 0 for the whole photo.
        until: The last of these iterations.
    """

    level: int
    window_pixels: int
    until: int

    @property
    def training_size(self) -> TrainingSize:
        """The training size of its iterations."""
        return TrainingSize(self.level, self.window_pixels)


@dataclass(frozen=True)
class PhotoSizes:
    """Photos at their training sizes.

    Attributes:
        sizes: Width and height at the finest size, pixels, and the count of photos of that size.
        window_pixels: Most pixels of a photo that an iteration uses; 0 for the whole photo.
    """

    sizes: tuple[tuple[int, int, int], ...]
    window_pixels: int = 0

    @property
    def photos(self) -> int:
        """Number of photos."""
        return sum(count for _width, _height, count in self.sizes)

    @property
    def first_level(self) -> int:
        """Number of halvings until half of the photos fit whole into a window."""
        areas = sorted((width * height, count) for width, height, count in self.sizes)
        seen, middle, level = 0, 0, 0
        for area, count in areas:
            seen += count
            if 2 * seen >= self.photos:
                middle = area
                break
        while self.window_pixels and middle / 4**level > self.window_pixels:
            level += 1
        return level

    def parts(self, level: int) -> int:
        """Number of windows of all photos at a level."""
        return sum(count * _cut(w >> level, h >> level, self.window_pixels)[0] for w, h, count in self.sizes)

    def window_at(self, level: int) -> int:
        """Most pixels of a window at a level; 0 if all photos fit whole."""
        return 0 if self.parts(level) == self.photos else self.window_pixels

    def pixels(self, size: TrainingSize) -> float:
        """Mean number of pixels that an iteration uses."""
        whole = sum(width * height * count for width, height, count in self.sizes) / 4.0**size.level
        return whole / (self.parts(size.level) if size.window_pixels else self.photos)

    def share(self, size: TrainingSize) -> float:
        """Share of a photo's pixels at that level that an iteration uses."""
        return self.photos / self.parts(size.level) if size.window_pixels else 1.0

    def largest(self, size: TrainingSize) -> int:
        """Pixels of the largest window, without its margins."""
        return max(_cut(w >> size.level, h >> size.level, size.window_pixels)[1] for w, h, _count in self.sizes)


@cache
def _cut(width: int, height: int, window_pixels: int) -> tuple[int, int]:
    """Number of windows of an image, and the pixels of the largest."""
    windows = windows_of(max(1, width), max(1, height), window_pixels)
    return len(windows), max(window.pixels for window in windows)


Length = tuple[int, int]
"""A level and its iterations."""


def lengths(footage: PhotoSizes, least: int, finest: int = 0) -> list[Length]:
    """Iterations at each level, in training order.

    Args:
        footage: The photos.
        least: Minimum number of iterations in total.
        finest: The last level.
    """
    first = max(finest, footage.first_level)
    if first == finest:
        return [(first, max(least, WHOLE_VISITS * footage.parts(first)))]
    whole = max(WHOLE_VISITS * footage.parts(first), min(math.ceil(FIRST_SHARE * least), MAX_FIRST_ITERATIONS))
    finer = [(level, PART_VISITS * footage.parts(level)) for level in range(first - 1, finest, -1)]
    return [(first, whole), *finer, (finest, max(PART_VISITS * footage.parts(finest), least - whole))]


def divided(footage: PhotoSizes, least: int, iterations: int) -> list[Length]:
    """A given number of iterations divided among levels: like ``lengths`` if fewer; any surplus at the finest size.

    A size that would get too few visits is left out.

    Args:
        footage: The photos.
        least: As for ``lengths``.
        iterations: Total number of iterations.
    """
    for finest in range(footage.first_level + 1):
        wanted = lengths(footage, least, finest)
        share = min(1.0, iterations / sum(count for _level, count in wanted))
        if len(wanted) == 1 or share * wanted[-1][1] >= MIN_PART_VISITS * footage.parts(finest):
            break
    ends, done = [], 0
    for _level, count in wanted:
        done += count
        ends.append(round(share * done))
    ends[-1] = iterations
    return [(level, end - start) for (level, _), start, end in zip(wanted, [0, *ends], ends, strict=False)]


def lengths_of(config: TrainConfig, footage: PhotoSizes) -> list[Length]:
    """Iterations at each photo size, in training order, as set by the options or derived from the photos."""
    least = config.least_iterations
    if config.iterations != "auto":
        return divided(footage, least, config.iterations)
    wanted = lengths(footage, least)
    if config.length_growth == 1.0:
        return wanted
    longer = sum(count for _level, count in wanted) / least
    return divided(footage, least, round(least * longer**config.length_growth))


@dataclass(frozen=True)
class IterationScale:
    """How fast a model is trained.

    A site with more photos takes more iterations, but each Gaussian is seen no more often: phases keep their length,
    except that every photo must have its turn in each.

    Attributes:
        iterations: Number of iterations that the learning rates are for.
        photos: Number of photos that each phase must at least visit.
    """

    iterations: int
    photos: int

    @staticmethod
    def of(config: TrainConfig, footage: PhotoSizes) -> IterationScale:
        """The pace of a training; one with a given length keeps the published phase lengths, whatever the photos."""
        if config.iterations == "auto":
            return IterationScale(config.least_iterations, footage.photos)
        return IterationScale(config.iterations, 1)

    def scaled_length(self, published: int, shares: int) -> int:
        """Length of a phase, iterations: as published, or 1/``shares`` of a short run; at least one visit per photo."""
        return max(1, min(published, self.iterations // shares), self.photos)


def growth_until(each: Sequence[Length]) -> int:
    """The last iteration of density control: every size adds the Gaussians that its detail needs."""
    *before, (_finest, count) = each
    return sum(earlier for _level, earlier in before) + int(UNTIL * count)


def stretches(footage: PhotoSizes, each: Sequence[Length], coarse_levels: int = 0) -> tuple[Stretch, ...]:
    """The same as stretches of training sizes.

    Args:
        footage: The photos.
        each: Levels and their iterations.
        coarse_levels: Extra halvings of the photos at the start of the first level, undone in equal shares.
    """
    (first, whole), *_ = each
    found, coarse = [], int(COARSE_SHARE * whole)
    for step in range(coarse_levels if coarse else 0):
        until = -(-coarse * (step + 1) // coarse_levels)
        level = first + coarse_levels - step
        found.append(Stretch(level, footage.window_at(level), until))
    done = 0
    for level, count in each:
        done += count
        found.append(Stretch(level, footage.window_at(level), done))
    starts = [0, *(stretch.until for stretch in found)]
    return tuple(stretch for stretch, start in zip(found, starts, strict=False) if stretch.until > start)
