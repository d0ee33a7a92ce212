"""What each stage will take of a machine: memory, CPU time and disk, from a capture's size and the options. Light.

A stage's work is counted in units (pixels looked at, pairs times keypoints, Gaussians) that follow from the size and
the options; `costs.py` has what a unit costs. Texture, overlap and sky are not known beforehand: captures of one size
differ by a factor of two in some stages and by less in the whole.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from splatpipe.pipeline.engine.needs import Need
from splatpipe.pipeline.engine.needs import whole as whole
from splatpipe.pipeline.engine.stage import Summary
from splatpipe.pipeline.train.limits import (
    FIXED_BYTES,
    PIXEL_BYTES,
    bytes_per_gaussian,
    worthwhile_iterations,
)
from splatpipe.stages.costs import REFERENCE, Costs
from splatpipe.stages.options import LineConfig

MEGA = 1e6
HEIGHT_SHARE = 0.72  # of a photo's longer side: between the 4:3 and the 3:2 of most cameras
SIFT_WORK = {"opencv-sift": 1.0, "sift": 4.2}  # times the CPU seconds of OpenCV's, a pixel; measured on the demo
SIFT_MEMORY = {"opencv-sift": 1.0, "sift": 1.5}  # the same of a thread's memory
MOST_KEYPOINTS = {"opencv-sift": 1.25, "sift": 1.3}  # times the keypoints asked for: orientations, scales taken whole
NEIGHBOURS = 20  # of the costs' pairs a photo
SPATIAL_LEAST = 3  # photos: fewer make no pairs to choose among
PHOTOS_OF_ONE_COST = 50  # a photo of a mapping of so many costs what the constant says, of a larger one more
MAPPING_GROWTH = 0.5  # power of the photos that a photo's mapping costs
FULL_GROWTH = 0.5  # of the run there is density control
GROWTH_MEAN = 5.0 / 6.0  # of the growth is there on average: x (2 - x) until half of the run, all of it from there on
PREVIEW_STEPS = 5  # of density control, which the costs' Gaussians were counted after
STEPS_POWER = 0.35  # of the steps, that Gaussians grow with
GAUSSIAN_SHARE = 3e-6  # of a megapixel's cost in an iteration, a Gaussian's own
FLAT_SHARE = 0.92  # of the iterations is done where a flat loss ends the training
START_SHARE = 0.2  # of the final Gaussians, at the start
HELD_OUT = 8.0  # one photo in so many, in the constants of evaluate
BUSY = 0.93  # of the threads, on average, in a training that fills a time budget
AFTER_TRAINING = ("evaluate", "export", "flythrough")
BEFORE_TRAINING = ("ingest", "features", "matches", "sparse", "georef", "undistort", "split", "initialize")
PARALLEL = {
    "ingest": 0.8,
    "features": 0.98,
    "matches": 0.97,
    "sparse": 0.2,
    "undistort": 0.8,
    "initialize": 0.85,
    "train": 0.93,
    "evaluate": 0.75,
    "export": 0.2,
    "flythrough": 0.7,
}
"""Of each stage's CPU seconds, what more threads divide among themselves; measured with one and two."""

SPEED_NUMBERS = 20_000  # of a text without repeats, whose packing is timed
SPEED_S = 0.008  # that the machine of the costs takes to pack it, undisturbed
SPEED_LEVEL = 6
SPEED_TRIES = 5  # the best of them counts: the others met somebody else's work
SPEED_RANGE = (0.25, 4.0)  # outside it the measurement is not believed


@dataclass(frozen=True)
class CaptureSize:
    """What is known of a capture before anything is done.

    Attributes:
        photos: How many.
        megapixels: Of one photo as flown, the median.
        positions: Whether most have a position.
    """

    photos: int
    megapixels: float
    positions: bool


def forecast(
    size: CaptureSize,
    config: LineConfig,
    threads: int = 2,
    *,
    speed: float = 1.0,
    costs: Costs = REFERENCE,
) -> dict[str, Need]:
    """What each stage takes, by its name.

    Args:
        size: Of the capture.
        config: The options, resolved.
        threads: That the run is given.
        speed: Of this machine's cores, as ``machine_speed`` says.
        costs: Of a unit of each stage's work.
    """
    work = _Work.of(size, config, costs)
    needs = {stage: work.need(stage, threads, speed) for stage in costs.cpu}
    if config.train.time_budget_s:
        needs["train"] = _filling(needs, work, threads, speed)
    return needs


