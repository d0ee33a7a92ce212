"""The pipeline's work on a capture, in units that follow from its size and the options. Light to import."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from splatpipe.pipeline.edit.options import SEEN_MEGAPIXELS
from splatpipe.pipeline.engine.runs.needs import Need
from splatpipe.pipeline.film.options import MAX_FILM_MEGAPIXELS
from splatpipe.pipeline.render.options import JUDGED_MEGAPIXELS
from splatpipe.pipeline.train.blocks.cells.division import Division, SceneSize, divided, memory_limit
from splatpipe.pipeline.train.blocks.lengths import coarse_lengths, finer_lengths
from splatpipe.pipeline.train.options import FILM_FROM_BUDGET_S
from splatpipe.pipeline.train.plan.lengths import (
    WINDOW_PIXELS,
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
    bytes_per_gaussian,
    window_within,
    worthwhile_iterations,
)
from splatpipe.pipeline.web.options import parse_formats
from splatpipe.stages.block_work import LAYOUT_S, START_S, BlockLoad, BlockWork
from splatpipe.stages.costs import FORMAT_COSTS, IN_LEVELS, LEVELS_CPU, WITH_PHOTOS, Costs
from splatpipe.stages.options import LineConfig

MEGA = 1e6
USUAL_SHAPE = 0.72  # side ratio of photos if unknown: between the 4:3 and 3:2 of most cameras
SIFT_WORK = {"opencv-sift": 1.0, "sift": 3.2}  # CPU seconds per pixel relative to OpenCV's: 2.4 on sceaux, 4.3 on demo
SIFT_MEMORY = {"opencv-sift": 1.0, "sift": 1.5}  # memory per thread, likewise
MAX_KEYPOINTS = {"opencv-sift": 1.25, "sift": 1.3}  # times max_features: several orientations, whole scales
NEIGHBOURS = 20  # per photo, behind `Costs.pairs`
PHOTOS_OF_ONE_COST = 50  # up to this many photos, mapping costs the constant per photo; with more photos it costs more
MAPPING_GROWTH = 0.75  # exponent of the number of photos in the mapping cost per photo: seneca's 167, a room's 292
WITHOUT_POSITIONS = 2.5  # times the mapping cost: pairs that only look alike, doubts, second mappings
REEXTRACTION_MEGAPIXELS = 4.3  # size of an image in which unplaced photos get further keypoints
REEXTRACTION_BYTES = 250.0  # memory per pixel for these keypoints, on half of the threads
JUDGED_ONE_IN = 8  # photos, behind the cost of `evaluate`
PREVIEW_STEPS = 5  # density-control steps behind `Costs.gaussians`
STEPS_POWER = 1.3  # exponent of Gaussians over steps: 1.5 on brighton (946,000 at `standard`), 0.9 on the demo
SIZE_POWER = 0.5  # exponent of Gaussians over photo size: from 0.1 to 0.3 megapixels on the demo
PREVIEW_MEGAPIXELS = 0.3  # training size behind `Costs.gaussians`
GAUSSIAN_MEGAPIXELS = 1.7e-6  # that cost as much per iteration as a Gaussian: 1.2 on seneca, 2.3 on brighton (894,000)
UNSEEN_SHARE = 0.3  # share of a Gaussian's cost that remains outside the window; an estimate
GROWTH_SAMPLES = 32  # points at which the growing number of Gaussians is averaged over a stretch of the training
PYRAMID = 4.0 / 3.0  # pixels of a photo's whole image pyramid over its own
TARGETS_TILE = 2.4  # megapixels of a tile in which targets are searched
START_SHARE = 0.2  # initial over final number of Gaussians
MIN_SHARE = 0.1  # least share of a time budget that training gets
MIN_GAUSSIANS = 1000  # however short the time
PHOTO_BYTES = 3  # per decoded pixel
PARALLEL = {
    "ingest": 0.8,
    "features": 0.98,
    "matches": 0.97,
    "sparse": 0.2,
    "undistort": 0.8,
    "initialize": 0.85,
    "blocks": 0.93,
    "train": 0.93,
    "clean": 0.75,
    "evaluate": 0.75,
    "export": 0.2,
    "flythrough": 0.7,
    "depths": 0.97,
    "dsm": 0.9,
    "ortho": 0.9,
    "splat_depths": 0.9,
    "facades": 0.8,
    "cloud": 0.9,
    "mesh": 0.5,
}
"""Parallel share of each stage's CPU seconds; measured with one and two threads."""

