"""Measure held-out quality over time: ``time_to_quality --data DATASET --held-out NAME --json FILE``.

The pipeline's own training with its defaults for that number of iterations. Every few CPU seconds the clocks are
paused, and the held-out view is rendered and measured as in `evaluate`, in 8 bits. The clocks run from the first
iteration: photos are downsampled and the Gaussians initialized beforehand, as in the stages before training.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from measure import (
    InitialSettings,
    Row,
    SilentReporter,
    machine,
    parse,
    parser,
    prepare,
    report,
    restart_peak,
    scratch,
    size_factor,
)

from splatpipe.pipeline.engine.config import parse_set, resolve
from splatpipe.pipeline.engine.runs.peak_memory import peak_memory_bytes
from splatpipe.pipeline.photos.pixels.dataset import load_views, split_views
from splatpipe.pipeline.photos.pixels.images import load_colour, load_mask
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render.rendering import render_pixels
from splatpipe.pipeline.render.view_measures import measure
from splatpipe.pipeline.train.appearance.brightness import decided_exposure
from splatpipe.pipeline.train.appearance.sky import SkyModel
from splatpipe.pipeline.train.flatness import ends_at
from splatpipe.pipeline.train.iteration import iterate
from splatpipe.pipeline.train.loop import training_sizes
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import PhotoStream
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan
from splatpipe.pipeline.train.plan.start import read_start
from splatpipe.pipeline.train.plan.training_order import PhotoOrder
from splatpipe.pipeline.train.state.history import History
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.pipeline.train.techniques.techniques import begin_sky, make_techniques
from splatpipe.stages.options import LineConfig

COLUMNS = {
    "iteration": "iteration:,",
    "Gaussians": "gaussians:,",
    "MP": "megapixels:.2f",
    "threads": "threads:",
    "wall s": "wall_s:.1f",
    "CPU s": "cpu_s:.1f",
    "PSNR dB": "psnr:.2f",
    "PSNR cc": "psnr_cc:.2f",
    "SSIM": "ssim:.3f",
    "peak MB": "peak_bytes:MB",
}


@dataclass
class Clocks:
    """Time spent in training, excluding the measurements in between.

    Attributes:
        wall_s: Wall-clock seconds.
        cpu_s: CPU seconds of all threads.
    """

    wall_s: float = 0.0
    cpu_s: float = 0.0
    _since: tuple[float, float] = field(default=(0.0, 0.0))

    def start(self) -> None:
        """Resume the clocks."""
        self._since = time.perf_counter(), time.process_time()

    def stop(self) -> None:
        """Pause the clocks, and add the elapsed time."""
        self.wall_s += time.perf_counter() - self._since[0]
        self.cpu_s += time.process_time() - self._since[1]

    def cpu_now(self) -> float:
        """Return the CPU seconds so far, while the clocks run."""
        return self.cpu_s + time.process_time() - self._since[1]


def follow(dataset: Path, config: LineConfig, arguments: argparse.Namespace) -> Iterator[Row]:
    """Train, and measure the held-out views at intervals and at the end.

    Args:
        dataset: As written by ``measure.prepare``.
        config: Configuration of the pipeline.
        arguments: The parsed command line.
    """
    before = restart_peak()
    clocks, due, peak = Clocks(), arguments.every, 0
    views = load_views(dataset)
    start = read_start(dataset / "init.ply")
    split = split_views([view.camera.name for view in views], config.split.every, arguments.held_out)
    kept = set(split.train)
    trained_on = [view for view in views if view.camera.name in kept]
    options = decided_exposure(config.train, trained_on, dataset, arguments.threads, SilentReporter())
    room = start.within(options.max_gaussians)
    whole = plan = make_plan(options, views, split, len(room))

    def order_of(history: History) -> PhotoOrder:
        return PhotoOrder(
            [view.camera for view in trained_on], training_sizes(whole, history), whole.options.seed, whole.megapixels
        )

    with same_bits(arguments.threads):
        clocks.start()
        sky = begin_sky(options, trained_on, dataset, arguments.threads, SilentReporter())
        state = TrainState.begin(room, plan, make_techniques(plan, sky, trained_on, dataset))
        with PhotoStream(trained_on, order_of(state.history), 1, dataset) as photos:
            for photo in photos:
                iterate(state, plan, photo)
                ended = state.history.sizes_ended
                if state.iteration in ended[-1:]:
                    plan = whole.after(ended)
                    photos.switch_order(order_of(state.history), state.iteration + 1)
                last = state.iteration == ends_at(plan, state.history.flat_at)
                if clocks.cpu_now() < due and not last:
                    continue
                clocks.stop()
                due = clocks.cpu_s + arguments.every
                peak = max(peak, peak_memory_bytes() - before)
                row = {"iteration": state.iteration, "gaussians": len(state.gaussians), "threads": arguments.threads}
                row |= {"megapixels": plan.train_megapixels, "wall_s": clocks.wall_s, "cpu_s": clocks.cpu_s}
                yield row | held_out(state, plan, dataset) | {"peak_bytes": peak}
                if last:
                    return
                restart_peak()
                clocks.start()


def held_out(state: TrainState, plan: TrainingPlan, dataset: Path) -> Row:
    """Return mean PSNR, PSNR after a colour fit and SSIM of the held-out views, as measured by `evaluate`."""
    gaussians = state.finished()
    options = plan.rendering().options(gaussians)
    sky = state.techniques.find(SkyModel)
    model = (gaussians, None if sky is None else sky.panorama)
    measured = [
        measure(render_pixels(model, view.camera, options), load_colour(view), load_mask(view))
        for view in load_views(dataset)
        if view.camera.name in set(plan.test_views)
    ]
    values = {name: [float(found[name] or 0.0) for found in measured] for name in ("psnr", "psnr_cc", "ssim")}
    return {name: sum(each) / len(each) for name, each in values.items()}


def passed(rows: list[Row], marks: list[float]) -> Iterator[Row]:
    """Yield when each mark, dB, was first reached; only the mark if it never was."""
    for mark in marks:
        found = next((row for row in rows if row["psnr"] >= mark), None)
        keys = ("cpu_s", "wall_s", "iteration", "gaussians")
        yield {"mark_db": mark} | {key: None if found is None else found[key] for key in keys}


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--held-out", default="", help="photos to hold out, separated by commas; else split.every")
    size = options.add_mutually_exclusive_group()
    size.add_argument("--megapixels", type=float, help="size that photos are reduced to")
    size.add_argument("--scale", type=float, default=1.0, help="factor on their sides instead")
    options.add_argument("--points", default="sparse", help="name of the point set")
    options.add_argument("--iterations", type=int, default=7000)
    options.add_argument("--max-gaussians", type=int, default=TrainConfig().max_gaussians)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--every", type=float, default=5.0, help="CPU seconds between measurements")
    options.add_argument("--marks", type=float, nargs="*", default=[], help="PSNR whose time is asked for, dB")
    options.add_argument(
        "--set", nargs="*", default=[], metavar="SECTION.OPTION=VALUE", help="of split, initialize, train"
    )
    arguments = parse(options)
    facts = machine(arguments.threads)
    asked = {"iterations": arguments.iterations, "seed": arguments.seed, "max_gaussians": arguments.max_gaussians}
    config = resolve(LineConfig, [{"train": asked}, *(parse_set(each, LineConfig) for each in arguments.set)])
    with scratch() as folder:
        wanted = arguments.megapixels
        factor = arguments.scale if wanted is None else size_factor(arguments.data, wanted)
        names = [view.camera.name for view in load_views(arguments.data)]
        start = InitialSettings(config.initialize, split_views(names, config.split.every, arguments.held_out).held_out)
        dataset = prepare(arguments.data, arguments.points, factor, folder / "dataset", start=start)
        rows = list(follow(dataset, config, arguments))
    facts |= {
        "data": arguments.data.name,
        "held_out": arguments.held_out,
        "train": config.train.model_dump(mode="json"),
    }
    facts["marks"] = list(passed(rows, arguments.marks))
    report("time_to_quality", facts, rows, COLUMNS, arguments.json)
    for mark in facts["marks"]:
        reached = "not reached" if mark["cpu_s"] is None else f"{mark['cpu_s']:.1f} CPU s, {mark['wall_s']:.1f} s"
        print(f"{mark['mark_db']} dB: {reached}")


if __name__ == "__main__":
    main()
