"""Work that training in blocks adds to a run, estimated from the number and size of photos. Light to import."""

from __future__ import annotations

import math
from dataclasses import dataclass

from splatpipe.pipeline.train.blocks.cells.division import Division
from splatpipe.pipeline.train.blocks.cells.needs import (
    MARGIN_GROWTH,
    SPLAT_BYTES,
    frozen_bytes,
    grown_from,
    round_pixels,
    work_bytes,
)
from splatpipe.pipeline.train.plan.lengths import Length, PhotoSizes, growth_until, stretches
from splatpipe.pipeline.train.plan.limits import PIXEL_BYTES, bytes_per_gaussian

PHOTOS_PER_POINT = 35.0  # photos that show a point: about 12 in a nadir flight, 60 in the tiled demo, which has orbits
VISIBLE_SHARE = 3.0  # share of the site that a block sees, over its share of the photos: 3.6 and 2.4 in the tiled demo
START_S = 5.0  # CPU seconds per block before its first iteration: libraries, its photos' exposures and skies
LAYOUT_S = 0.07  # CPU seconds per pair of photo and visible block, to find its surroundings; from the tiled demo
DENSIFY_EVERY = 100  # iterations between two density-control steps, unless the training is short
SITE_PHOTO_BYTES = 40_000  # per photo of the site, in every block: its camera and its free space


@dataclass(frozen=True)
class BlockLoad:
    """Expected number of Gaussians in a block, which determines its memory, disk space and time.

    Attributes:
        trained: Trained Gaussians in cell and margin, at the end of training.
        frozen: Frozen Gaussians around the block.
    """

    trained: float
    frozen: float

    @property
    def work_bytes(self) -> int:
        """Bytes on disk during training, without its photos: checkpoints and the frozen surroundings."""
        return work_bytes(int(self.trained), int(self.frozen))

    @property
    def left_bytes(self) -> int:
        """Bytes on disk after training."""
        return int(SPLAT_BYTES * self.trained)


@dataclass(frozen=True)
class BlockWork:
    """Work of training a site in blocks.

    Attributes:
        division: The number of blocks, and the limits of each.
        footage: The photos at training size.
        coarse: Levels and iterations of the coarse pass over the whole scene.
        finer: Levels and iterations that all blocks would need together if no window were shown to two blocks.
        grown: Expected number of Gaussians that the photos' detail calls for.
        sh_degree: Spherical harmonics degree of the model.
        pace: ``train.least_iterations`` if the number of iterations follows from it, else 0.
    """

    division: Division
    footage: PhotoSizes
    coarse: tuple[Length, ...]
    finer: tuple[Length, ...]
    grown: float
    sh_degree: int
    pace: int

    def repeats(self, level: int) -> float:
        """Mean number of blocks that train on each window."""
        blocks, photos = self.division.blocks, max(1, self.footage.photos)
        parts = self.footage.parts(level) / photos
        return blocks * round_pixels(1.0, blocks, math.sqrt(min(1.0, PHOTOS_PER_POINT / photos) / parts), 1.0)

    @property
    def lengths(self) -> tuple[Length, ...]:
        """Levels and total iterations of all blocks."""
        return tuple((level, round(count * self.repeats(level))) for level, count in self.finer)

    @property
    def blocks_per_photo(self) -> float:
        """Mean number of blocks that use each photo, whole or in part."""
        blocks, photos = self.division.blocks, max(1, self.footage.photos)
        return blocks * round_pixels(1.0, blocks, math.sqrt(min(1.0, PHOTOS_PER_POINT / photos)), 1.0)

    @property
    def photos(self) -> float:
        """Mean number of photos that each block uses, whole or in part."""
        return max(1, self.footage.photos) * self.blocks_per_photo / self.division.blocks

    @property
    def coarse_gaussians(self) -> float:
        """Expected number of Gaussians after the coarse pass."""
        return min(float(self.division.coarse_cap), self.grown)

    @property
    def load(self) -> BlockLoad:
        """Expected number of Gaussians in a block."""
        division = self.division
        start = MARGIN_GROWTH * self.coarse_gaussians / division.blocks
        asked = max(start, MARGIN_GROWTH * self.grown / division.blocks)
        trained = min(float(grown_from(int(start), self.steps, division.need.trained)), asked)
        around = self.coarse_gaussians * min(1.0, VISIBLE_SHARE * self.blocks_per_photo / division.blocks)
        return BlockLoad(trained, min(float(division.need.frozen), around))

    @property
    def steps(self) -> int:
        """Density-control steps in a block.

        If the number of iterations follows from the photos, steps are at least one pass over the block's photos apart.
        """
        own = [(level, round(count / self.division.blocks)) for level, count in self.lengths]
        every = min(DENSIFY_EVERY, max(1, (self.pace or sum(count for _, count in own)) // 10))
        return int(growth_until(own) // max(every, self.photos if self.pace else 1.0))

    @property
    def merged(self) -> float:
        """Number of Gaussians after merging all blocks."""
        trained = self.division.blocks * self.load.trained / MARGIN_GROWTH
        return min(float(self.division.cap), max(trained, self.coarse_gaussians))

    def memory_bytes(self, load: BlockLoad) -> int:
        """Memory of a block's process beyond the fixed share of any training, bytes; `load` respects its limits."""
        window = max(self.footage.largest(stretch.training_size) for stretch in stretches(self.footage, self.finer))
        taken = load.trained * bytes_per_gaussian(self.sh_degree) + load.frozen * frozen_bytes(self.sh_degree)
        return int(PIXEL_BYTES * window + taken + SITE_PHOTO_BYTES * self.footage.photos)

    @property
    def coarse_bytes(self) -> int:
        """Bytes on disk of the coarse pass's files."""
        return int(SPLAT_BYTES * self.coarse_gaussians)

    @property
    def block_bytes(self) -> int:
        """Bytes on disk after the training of all blocks."""
        return self.division.blocks * self.load.left_bytes
