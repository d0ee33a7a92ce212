"""What blocks add to a line's work, before anything of the site is known but the photos' number and size. Light."""

from __future__ import annotations

import math
from dataclasses import dataclass

from splatpipe.pipeline.train.blocks.division import Division
from splatpipe.pipeline.train.blocks.needs import (
    MARGIN_GROWTH,
    SPLAT_BYTES,
    frozen_bytes,
    grown_from,
    round_pixels,
    work_bytes,
)
from splatpipe.pipeline.train.lengths import Length, PhotoSizes, growth_until, stretches
from splatpipe.pipeline.train.limits import PIXEL_BYTES, bytes_per_gaussian

SEEN_BY = 35.0  # photos that show a place: some 12 of a flight straight down, 60 of the tiled demo, which has orbits
LOOKS_FARTHER = 3.0  # times as much of the site as photos of it does a block see: 3.6 and 2.4 in the tiled demo
BEGINNING_S = 5.0  # CPU seconds of a block before its first iteration: libraries, its photos' exposures and skies
LAYOUT_S = 0.07  # CPU seconds of a photo and a block that it shows, to see what is around: measured on the tiled demo
EVERY = 100  # iterations between two steps of density control at least
SITE_PHOTO_BYTES = 40_000  # of each of the site's photos in any block: its camera, and what it says is free


@dataclass(frozen=True)
class BlockLoad:
    """Gaussians that a block is expected to have: what its memory, disk and time follow from.

    Attributes:
        trained: At its end, of cell and margin.
        frozen: Around it.
    """

    trained: float
    frozen: float

    @property
    def work_bytes(self) -> int:
        """On the disk while it trains, besides its photos: its checkpoints, and what is around it."""
        return work_bytes(int(self.trained), int(self.frozen))

    @property
    def left_bytes(self) -> int:
        """That it leaves on the disk."""
        return int(SPLAT_BYTES * self.trained)


@dataclass(frozen=True)
class BlockWork:
    """A site that is trained in blocks.

    Attributes:
        division: How many, and what one may take.
        footage: The photos as they are trained on.
        coarse: Levels and iterations of the pass over the whole.
        finer: Those that the blocks would have together if no window were looked at twice.
        grown: Gaussians that the photos are thought to ask for.
        sh_degree: Of the model.
        pace: ``train.least_iterations`` where iterations follow from it, else 0.
    """

    division: Division
    footage: PhotoSizes
    coarse: tuple[Length, ...]
    finer: tuple[Length, ...]
    grown: float
    sh_degree: int
    pace: int

    def repeats(self, level: int) -> float:
        """How many blocks look at a window, on average."""
        blocks, photos = self.division.blocks, max(1, self.footage.photos)
        parts = self.footage.parts(level) / photos
        return blocks * round_pixels(1.0, blocks, math.sqrt(min(1.0, SEEN_BY / photos) / parts), 1.0)

    @property
    def lengths(self) -> tuple[Length, ...]:
        """Levels and iterations of all blocks together."""
        return tuple((level, round(count * self.repeats(level))) for level, count in self.finer)

    @property
    def looks(self) -> float:
        """Blocks that look at a photo, whole or in part."""
        blocks, photos = self.division.blocks, max(1, self.footage.photos)
        return blocks * round_pixels(1.0, blocks, math.sqrt(min(1.0, SEEN_BY / photos)), 1.0)

    @property
    def photos(self) -> float:
        """That a block looks at, whole or in part."""
        return max(1, self.footage.photos) * self.looks / self.division.blocks

    @property
    def coarse_gaussians(self) -> float:
        """Expected after the coarse pass."""
        return min(float(self.division.coarse_cap), self.grown)

    @property
    def load(self) -> BlockLoad:
        """What a block is expected to have."""
        division = self.division
        start = MARGIN_GROWTH * self.coarse_gaussians / division.blocks
        asked = max(start, MARGIN_GROWTH * self.grown / division.blocks)
        trained = min(float(grown_from(int(start), self.steps, division.need.trained)), asked)
        around = self.coarse_gaussians * min(1.0, LOOKS_FARTHER * self.looks / division.blocks)
        return BlockLoad(trained, min(float(division.need.frozen), around))

    @property
    def steps(self) -> int:
        """Of density control in a block: where iterations follow from photos, not before each was looked at."""
        own = [(level, round(count / self.division.blocks)) for level, count in self.lengths]
        every = min(EVERY, max(1, (self.pace or sum(count for _, count in own)) // 10))
        return int(growth_until(own) // max(every, self.photos if self.pace else 1.0))

    @property
    def merged(self) -> float:
        """Gaussians of all blocks, merged."""
        trained = self.division.blocks * self.load.trained / MARGIN_GROWTH
        return min(float(self.division.cap), max(trained, self.coarse_gaussians))

    def memory_bytes(self, load: BlockLoad) -> int:
        """Of a block's process besides what any training's has; no more than what its limits let it have."""
        window = max(self.footage.largest(stretch.look) for stretch in stretches(self.footage, self.finer))
        taken = load.trained * bytes_per_gaussian(self.sh_degree) + load.frozen * frozen_bytes(self.sh_degree)
        return int(PIXEL_BYTES * window + taken + SITE_PHOTO_BYTES * self.footage.photos)

    @property
    def coarse_bytes(self) -> int:
        """Of the coarse pass's files."""
        return int(SPLAT_BYTES * self.coarse_gaussians)

    @property
    def block_bytes(self) -> int:
        """Of what all blocks leave."""
        return self.division.blocks * self.load.left_bytes
