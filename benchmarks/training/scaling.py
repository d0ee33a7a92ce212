"""Measure how training's cost grows: ``scaling --data DATASET --threads N --json FILE``.

Three series around one case: Gaussians, megapixels, threads. The Gaussians are the dataset's points, thinned or copied
with jitter, and sized so that equally many contribute to a pixel in every case: only their number changes. Every case
runs training's own code in a process of its own. ``ratio_to_linear`` is the time divided by a proportional
extrapolation from the series' first row: at most 1 if the cost grows no faster than linearly.

``--memory`` adds a series of whole training stages, with a step of density control that grows to the cap and with
checkpoints, for their peak memory; their times cover the whole stage, divided by its four iterations.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from measure import (
    Row,
    SilentReporter,
    TimingCase,
    contributing_pairs,
    machine,
    parse,
    parser,
    prepare,
    report,
    restart_peak,
    run_apart,
    scratch,
    size_factor,
    time_case,
)

from splatpipe.pipeline.engine.runs.peak_memory import peak_memory_bytes
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import Split, load_views
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.splat.containers.ply import read_splat, read_splat_header, write_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train import loop
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan import plan as planned
from splatpipe.pipeline.train.plan.lengths import PhotoSizes
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan
from splatpipe.pipeline.train.plan.schedule import UNKNOWN, Schedule, resolve_schedule
from splatpipe.stages import train

COLUMNS = {
    "series": "series:",
    "Gaussians": "gaussians:,",
    "MP": "megapixels:.2f",
    "threads": "threads:",
    "wall ms": "wall_s:ms",
    "CPU ms": "cpu_s:ms",
    "pairs/px": "pairs_per_pixel:.1f",
    "to linear": "ratio_to_linear:.2f",
    "peak MB": "peak_bytes:MB",
}
CALIBRATED = 0.02  # tolerance, relative to the target pairs per pixel
CALIBRATIONS = 8  # iterations at most: the blur prevents a million Gaussians from covering less of a small image
MAX_STEP = 1.5
INITIAL_SHARE = 0.9  # initial Gaussians over their cap: density control then grows to it
MEMORY_ITERATIONS = 4


def scattered(base: Gaussians, count: int) -> Gaussians:
    """Return ``count`` Gaussians: thinned evenly, or copies jittered by their own size."""
    index = torch.arange(count) * len(base) // count
    made = base.select(index)
    generator = torch.Generator().manual_seed(0)
    jitter = torch.randn(count, 3, generator=generator) * torch.exp(made.log_scales)
    first = torch.cat([torch.ones(1, dtype=torch.bool), index[1:] != index[:-1]])
    made.means = torch.where(first[:, None], made.means, made.means + jitter)
    return made


def sized(gaussians: Gaussians, cameras: Sequence[Camera], plan: TrainingPlan, wanted: float) -> Gaussians:
    """Scale all Gaussians equally until ``wanted`` of them contribute to the mean pixel.

    Args:
        gaussians: The Gaussians, changed in place.
        cameras: Cameras whose pixels are counted.
        plan: How they are rendered.
        wanted: Pairs per pixel.
    """
    pixels = sum(camera.width * camera.height for camera in cameras)
    for _ in range(CALIBRATIONS):
        found = sum(contributing_pairs(gaussians, camera, plan, 1) for camera in cameras) / pixels
        if abs(found / wanted - 1.0) < CALIBRATED:
            break
        # The area grows with the square of the size; steps are limited so that the next one still has pairs to measure.
        gaussians.log_scales += max(-MAX_STEP, min(MAX_STEP, 0.5 * math.log(wanted / max(found, 1e-3))))
    return gaussians


def write_start(dataset: Path, count: int, wanted: float, threads: int) -> Path:
    """Write the initial Gaussians of a case beside its dataset."""
    views = load_views(dataset)
    path = dataset / f"{count}.ply"
    with same_bits(threads):
        plan = make_plan(TrainConfig(), views, Split(tuple(view.camera.name for view in views)), count)
        made = scattered(read_splat(dataset / "init.ply"), count)
        write_splat(path, sized(made, [view.camera for view in views], plan, wanted))
    return path


def grown_in_the_middle(config: TrainConfig, footage: PhotoSizes = UNKNOWN) -> Schedule:
    """Return a schedule with one step of density control in which every visible Gaussian grows, up to the cap."""
    schedule = resolve_schedule(config, footage)
    middle = schedule.iterations // 2
    density = replace(schedule.density, first=middle, last=middle, every=middle, gradient=1e-12)
    return replace(schedule, sh_every=1, density=density)


def stage_case(case: TimingCase) -> Row:
    """Run the whole training stage for a few iterations, with density control up to the cap and checkpoints."""
    before = restart_peak()
    start = Path(case.splat)
    cap = round(read_splat_header(start).count / INITIAL_SHARE)
    config = TrainConfig(
        iterations=MEMORY_ITERATIONS,
        max_gaussians=cap,
        sh_degree=case.sh_degree,
        coarse_levels=0,
    )
    planned.resolve_schedule = grown_in_the_middle
    loop.CHECKPOINT_SECONDS, loop.CHECKPOINT_SHARE = 0.0, math.inf  # one after every iteration but the last
    parts = {"undistort.dataset": Path(case.dataset), "initialize.splat": start}
    names = [view.camera.name for view in load_views(Path(case.dataset))]
    parts["split.views"] = start.with_suffix(".split.json")
    parts["split.views"].write_text(Split(tuple(names)).to_json(), encoding="utf-8")
    out = start.with_suffix("")
    out.mkdir()
    wall, cpu = time.perf_counter(), time.process_time()
    summary = train.run(config, Inputs(parts, out, machine=Machine("cpu", case.threads)), out, SilentReporter())
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    grown = summary["gaussians"] > INITIAL_SHARE * cap
    if not (grown and (out / loop.CHECKPOINT).exists()):
        raise SystemExit("The stage left no checkpoint, or did not grow: its peak would say too little.")
    shutil.rmtree(out)
    row: Row = {"gaussians": summary["gaussians"], "threads": case.threads, "peak_bytes": peak_memory_bytes() - before}
    return row | {"wall_s": wall / MEMORY_ITERATIONS, "cpu_s": cpu / MEMORY_ITERATIONS}


def series(arguments: argparse.Namespace) -> Iterator[tuple[str, list[tuple[int, float, int]]]]:
    """Yield each series' name and its cases: Gaussians, megapixels, threads."""
    count, megapixels, threads = arguments.at_gaussians, arguments.at_megapixels, arguments.threads
    yield "gaussians", [(each, megapixels, threads) for each in arguments.gaussians]
    yield "megapixels", [(count, each, threads) for each in arguments.megapixels]
    some = sorted({min(1 << power, threads) for power in range(threads.bit_length() + 1)})
    yield "threads", [(count, megapixels, each) for each in some]
    if arguments.memory:
        yield "memory", [(each, megapixels, threads) for each in arguments.gaussians]


