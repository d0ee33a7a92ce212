"""Compare an iteration on a window with one on a whole photo of the same size: ``window_speed --data DATASET``.

The same scene with the same Gaussians is trained by training's own code, with exposures and the sky, on photos of
several sizes in turn, one iteration of each after the other, so that other load on the machine affects all equally.
Photos of the first size are whole; those of the others are seen in windows of at most that size, each window of each
photo equally often. Time is that of all compute threads, including the one that reads windows. Photos are decoded
beforehand.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import time
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from measure import (
    PUBLISHED_ITERATIONS,
    SilentReporter,
    machine,
    parse,
    parser,
    prepare,
    report,
    scratch,
    size_factor,
)
from rasterizing import contributing_pairs
from tables import Row

from splatpipe.pipeline.photos.pixels.dataset import Split, load_views
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.iteration import iterate
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import PhotoStream
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan
from splatpipe.pipeline.train.plan.windows import TrainingSize
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.pipeline.train.techniques.techniques import begin_sky, make_techniques

WARMUP = 4  # iterations of each that are not measured
ROUNDING = 1.01  # sides are whole pixels, so a quarter of 4 MP is slightly more than 1 MP
COLUMNS = {
    "photos of MP": "megapixels:.1f",
    "seen": "seen:",
    "counted MP": "counted_megapixels:.3f",
    "rendered MP": "rendered_megapixels:.3f",
    "CPU ms": "cpu_s:ms",
    "mean": "cpu_mean_s:ms",
    "pairs/px": "pairs_per_pixel:.1f",
    "of a whole": "ratio:.3f",
    "mean of a whole": "mean_ratio:.3f",
    "a counted MP": "ratio_per_counted:.3f",
}


@dataclass
class TimedTraining:
    """A training on photos of one size, and what its iterations took.

    Attributes:
        name: How its photos are seen.
        megapixels: Size of its photos.
        plan: Its plan.
        state: Its state.
        photos: Photos of its iterations.
        cpu_s: CPU seconds of each iteration.
        loss_pixels: Pixels in the loss, in total.
        rendered: Pixels rendered, in total.
        pairs: Pairs that the rasterizer blended, in total.
    """

    name: str
    megapixels: float
    plan: TrainingPlan
    state: TrainState
    photos: PhotoStream
    cpu_s: list[float] = field(default_factory=list)
    loss_pixels: int = 0
    rendered: int = 0
    pairs: int = 0

    def turn(self) -> None:
        """Run one measured iteration."""
        began = time.process_time()
        photo = next(self.photos)
        iterate(self.state, self.plan, photo)
        self.cpu_s.append(time.process_time() - began)
        size = photo.camera.width * photo.camera.height
        left, top, right, bottom = photo.inner or (0, 0, photo.camera.width, photo.camera.height)
        self.loss_pixels += (right - left) * (bottom - top)
        self.rendered += size
        self.pairs += contributing_pairs(self.state.gaussians, photo.camera, self.plan, self.state.iteration)

    def row(self, whole: TimedTraining) -> Row:
        """Return its figures beside those of the whole photos."""
        turns = len(self.cpu_s)
        median, mean = statistics.median(self.cpu_s), statistics.fmean(self.cpu_s)
        ratio, mean_ratio = median / statistics.median(whole.cpu_s), mean / statistics.fmean(whole.cpu_s)
        return {
            "megapixels": self.megapixels,
            "seen": self.name,
            "gaussians": len(self.state.gaussians),
            "iterations": turns,
            "counted_megapixels": 1e-6 * self.loss_pixels / turns,
            "rendered_megapixels": 1e-6 * self.rendered / turns,
            "cpu_s": median,
            "cpu_mean_s": mean,
            "pairs_per_pixel": self.pairs / self.rendered,
            "ratio": ratio,
            "mean_ratio": mean_ratio,
            "ratio_per_counted": mean_ratio * whole.loss_pixels / self.loss_pixels,
        }


def begin(
    dataset: Path, start: Gaussians, sizes: list[TrainingSize], threads: int
) -> tuple[TrainingPlan, TrainState, PhotoStream]:
    """Start a training with fixed Gaussians and the rates of a long run, photos decoded and sky detected."""
    views = load_views(dataset)
    config = TrainConfig(iterations=PUBLISHED_ITERATIONS, max_gaussians=10**9, exposure="affine")
    plan = make_plan(config, views, Split(tuple(view.camera.name for view in views)), len(start))
    if len(sizes) >= plan.schedule.density.first:
        raise SystemExit(f"{len(sizes)} iterations reach density control; take fewer repeats.")
    photos = PhotoStream.over(views, sizes, 0, 1, dataset)
    photos.fill(SilentReporter())
    with same_bits(threads):
        sky = begin_sky(config, views, dataset, threads, SilentReporter())
        return plan, TrainState.begin(start, plan, make_techniques(plan, sky, views, dataset)), photos


def measure(arguments: argparse.Namespace, folder: Path) -> list[Row]:
    """Return the figures of each size."""
    window = round(1e6 * arguments.window * ROUNDING)
    runners: list[TimedTraining] = []
    with contextlib.ExitStack() as open_streams:
        for megapixels in (arguments.window, *arguments.megapixels):
            factor = size_factor(arguments.data, megapixels)
            dataset = prepare(arguments.data, arguments.points, factor, folder / str(megapixels), arguments.photos)
            start = read_splat(folder / str(arguments.window) / "init.ply")
            is_whole = megapixels == arguments.window
            sizes = [TrainingSize(0, 0 if is_whole else window)] * (WARMUP + arguments.repeats)
            plan, state, photos = begin(dataset, start, sizes, arguments.threads)
            name = "whole" if is_whole else "in windows"
            runners.append(TimedTraining(name, megapixels, plan, state, open_streams.enter_context(photos)))
        with same_bits(arguments.threads):
            for runner in runners:
                for photo in islice(runner.photos, WARMUP):
                    iterate(runner.state, runner.plan, photo)
            for number in range(arguments.repeats):
                for place in range(len(runners)):
                    runners[(number + place) % len(runners)].turn()
    return [runner.row(runners[0]) for runner in runners]


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--window", type=float, default=1.0, help="megapixels that count in an iteration at most")
    options.add_argument("--megapixels", type=float, nargs="+", default=[4.0, 20.0], help="of the photos in windows")
    options.add_argument("--points", default="sparse", help="name of the point set")
    options.add_argument("--photos", type=int, default=4, help="so many, the first in name order")
    options.add_argument("--repeats", type=int, default=80, help="iterations that count: whole rounds of the windows")
    arguments = parse(options)
    facts = machine(arguments.threads)
    with scratch() as folder:
        report("window_speed", facts, measure(arguments, folder), COLUMNS, arguments.json)


if __name__ == "__main__":
    main()