TRAINING = {"blocks": "train", "train": "train"}
"""Stages that train, and the stage whose costs they use."""


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
class WorkUnits:
    """A stage's work, in the units of its `StageCosts`.

    Attributes:
        cpu: Units of CPU time.
        memory: Units of memory, beyond the constant share.
        disk: Units of output on disk.
        fixed_bytes: Memory that is known without a cost.
    """

    cpu: float
    memory: float
    disk: float
    fixed_bytes: float = 0.0


@dataclass(frozen=True)
class CaptureWork:
    """The work of a run on a capture.

    Attributes:
        size: The capture's size.
        config: The resolved options.
        costs: Cost per unit.
        threads: Number of threads of the run.
        lengths: Levels of the training and their iterations.
        gaussians: Number of Gaussians at the end of training.
        blocks: The work of training in blocks; None if the scene is trained whole.
    """

    size: CaptureSize
    config: LineConfig
    costs: Costs
    threads: int
    lengths: tuple[Length, ...]
    gaussians: float
    blocks: BlockWork | None = None

    @staticmethod
    def of(size: CaptureSize, config: LineConfig, costs: Costs, threads: int, machine_bytes: int = 0) -> CaptureWork:
        """Return the work without a time budget.

        Args:
            size: The capture's size.
            config: The resolved options.
            costs: Cost per unit.
            threads: Number of threads of the run.
            machine_bytes: The machine's memory if it may decide on blocks; otherwise 0.
        """
        work = CaptureWork._undivided(size, config, costs, threads)
        division = work.division(machine_bytes)
        if division.is_near and not config.train.max_memory_bytes:
            return CaptureWork.of_whole(size, config, costs, threads, division.limit_bytes)
        return work.divided_as(division)

    @staticmethod
    def of_whole(
        size: CaptureSize, config: LineConfig, costs: Costs, threads: int, limit_bytes: int = 0
    ) -> CaptureWork:
        """Return the work if the scene is trained whole, whatever its size.

        Args:
            size: The capture's size.
            config: The resolved options.
            costs: Cost per unit.
            threads: Number of threads of the run.
            limit_bytes: Memory limit that training keeps although the user set none; 0 for none.
        """
        if limit_bytes:
            train = config.train.model_copy(update={"max_memory_bytes": limit_bytes})
            config = config.model_copy(update={"train": train})
        work = CaptureWork._undivided(size, config, costs, threads)
        return replace(work, gaussians=min(work.most_gaussians, work.grown))

    def divided_as(self, division: Division) -> CaptureWork:
        """Return the work with the scene divided as given."""
        if division.is_whole:
            return replace(self, gaussians=min(self.most_gaussians, self.grown), blocks=None)
        train, footage = self.config.train, replace(self.footage, window_pixels=division.window_pixels)
        coarse, finer = (tuple(each(train, footage)) for each in (coarse_lengths, finer_lengths))
        pace = train.least_iterations if train.iterations == "auto" else 0
        blocks = BlockWork(division, footage, coarse, finer, self.grown, train.sh_degree, pace)
        return replace(self, gaussians=blocks.merged, blocks=blocks)

    @staticmethod
    def _undivided(size: CaptureSize, config: LineConfig, costs: Costs, threads: int) -> CaptureWork:
        work = CaptureWork(size, config, costs, threads, (), 0.0)
        return replace(work, lengths=tuple(lengths_of(config.train, work.footage)))

    def division(self, machine_bytes: int) -> Division:
        """Return the division into blocks that follows from the options and the expected number of Gaussians."""
        train = self.config.train
        footage = replace(self.footage, window_pixels=WINDOW_PIXELS["cpu"])
        window = max(footage.largest(stretch.training_size) for stretch in stretches(footage, self.lengths))
        scene = SceneSize(train.max_gaussians, self.grown, window, train.sh_degree, self.size.photos)
        if train.time_budget_s:
            return divided(scene, 0)
        return divided(scene, memory_limit(train.max_memory_bytes, machine_bytes), self.config.blocks.least)

    def filling(self, seconds: float, speed: float) -> CaptureWork:
        """Return the work with training to fill a time: iterations by its root, and the Gaussians that then fit.

        Args:
            seconds: Wall-clock time for training.
            speed: Relative speed of the machine's cores."""
        longer = replace(self, lengths=tuple(lengths(self.footage, worthwhile_iterations(seconds))))
        cpu = seconds / Need(0, 1.0, 0, parallel=PARALLEL["train"]).seconds(self.threads)
        bare = replace(longer, gaussians=0.0).training
        room = cpu * speed / self.costs.stages["train"].cpu - bare
        fitting = max(MIN_GAUSSIANS, room / (replace(longer, gaussians=1.0).training - bare))
        return replace(longer, gaussians=min(self.most_gaussians, longer.grown, fitting))

    @property
    def keypoint_megapixels(self) -> float:
        """Megapixels per photo for keypoint extraction."""
        return min(self.size.megapixels, self.size.shape * self.config.features.max_image_size**2 / MEGA)

    @property
    def keypoints(self) -> float:
        """Keypoints per photo."""
        options = self.config.features
        most = MAX_KEYPOINTS[options.extractor] * options.max_features
        return min(most, self.costs.keypoints[options.extractor] * self.keypoint_megapixels)

    @property
    def pairs(self) -> float:
        """Number of photo pairs that are matched."""
        photos, options = self.size.photos, self.config.matches
        every = photos * (photos - 1) / 2
        small = photos <= options.exhaustive_up_to and not self.size.positions
        if options.pairing == "exhaustive" or (options.pairing == "auto" and small):
            return every
        return min(every, self.costs.pairs * photos * options.neighbours / NEIGHBOURS)

    @property
    def reextraction_bytes(self) -> float:
        """Memory for further keypoints in photos that mapping could not place, which may be none."""
        return (
            REEXTRACTION_BYTES * MEGA * min(self.size.megapixels, REEXTRACTION_MEGAPIXELS) * max(1, self.threads // 2)
        )

    @property
    def judged_photos(self) -> int:
        """Number of held-out photos that are judged."""
        split, most = self.config.split, self.config.evaluate.most_views
        named = sum(bool(name.strip()) for name in split.views.split(","))
        held_out = named or (-(-self.size.photos // split.every) if split.every else 0)
        return min(held_out, most) if most else held_out

    @property
    def training_megapixels(self) -> float:
        """Megapixels of a training photo at the finest level."""
        return min(self.dataset_megapixels, self.config.train.max_megapixels or self.dataset_megapixels)

    @property
    def dataset_megapixels(self) -> float:
        """Megapixels of a photo in the dataset."""
        return min(self.size.megapixels, self.config.undistort.max_megapixels)

    @property
    def footage(self) -> PhotoSizes:
        """The photos at training size, and the largest window that memory allows."""
        height = math.sqrt(MEGA * self.training_megapixels * self.size.shape)
        window, limit = WINDOW_PIXELS["cpu"], self.config.train.max_memory_bytes
        if limit:
            window = window_within(limit - LIBRARIES_BYTES - FIXED_BYTES, window)
        return PhotoSizes(((max(1, round(height / self.size.shape)), max(1, round(height)), self.size.photos),), window)

    @property
    def window(self) -> float:
        """Largest number of megapixels in one iteration."""
        footage = self.footage
        return max(footage.pixels(each.training_size) for each in stretches(footage, self.lengths)) / MEGA

    @property
    def iterations(self) -> int:
        """Number of training iterations; with blocks, of the coarse pass and all blocks."""
        lengths = self.lengths if self.blocks is None else (*self.blocks.coarse, *self.blocks.lengths)
        return sum(count for _level, count in lengths)

    @property
    def training(self) -> float:
        """Training work of all iterations (or of all blocks), in megapixels; Gaussians count as equivalent
        megapixels."""
        if self.blocks is None:
            return self._training(self.footage, self.lengths, self.gaussians)
        return self.blocks_training(self.blocks.lengths, self.blocks.load)

    def blocks_training(self, lengths: Sequence[Length], load: BlockLoad) -> float:
        """Training work of blocks with the given iterations and numbers of Gaussians, in megapixels."""
        assert self.blocks is not None
        return self._training(self.blocks.footage, lengths, load.trained, load.frozen)

    @property
    def coarse_training(self) -> float:
        """Training work of the coarse pass before blocks, in megapixels; 0 without blocks."""
        if self.blocks is None:
            return 0.0
        return self._training(self.blocks.footage, self.blocks.coarse, self.blocks.coarse_gaussians)

    @staticmethod
    def _training(footage: PhotoSizes, lengths: Sequence[Length], gaussians: float, frozen: float = 0.0) -> float:
        done, total = 0, 0.0
        for stretch in stretches(footage, lengths):
            count, share = stretch.until - done, footage.share(stretch.training_size)
            cost = GAUSSIAN_MEGAPIXELS * (UNSEEN_SHARE + (1.0 - UNSEEN_SHARE) * share)
            there = gaussians * _mean_growth(lengths, done, stretch.until) + frozen
            total += count * (footage.pixels(stretch.training_size) / MEGA + cost * there)
            done = stretch.until
        return total

    @property
    def most_gaussians(self) -> float:
        """Largest number of Gaussians that the options, including a memory limit, allow."""
        options = self.config.train
        if not options.max_memory_bytes:
            return float(options.max_gaussians)
        taken = LIBRARIES_BYTES + FIXED_BYTES + PIXEL_BYTES * MEGA * self.window
        room = max(0.0, options.max_memory_bytes - taken)
        return min(float(options.max_gaussians), room / bytes_per_gaussian(options.sh_degree))

    @property
    def grown(self) -> float:
        """Expected number of Gaussians after density control, before limits."""
        auto, photos = self.config.train.iterations == "auto", self.size.photos
        pace, turn = (self.config.train.least_iterations, photos) if auto else (self.iterations, 1)
        first, every = max(1, min(500, pace // 5), turn), max(1, min(100, pace // 10), turn)
        steps = max(1.0, 1.0 + (growth_until(self.lengths) - first) // every)
        longer, larger = steps / PREVIEW_STEPS, self.training_megapixels / PREVIEW_MEGAPIXELS
        return float(self.costs.gaussians * self.size.photos * longer**STEPS_POWER * larger**SIZE_POWER)

    @property
    def film_pixels(self) -> float:
        """Total megapixels of the film's frames."""
        film, budget = self.config.flythrough, self.config.train.time_budget_s
        if 0.0 < budget < FILM_FROM_BUDGET_S:
            return 0.0
        size = film.film_size
        frame = size[0] * size[1] / MEGA if size else min(self.training_megapixels, MAX_FILM_MEGAPIXELS)
        return film.seconds * film.fps * frame

    def units(self) -> dict[str, WorkUnits]:
        """Return the units of each stage, including those that are turned off."""
        size, train = self.size, self.config.train
        photos, pixels = float(size.photos), size.photos * size.megapixels
        keypoints, gaussians = photos * self.keypoints, float(self.gaussians)
        judged = self.judged_photos * min(self.dataset_megapixels, JUDGED_MEGAPIXELS)
        depths = photos * min(self.dataset_megapixels, self.config.depths.max_megapixels)
        looked_through = photos * min(self.dataset_megapixels, SEEN_MEGAPIXELS)
        extractor, at_once = self.config.features.extractor, float(self.threads * size.megapixels)
        mapping = (max(photos, PHOTOS_OF_ONE_COST) / PHOTOS_OF_ONE_COST) ** MAPPING_GROWTH
        mapping *= 1.0 if size.positions else WITHOUT_POSITIONS
        done = self.done
        state = bytes_per_gaussian(train.sh_degree) * gaussians + PIXEL_BYTES * MEGA * self.window
        coarse_state = state
        if self.blocks is not None:
            resident = self.costs.stages["train"].resident
            coarse_load = BlockLoad(self.blocks.coarse_gaussians, 0.0)
            state, coarse_state = (self.block_memory_bytes(load) - resident for load in (self.blocks.load, coarse_load))
        looked = photos * self.keypoint_megapixels * SIFT_WORK[extractor]
        looked_at_once = self.threads * self.keypoint_megapixels * SIFT_MEMORY[extractor]
        controlled = float(size.control)
        targets_at_once = self.threads * min(size.megapixels, TARGETS_TILE)
        return {
            "ingest": WorkUnits(pixels, 0.0, photos),
            "control": WorkUnits(controlled, 0.0, controlled),
            "features": WorkUnits(looked, looked_at_once, keypoints),
            "matches": WorkUnits(self.pairs * self.keypoints, float(self.threads), keypoints),
            "sparse": WorkUnits(photos * mapping, math.sqrt(photos), keypoints, self.reextraction_bytes),
            "targets": WorkUnits(controlled * pixels, controlled * targets_at_once, controlled * photos),
            "georef": WorkUnits(photos, keypoints, keypoints),
            "undistort": WorkUnits(pixels, at_once, photos * self.dataset_megapixels),
            "split": WorkUnits(photos, 0.0, photos),
            "initialize": WorkUnits(photos if self.config.initialize.dense else 0.0, 0.0, START_SHARE * gaussians),
            "blocks": WorkUnits(done * self.coarse_training, coarse_state, 0.0),
            "train": WorkUnits(done * self.training, state, gaussians),
            "clean": WorkUnits(looked_through, gaussians, gaussians),
            "evaluate": WorkUnits(JUDGED_ONE_IN * judged, gaussians, JUDGED_ONE_IN * judged),
            "export": WorkUnits(gaussians, gaussians, gaussians),
            "flythrough": WorkUnits(self.film_pixels, gaussians if self.film_pixels else 0.0, self.film_pixels),
            "depths": WorkUnits(depths, 0.0, depths),
            "dsm": WorkUnits(pixels, 0.0, pixels),
            "ortho": WorkUnits(pixels, 0.0, pixels),
            "splat_depths": WorkUnits(depths, 0.0, depths),
            "facades": WorkUnits(pixels, 0.0, pixels),
            "cloud": WorkUnits(pixels, 0.0, pixels),
            "mesh": WorkUnits(pixels, 0.0, pixels),
        }

    @property
    def done(self) -> float:
        """Expected share of the iterations that training runs; blocks run all, as they see each window about ten
        times."""
        train = self.config.train
        ends_flat = train.stop_when_flat and not train.time_budget_s and self.blocks is None
        return self.costs.flat if ends_flat else 1.0

    def block_memory_bytes(self, load: BlockLoad) -> int:
        """Expected memory of the process that trains a block, bytes; never more than its limit."""
        assert self.blocks is not None
        limit = self.blocks.division.limit_bytes
        taken = int(self.costs.stages["train"].resident) + self.blocks.memory_bytes(load)
        return min(taken, limit) if limit else taken

    @property
    def blocks_iterations(self) -> int:
        """Number of iterations of all blocks."""
        return 0 if self.blocks is None else sum(count for _level, count in self.blocks.lengths)

    def needs(self, speed: float) -> dict[str, Need]:
        """Return the resources of each stage on a machine of the given relative speed; zero if a stage is turned
        off."""
        most, found = self.config.train.max_memory_bytes, {}
        for stage, units in self.units().items():
            if getattr(self.config, stage).is_off:
                found[stage] = Need(0, 0.0, 0)
                continue
            cost = self.costs.stages[TRAINING.get(stage, stage)]
            memory = cost.resident + cost.memory * units.memory + units.fixed_bytes
            if stage in TRAINING and most:
                memory = min(memory, most)
            found[stage] = Need(
                int(memory),
                (cost.cpu * units.cpu + self._start_s(stage) + self._formats_s(stage)) / speed,
                int(cost.disk * units.disk) + self._disk_of_blocks(stage) + self._disk_of_formats(stage),
                self._scratch(stage, units),
                PARALLEL.get(stage, 0.0),
            )
        return found

    def _start_s(self, stage: str) -> float:
        """CPU seconds for laying out blocks and for starting each of them."""
        if self.blocks is None:
            return 0.0
        return {
            "blocks": LAYOUT_S * self.size.photos * self.blocks.blocks_per_photo,
            "train": START_S * self.blocks.division.blocks,
        }.get(stage, 0.0)

    def _formats_s(self, stage: str) -> float:
        """CPU seconds for writing the export formats."""
        formats = parse_formats(self.config.export.formats) if stage == "export" else ()
        each = sum(FORMAT_COSTS[name].cpu for name in formats if name in FORMAT_COSTS)
        return self.gaussians * (each + (LEVELS_CPU if IN_LEVELS & set(formats) else 0.0))

    def _disk_of_formats(self, stage: str) -> int:
        """Bytes on disk of the export formats."""
        formats = parse_formats(self.config.export.formats) if stage == "export" else ()
        photos = self.size.photos * self.dataset_megapixels if WITH_PHOTOS & set(formats) else 0.0
        each = sum(FORMAT_COSTS[name].disk for name in formats if name in FORMAT_COSTS)
        return int(self.gaussians * each + self.costs.stages["undistort"].disk * photos)

    def _disk_of_blocks(self, stage: str) -> int:
        """Extra bytes that a stage writes if the scene is trained in blocks."""
        if self.blocks is None:
            return 0
        return {"blocks": self.blocks.coarse_bytes, "train": self.blocks.block_bytes}.get(stage, 0)

    def _scratch(self, stage: str, units: WorkUnits) -> int:
        """Bytes on disk while a stage runs: a copy of the features, or decoded photos and a checkpoint."""
        if stage in ("matches", "sparse"):
            return int(self.costs.stages["features"].disk * units.disk)
        decoded = PYRAMID * PHOTO_BYTES * MEGA * self.training_megapixels
        if stage == "train" and self.blocks is None:
            return int(decoded * self.size.photos + units.memory)
        if stage == "train" and self.blocks is not None:
            return int(decoded * self.blocks.photos) + self.blocks.load.work_bytes
        if stage == "blocks" and self.blocks is not None:
            (first, _count), *_ = self.blocks.coarse
            coarse = BlockLoad(self.blocks.coarse_gaussians, 0.0)
            return int(decoded * self.size.photos / 4**first) + coarse.work_bytes
        return 0


def _mean_growth(lengths: Sequence[Length], start: int, end: int) -> float:
    """Mean share of the final number of Gaussians in a range of iterations.

    Growth follows x (2 - x), x being the share of the growth phase, and is complete after it."""
    last = max(1, growth_until(lengths))
    middles = (start + (step + 0.5) * (end - start) / GROWTH_SAMPLES for step in range(GROWTH_SAMPLES))
    shares = [min(1.0, middle / last) for middle in middles]
    return START_SHARE + (1.0 - START_SHARE) * sum(x * (2.0 - x) for x in shares) / GROWTH_SAMPLES