def with_ratio(rows: list[Row]) -> list[Row]:
    """Return a series' rows, each with its time divided by the first row's, extrapolated proportionally."""
    first = rows[0]
    for row in rows:
        quantity = row["series"] if row["series"] in first else "gaussians"
        growth = row[quantity] / first[quantity]
        linear = first["wall_s"] * (1.0 / growth if quantity == "threads" else growth)
        row["ratio_to_linear"] = row["wall_s"] / linear
    return rows


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--gaussians", type=int, nargs="+", default=[10_000, 100_000, 1_000_000])
    options.add_argument("--megapixels", type=float, nargs="+", default=[0.1, 0.4, 1.6, 6.0])
    options.add_argument("--at-gaussians", type=int, default=100_000, help="where the other two series are taken")
    options.add_argument("--at-megapixels", type=float, default=1.6, help="where the other two series are taken")
    options.add_argument("--pairs", type=float, default=30.0, help="contributing Gaussians of the mean pixel")
    options.add_argument("--photos", type=int, default=4, help="trained on, the first in name order")
    options.add_argument("--repeats", type=int, default=8, help="iterations that count")
    options.add_argument("--memory", action="store_true", help="also whole training stages, for their peak memory")
    options.add_argument("--stage", action="store_true", help=argparse.SUPPRESS)
    arguments = parse(options)
    if arguments.case is not None:
        measured = stage_case if arguments.stage else time_case
        print(json.dumps(measured(TimingCase(**json.loads(arguments.case)))))
        return
    facts, rows, done = machine(arguments.threads), [], {}
    with scratch() as folder:
        for name, cases in series(arguments):
            of_series = []
            for count, megapixels, threads in cases:
                key = (name == "memory", count, megapixels, threads)
                if key not in done:
                    done[key] = run_case(arguments, folder, *key)
                of_series.append({"series": name} | done[key])
            rows += with_ratio(of_series)
    report("scaling", facts, rows, COLUMNS, arguments.json)


def run_case(
    arguments: argparse.Namespace, folder: Path, memory: bool, count: int, megapixels: float, threads: int
) -> Row:
    """Run one case in a process of its own; the datasets, one per size, are kept for the other cases."""
    dataset = folder / f"{megapixels}"
    if not dataset.exists():
        prepare(arguments.data, "sparse", size_factor(arguments.data, megapixels), dataset, arguments.photos)
    begun_with = round(INITIAL_SHARE * count) if memory else count
    start = write_start(dataset, begun_with, arguments.pairs, arguments.threads)
    case = TimingCase(str(dataset), str(start), threads, arguments.repeats, warmup=arguments.photos)
    row = {"megapixels": megapixels} | run_apart("scaling", case, *(["--stage"] if memory else []))
    start.unlink()
    return row


if __name__ == "__main__":
    main()
