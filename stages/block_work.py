"""What blocks add to a line's work, before anything of the site is known but the photos' number and size. Light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from splatpipe.pipeline.train.blocks.division import Division
from splatpipe.pipeline.train.blocks.needs import SPLAT_BYTES, round_pixels, work_bytes
from splatpipe.pipeline.train.lengths import Footage, Length, stretches

MEGA = 1e6
SEEN_BY = 20.0  # photos that show a place: some 12 of a flight straight down, 35 of orbits; judgement
BEGINNING_S = 5.0  # CPU seconds of a block before its first iteration: libraries, what its photos see, free space


@dataclass(frozen=True)
class BlockWork:
    """A site that is trained in blocks.

    Attributes:
        division: How many, and what one may take.
        footage: The photos as they are trained on.
        coarse: Levels and iterations of the pass over the whole.
        finer: Those that the blocks would have together if no window were looked at twice.
    """

    division: Division
    footage: Footage
    coarse: tuple[Length, ...]
    finer: tuple[Length, ...]

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
    def photos(self) -> float:
        """That a block looks at, whole or in part."""
        blocks, photos = self.division.blocks, max(1, self.footage.photos)
        return photos * round_pixels(1.0, blocks, math.sqrt(min(1.0, SEEN_BY / photos)), 1.0)

    def megapixels(self, lengths: Sequence[Length]) -> float:
        """That iterations look at."""
        done, total = 0, 0.0
        for stretch in stretches(self.footage, lengths):
            total += (stretch.until - done) * self.footage.pixels(stretch.look) / MEGA
            done = stretch.until
        return total

    @property
    def coarse_bytes(self) -> int:
        """Of the coarse pass's files."""
        return SPLAT_BYTES * self.division.coarse_cap

    @property
    def block_bytes(self) -> int:
        """Of what all blocks leave."""
        return SPLAT_BYTES * self.division.blocks * self.division.need.trained

    @property
    def work_bytes(self) -> int:
        """Of what a block has on the disk while it trains, besides its photos: its checkpoints, what is around it."""
        return work_bytes(self.division.need.trained, self.division.need.frozen)
