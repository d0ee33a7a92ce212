"""How long a training is: so many visits of every part of every photo, at every size. Plain arithmetic, light.

A training begins with whole photos, halved until they fit into a window, and then goes through the finer sizes window
by window. The visits follow from the photos, so a capture of 11 and one of 500 photos are seen as well; what one
iteration costs follows from the window. That coarse sizes come first, and long, is what others found, too: begun at
full size, growth ends in blur (nerfstudio #2984, gaussian-splatting #958, #1146).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.windows import TrainingSize, windows_of

# Judgement, but for what docs/lengths.md says of them.
WHOLE_VISITS = 20  # of a photo at the size at which it is seen whole, at least
PART_VISITS = 16  # of every part of every photo at each finer size, at least; 8 lost, see docs/lengths.md
FIRST_SHARE = 0.5  # of the least iterations are at the first size,
FIRST_MOST = 3500  # but no more than these where 20 visits are fewer: the finest size is worth more
FEWEST_VISITS = (
    10.0  # of a part, below which a run that was given its length stays with the size before: it learns more
)
COARSE_SHARE = 0.5  # of the iterations at the first size are with photos that `coarse_levels` halves further

UNTIL = 0.5  # of a run there is density control: published; of the finest size's iterations, where there are several

WINDOW_PIXELS = {"cpu": 1 << 19, "cuda": 1 << 21}
"""Of a photo that an iteration renders, by device. On a CPU an iteration's cost is that of its pixels, so small windows
cost nothing but their margins; a CUDA device is busy only with larger ones. Powers of two: a little over half a
megapixel and over two, so that photos which were reduced to those are still seen whole."""


@dataclass(frozen=True)
class Stretch:
    """Iterations that look at their photos in one way.

    Attributes:
        level: How often photos are halved.
        window_pixels: Of a photo, that count in an iteration at most; 0 for all of it.
        until: The last of the iterations.
    """

    level: int
    window_pixels: int
    until: int

    @property
    def look(self) -> TrainingSize:
        """The same for one iteration."""
        return TrainingSize(self.level, self.window_pixels)


@dataclass(frozen=True)
class PhotoSizes:
    """Photos as they are trained on.

    Attributes:
        sizes: Width and height at the finest size, pixels, and how many photos have it.
        window_pixels: Most pixels of a photo that an iteration uses; 0 for the whole photo.
    """

    sizes: tuple[tuple[int, int, int], ...]
    window_pixels: int = 0

    @property
    def photos(self) -> int:
        """How many."""
        return sum(count for _width, _height, count in self.sizes)

    @property
    def first_level(self) -> int:
        """How often photos are halved until half of them fit into a window whole."""
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
        """Windows of all photos, halved so often."""
        return sum(count * _cut(w >> level, h >> level, self.window_pixels)[0] for w, h, count in self.sizes)

    def window_at(self, level: int) -> int:
        """Most pixels of a window, at a level; 0 where all photos fit in whole."""
        return 0 if self.parts(level) == self.photos else self.window_pixels

    def pixels(self, look: TrainingSize) -> float:
        """Of a photo that an iteration looks at, on average."""
        whole = sum(width * height * count for width, height, count in self.sizes) / 4.0**look.level
        return whole / (self.parts(look.level) if look.window_pixels else self.photos)

    def share(self, look: TrainingSize) -> float:
        """Of a photo's pixels at that level, that an iteration looks at."""
        return self.photos / self.parts(look.level) if look.window_pixels else 1.0

    def largest(self, look: TrainingSize) -> int:
        """Pixels of the largest window, without its margins."""
        return max(_cut(w >> look.level, h >> look.level, look.window_pixels)[1] for w, h, _count in self.sizes)


@cache
def _cut(width: int, height: int, window_pixels: int) -> tuple[int, int]:
    """How many windows a picture has, and the pixels of the largest."""
    windows = windows_of(max(1, width), max(1, height), window_pixels)
    return len(windows), max(window.pixels for window in windows)


Length = tuple[int, int]
"""A level and its iterations."""


def lengths(footage: PhotoSizes, least: int, finest: int = 0) -> list[Length]:
    """Iterations at each level, the first one first.

    Args:
        footage: The photos.
        least: Iterations in all, at least.
        finest: The last level.
    """
    first = max(finest, footage.first_level)
    if first == finest:
        return [(first, max(least, WHOLE_VISITS * footage.parts(first)))]
    whole = max(WHOLE_VISITS * footage.parts(first), min(math.ceil(FIRST_SHARE * least), FIRST_MOST))
    finer = [(level, PART_VISITS * footage.parts(level)) for level in range(first - 1, finest, -1)]
    return [(first, whole), *finer, (finest, max(PART_VISITS * footage.parts(finest), least - whole))]


def divided(footage: PhotoSizes, least: int, iterations: int) -> list[Length]:
    """So many iterations: fewer than those of ``lengths`` divided like them, more of them at the finest size.

    A size that comes too short is left out.

    Args:
        footage: The photos.
        least: As for ``lengths``.
        iterations: In all.
    """
    for finest in range(footage.first_level + 1):
        wanted = lengths(footage, least, finest)
        share = min(1.0, iterations / sum(count for _level, count in wanted))
        if len(wanted) == 1 or share * wanted[-1][1] >= FEWEST_VISITS * footage.parts(finest):
            break
    ends, done = [], 0
    for _level, count in wanted:
        done += count
        ends.append(round(share * done))
    ends[-1] = iterations
    return [(level, end - start) for (level, _), start, end in zip(wanted, [0, *ends], ends, strict=False)]


def lengths_of(config: TrainConfig, footage: PhotoSizes) -> list[Length]:
    """Iterations at each size of the photos, those of the options or what they ask for, the first one first."""
    if config.iterations == "auto":
        return lengths(footage, config.least_iterations)
    return divided(footage, config.least_iterations, config.iterations)


def growth_until(each: Sequence[Length]) -> int:
    """The last iteration of density control: every size adds the Gaussians that its detail asks for."""
    *before, (_finest, count) = each
    return sum(earlier for _level, earlier in before) + int(UNTIL * count)


def stretches(footage: PhotoSizes, each: Sequence[Length], coarse_levels: int = 0) -> tuple[Stretch, ...]:
    """The same as what iterations look at.

    Args:
        footage: The photos.
        each: Levels and their iterations.
        coarse_levels: Photos of the first are halved so many times more at the start, by equal shares.
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