@dataclass(frozen=True)
class Forecaster:
    """Forecasts for a run, as its stages finish.

    Attributes:
        config: The options, resolved.
        threads: That the run is given.
    """

    config: LineConfig
    threads: int

    @cached_property
    def speed(self) -> float:
        """Of this machine, measured once."""
        return machine_speed()

    def __call__(self, summaries: Mapping[str, Summary]) -> Mapping[str, Need]:
        """From what ``ingest`` counted; nothing before it, nor where the photos came otherwise."""
        counted = summaries.get("ingest")
        if not counted or not counted.get("photos"):
            return {}
        photos = int(counted["photos"])
        size = CaptureSize(photos, float(counted["megapixels"]) / photos, 2 * int(counted["positions"]) > photos)
        return forecast(size, self.config, self.threads, speed=self.speed)


def seconds(need: Need, threads: int) -> float:
    """How long a stage takes with so many cores to itself."""
    return need.seconds(threads)


def machine_speed() -> float:
    """How fast a core of this machine is, against that of the costs: a fixed piece of packing, 0.05 s."""
    text = " ".join(str(number * number % 9973) for number in range(SPEED_NUMBERS)).encode()
    took = []
    for _ in range(SPEED_TRIES):
        began = time.thread_time()
        zlib.compress(text, SPEED_LEVEL)
        took.append(time.thread_time() - began)
    least, most = SPEED_RANGE
    return min(most, max(least, SPEED_S / max(min(took), 1e-6)))


