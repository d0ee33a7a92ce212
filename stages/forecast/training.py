"""How long and how large a training will be, by its own rules of lengths, windows and blocks. Light to import."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

from splatpipe.pipeline.train.blocks.cells.division import Division, SceneSize, divided, memory_limit
from splatpipe.pipeline.train.blocks.cells.needs import MARGIN_GROWTH, block_need, round_pixels, work_bytes
from splatpipe.pipeline.train.blocks.lengths import coarse_lengths, finer_lengths
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.lengths import (
    WINDOW_PIXELS,
    IterationScale,
    Length,
    PhotoSizes,
    growth_until,
    lengths,
    lengths_of,
    stretches,
)
from splatpipe.pipeline.train.plan.limits import (
    FIXED_BYTES,
    LIBRARIES_BYTES,
    PIXEL_BYTES,
    SMALLEST_WINDOW,
    bytes_per_gaussian,
    window_within,
    worthwhile_iterations,
)
from splatpipe.stages.forecast.costs import REFERENCE, Sizes

MEGA = 1e6
USUAL_SHAPE = 0.72  # side ratio of photos if unknown: between the 4:3 and 3:2 of most cameras
PREVIEW_STEPS = 5  # density-control steps behind `Costs.gaussians`
PREVIEW_MEGAPIXELS = 0.3  # training size behind `Costs.gaussians`
STEPS_POWER = 1.3  # exponent of Gaussians over steps: 1.5 on brighton (946,000 at `standard`), 0.9 on the demo
SIZE_POWER = 0.5  # exponent of Gaussians over photo size: from 0.1 to 0.3 megapixels on the demo
GAUSSIAN_MEGAPIXELS = 1.7e-6  # that cost as much per iteration as a Gaussian: 1.2 on seneca, 2.3 on brighton (894,000)
UNSEEN_SHARE = 0.3  # share of a Gaussian's cost that remains outside the window; an estimate
MIN_GAUSSIANS = 1000  # however short the time
PHOTOS_PER_POINT = 35.0  # photos that show a point: about 12 in a nadir flight, 60 in the tiled demo, which has orbits


@dataclass(frozen=True)
class CaptureSize:
    """What is known about a capture before processing.

    Attributes:
        photos: Number of photos.
        megapixels: Median size of an original photo.
        positions: Whether most photos have a position.
        shape: A photo's shorter side over its longer one.
        control: Whether there is a control file or scale bars, so that targets are searched.
    """

    photos: int
    megapixels: float
    positions: bool
    shape: float = USUAL_SHAPE
    control: bool = False


@dataclass(frozen=True)
class Training:
    """Expected training of a capture.

    Attributes:
        size: The capture's size, with the megapixels of a photo in the dataset.
        config: The training options.
        lengths: Levels and their iterations, without regard to blocks.
        density: ``Costs.gaussians``.
        division: How the scene is divided into blocks; None if it is trained whole.
        fitting: Largest number of Gaussians that fit a time budget.
    """

    size: CaptureSize
    config: TrainConfig
    lengths: tuple[Length, ...] = ()
    density: float = REFERENCE.gaussians
    division: Division | None = None
    fitting: float = math.inf

    @staticmethod
    def of(
        size: CaptureSize, config: TrainConfig, density: float = REFERENCE.gaussians, limit_bytes: int = 0
    ) -> Training:
        """Return the training of the scene as a whole; ``limit_bytes`` holds although the user set no limit."""
        config = config.model_copy(update={"max_memory_bytes": config.max_memory_bytes or limit_bytes})
        bare = Training(size, config, density=density)
        return replace(bare, lengths=tuple(lengths_of(config, bare.footage)))

    def as_divided(self, machine_bytes: int = 0, least: int = 0) -> Training:
        """Return the training as the stage `blocks` is expected to decide.

        Args:
            machine_bytes: The machine's memory if it may decide; otherwise 0.
            least: Requested minimum number of blocks.
        """
        config, footage = self.config, replace(self.footage, window_pixels=WINDOW_PIXELS["cpu"])
        window = max(footage.largest(each.training_size) for each in stretches(footage, self.lengths))
        scene = SceneSize(config.max_gaussians, self.grown, window, config.sh_degree, self.size.photos)
        limit = memory_limit(config.max_memory_bytes, machine_bytes)
        division = divided(scene, 0) if config.time_budget_s else divided(scene, limit, least)
        if division.is_near:
            return Training.of(self.size, config, self.density, division.limit_bytes)
        return self if division.is_whole else replace(self, division=division)

    def filling(self, seconds: float, work: float) -> Training:
        """Return the training that fills a time: iterations by its root, and the Gaussians that then fit.

        Args:
            seconds: Wall-clock time for training.
            work: Megapixels of all iterations that fit, with Gaussians as pixels that cost as much.
        """
        longer = replace(self, lengths=tuple(lengths(self.footage, worthwhile_iterations(seconds))))
        room = work / longer.iterations - longer.window / MEGA
        return replace(longer, fitting=max(MIN_GAUSSIANS, room / gaussian_megapixels(longer.share)))

    @property
    def blocks(self) -> int:
        """Number of blocks; 1 if the scene is trained whole."""
        return 1 if self.division is None else self.division.blocks

    @property
    def megapixels(self) -> float:
        """Megapixels of a training photo at the finest level."""
        return min(self.size.megapixels, self.config.max_megapixels or self.size.megapixels)

    @cached_property
    def footage(self) -> PhotoSizes:
        """The photos at training size, and the largest window that memory allows."""
        height = math.sqrt(MEGA * self.megapixels * self.size.shape)
        window, limit = WINDOW_PIXELS["cpu"], self.config.max_memory_bytes
        if limit:
            window = window_within(limit - LIBRARIES_BYTES - FIXED_BYTES, window)
        if self.division is not None:
            window = self.division.window_pixels
        return PhotoSizes(((max(1, round(height / self.size.shape)), max(1, round(height)), self.size.photos),), window)

    @property
    def window(self) -> int:
        """Largest number of pixels in one iteration."""
        return max(self.footage.largest(each.training_size) for each in stretches(self.footage, self.lengths))

    @property
    def coarse(self) -> tuple[Length, ...]:
        """Levels and iterations of the coarse pass before blocks; none without blocks."""
        return () if self.division is None else tuple(coarse_lengths(self.config, self.footage))

    @property
    def finer(self) -> tuple[Length, ...]:
        """Levels and iterations after the coarse pass, of all blocks together."""
        if self.division is None:
            return self.lengths
        each = finer_lengths(self.config, self.footage)
        return tuple((level, round(count * self.blocks_per_part(self.footage.parts(level)))) for level, count in each)

    @property
    def iterations(self) -> int:
        """Number of iterations; with blocks, of the coarse pass and all blocks."""
        return sum(count for _level, count in (*self.coarse, *self.finer))

    @property
    def most_gaussians(self) -> float:
        """Largest number of Gaussians that the options, including limits of memory and time, allow."""
        if self.division is not None:
            return float(self.division.cap)
        most, limit = min(float(self.config.max_gaussians), self.fitting), self.config.max_memory_bytes
        room = limit - LIBRARIES_BYTES - FIXED_BYTES - PIXEL_BYTES * self.window
        return min(most, max(0.0, room) / bytes_per_gaussian(self.config.sh_degree)) if limit else most

    @property
    def grown(self) -> float:
        """Number of Gaussians of the whole scene after density control, before limits."""
        auto = self.config.iterations == "auto"
        scale = IterationScale.of(self.config, self.footage) if auto else IterationScale(self.iterations, 1)
        growing = growth_until(self.lengths) - scale.scaled_length(500, 5)
        longer = max(1.0, 1.0 + growing // scale.scaled_length(100, 10)) / PREVIEW_STEPS
        larger = self.megapixels / PREVIEW_MEGAPIXELS
        return float(self.density * self.size.photos * longer**STEPS_POWER * larger**SIZE_POWER)

    @property
    def gaussians(self) -> float:
        """Number of Gaussians at the end."""
        return min(self.most_gaussians, self.grown)

    def blocks_per_part(self, parts: int) -> float:
        """Mean number of blocks that use each of the parts that all photos are cut into."""
        photos = max(1, self.size.photos)
        side = math.sqrt(min(1.0, PHOTOS_PER_POINT / photos) * photos / parts)
        return self.blocks * round_pixels(1.0, self.blocks, side, 1.0)

    @property
    def photos_per_block(self) -> float:
        """Mean number of photos that each block uses, whole or in part."""
        photos = max(1, self.size.photos)
        return photos * self.blocks_per_part(photos) / self.blocks

    def block_gaussians(self, division: Division) -> float:
        """Number of Gaussians that a block trains in its cell and margin."""
        return min(float(division.need.trained), MARGIN_GROWTH * self.gaussians / division.blocks)

    @property
    def share(self) -> float:
        """Share of a photo that an iteration at the finest size uses."""
        return self.footage.share(stretches(self.footage, self.lengths)[-1].training_size)

    def of_process(self, iterations: float, trained: int, frozen: int = 0, share: float = 1.0) -> Sizes:
        """Return the sizes of training processes: their work, upper bounds of the memory of one, its checkpoints.

        Args:
            iterations: Number of iterations of all.
            trained: Number of trained Gaussians in one.
            frozen: Number of frozen Gaussians around them.
            share: Share of a photo that an iteration uses.
        """
        return {
            "work": iterations * (self.window / MEGA + gaussian_megapixels(share) * (trained + frozen)),
            "training_bytes": block_need(trained, frozen, self.window, self.config.sh_degree).memory_bytes,
            "checkpoint_bytes": work_bytes(trained, frozen),
        }


def gaussian_megapixels(share: float) -> float:
    """Megapixels that cost as much per iteration as a Gaussian, if an iteration uses a share of a photo."""
    return GAUSSIAN_MEGAPIXELS * (UNSEEN_SHARE + (1.0 - UNSEEN_SHARE) * share)


def min_memory_bytes(config: TrainConfig) -> int:
    """Smallest memory limit that training can keep: libraries, the smallest window, the fewest Gaussians."""
    return LIBRARIES_BYTES + block_need(MIN_GAUSSIANS, 0, SMALLEST_WINDOW, config.sh_degree).memory_bytes