@dataclass(frozen=True)
class _Work:
    """The line's work on a capture, in the units of the costs."""

    size: CaptureSize
    config: LineConfig
    costs: Costs
    iterations: int
    gaussians: float

    @staticmethod
    def of(size: CaptureSize, config: LineConfig, costs: Costs) -> _Work:
        iterations = config.train.iterations
        work = _Work(size, config, costs, iterations, 0.0)
        return replace(work, gaussians=float(min(work.most_gaussians, work.grown(iterations))))

    @property
    def looked_at(self) -> float:
        """Megapixels of a photo in which keypoints are looked for."""
        return min(self.size.megapixels, HEIGHT_SHARE * self.config.features.max_image_size**2 / MEGA)

    @property
    def keypoints(self) -> float:
        """Of a photo."""
        options = self.config.features
        most = MOST_KEYPOINTS[options.extractor] * options.max_features
        return min(most, self.costs.keypoints[options.extractor] * self.looked_at)

    @property
    def pairs(self) -> float:
        """Of photos that are matched."""
        photos, options = self.size.photos, self.config.matches
        every = photos * (photos - 1) / 2
        small = photos <= options.exhaustive_up_to and not self.size.positions
        if options.pairing == "exhaustive" or (options.pairing == "auto" and small):
            return every
        return min(every, self.costs.pairs * photos * options.neighbours / NEIGHBOURS)

    @property
    def trained_at(self) -> float:
        """Megapixels of a training photo."""
        return min(self.size.megapixels, self.config.undistort.max_megapixels)

    @property
    def most_gaussians(self) -> int:
        """That the options, a limit of memory among them, let there be."""
        options = self.config.train
        most = options.max_gaussians
        if options.max_memory_bytes:
            taken = self.costs.resident["train"] + FIXED_BYTES + PIXEL_BYTES * MEGA * self.trained_at
            room = max(0.0, options.max_memory_bytes - taken)
            most = min(most, int(room / bytes_per_gaussian(options.sh_degree)))
        return most

    def grown(self, iterations: int) -> float:
        """Gaussians after density control, as the photos' detail asks for."""
        first, every = max(1, min(500, iterations // 5)), max(1, min(100, iterations // 10))
        steps = max(1.0, 1.0 + (FULL_GROWTH * iterations - first) // every)
        share = float((steps / PREVIEW_STEPS) ** STEPS_POWER)
        return self.costs.gaussians * self.size.photos * self.trained_at * share

    @property
    def frames(self) -> float:
        """Of the film, each of so many megapixels as a training photo."""
        film = self.config.flythrough
        if 0.0 < self.config.train.time_budget_s < 600.0:
            return 0.0
        return film.seconds * film.fps

    @property
    def film_megapixels(self) -> float:
        """Of a frame."""
        size = self.config.flythrough.film_size
        return size[0] * size[1] / MEGA if size else self.trained_at

    def iteration(self, gaussians: float) -> float:
        """Units of an iteration: megapixels, and Gaussians in their measure."""
        mean = gaussians * (START_SHARE + (1.0 - START_SHARE) * GROWTH_MEAN)
        return self.trained_at + GAUSSIAN_SHARE * mean

    def units(self) -> dict[str, float]:
        """Of CPU time."""
        photos, megapixels = float(self.size.photos), self.size.photos * self.size.megapixels
        done = FLAT_SHARE if self.config.train.stop_when_flat else 1.0
        growth = (max(photos, PHOTOS_OF_ONE_COST) / PHOTOS_OF_ONE_COST) ** MAPPING_GROWTH
        return {
            "ingest": megapixels,
            "features": photos * self.looked_at * SIFT_WORK[self.config.features.extractor],
            "matches": self.pairs * self.keypoints,
            "sparse": photos * self.keypoints * growth,
            "georef": photos,
            "undistort": megapixels,
            "split": photos,
            "initialize": photos if self.config.initialize.dense else 0.0,
            "train": done * self.iterations * self.iteration(self.gaussians),
            "evaluate": photos * self.trained_at,
            "export": float(self.gaussians),
            "flythrough": self.frames * self.film_megapixels,
        }

    def growing(self, stage: str, threads: int) -> float:
        """Units of memory besides what is resident."""
        photos, pixels = float(self.size.photos), threads * self.size.megapixels
        if stage == "train":
            state = bytes_per_gaussian(self.config.train.sh_degree) * self.gaussians
            return state + PIXEL_BYTES * MEGA * self.trained_at
        return {
            "ingest": 0.0,
            "features": threads * self.looked_at * SIFT_MEMORY[self.config.features.extractor],
            "matches": threads * self.keypoints,
            "sparse": photos * self.keypoints,
            "georef": photos * self.keypoints,
            "undistort": pixels,
            "split": 0.0,
            "initialize": 0.0,
            "evaluate": float(self.gaussians),
            "export": float(self.gaussians),
            "flythrough": float(self.gaussians),
        }[stage]

    def left(self, stage: str) -> float:
        """Units of disk."""
        photos, keypoints = float(self.size.photos), self.size.photos * self.keypoints
        return {
            "ingest": photos,
            "features": keypoints,
            "matches": keypoints,
            "sparse": keypoints,
            "georef": keypoints,
            "undistort": photos * self.trained_at,
            "split": photos,
            "initialize": START_SHARE * self.gaussians,
            "train": float(self.gaussians),
            "evaluate": photos * self.trained_at,
            "export": float(self.gaussians),
            "flythrough": self.frames * self.film_megapixels,
        }[stage]

    def need(self, stage: str, threads: int, speed: float) -> Need:
        costs = self.costs
        memory = costs.resident[stage] + costs.memory[stage] * self.growing(stage, threads)
        if stage == "train" and self.config.train.max_memory_bytes:
            memory = min(memory, self.config.train.max_memory_bytes)
        return Need(
            int(memory),
            costs.cpu[stage] * self.units()[stage] / speed,
            int(costs.disk[stage] * self.left(stage)),
            self._scratch(stage),
            PARALLEL.get(stage, 0.0),
        )

    def _scratch(self, stage: str) -> int:
        """Bytes that a stage takes while it runs: copies of the features, decoded photos and checkpoints."""
        photos, disk = self.size.photos, self.costs.disk
        if stage in ("matches", "sparse"):
            return int(disk["features"] * photos * self.keypoints)
        if stage == "train":
            state = bytes_per_gaussian(self.config.train.sh_degree) * self.gaussians
            return int(3 * MEGA * photos * self.trained_at + state)
        return 0


def _filling(needs: Mapping[str, Need], work: _Work, threads: int, speed: float) -> Need:
    """The training's need where it fills a time budget: the time that other stages leave, and what fits in."""
    budget = work.config.train.time_budget_s
    others = sum(needs[stage].seconds(threads) for stage in (*BEFORE_TRAINING, *AFTER_TRAINING))
    left = max(0.1 * budget, budget - others)
    iterations = worthwhile_iterations(left)
    cpu = left * (1.0 + BUSY * (threads - 1))
    room = cpu * speed / (work.costs.cpu["train"] * iterations) - work.trained_at
    gaussians = min(work.most_gaussians, work.grown(iterations), max(1000.0, room / GAUSSIAN_SHARE))
    planned = replace(work, iterations=iterations, gaussians=gaussians).need("train", threads, speed)
    return replace(planned, cpu_seconds=cpu)
