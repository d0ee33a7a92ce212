"""Shared by the benchmarks: datasets of a given size, cases in their own processes, timers of an iteration's parts."""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import torch
from ceilings import measure_ceilings
from commands import benchmark
from rasterizing import contributing_pairs, raster_alone
from tables import Row, console, print_table

from splatpipe.pipeline.engine.heap import keep_freed_heap
from splatpipe.pipeline.engine.runs.job_runner import versions
from splatpipe.pipeline.engine.runs.peak_memory import peak_memory_bytes
from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.options import InitializeConfig
from splatpipe.pipeline.native import _native
from splatpipe.pipeline.photos.pixels.dataset import IMAGES, MODEL, Split, View, load_views, mask_path
from splatpipe.pipeline.photos.pixels.images import load_colour, load_mask
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.isa import isa_name
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.train import iteration
from splatpipe.pipeline.train.iteration import iterate
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import PhotoStream
from splatpipe.pipeline.train.plan.plan import make_plan
from splatpipe.pipeline.train.plan.windows import TrainingSize
from splatpipe.pipeline.train.random_numbers import permutation
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.pipeline.train.techniques.techniques import make_techniques
from splatpipe.stages import initialize

PUBLISHED_ITERATIONS = 30_000  # learning rates of a long run, so the measured iterations hardly change the model
PARTS = ("forward", "loss", "backward", "adam")


@dataclass(frozen=True)
class InitialSettings:
    """How the points of a dataset become initial Gaussians.

    Attributes:
        options: Options of `initialize`.
        held_out: Names of photos that must not influence it.
    """

    options: InitializeConfig
    held_out: tuple[str, ...] = ()


DEFAULT_START = InitialSettings(InitializeConfig(dense=False))  # sparse points alone keep the workload fixed


class SilentReporter:
    """A stage's Reporter that discards everything."""

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None: ...
    def metric(self, name: str, value: float, step: int | None = None) -> None: ...
    def warning(self, message: str, hint: str = "") -> None: ...
    def note(self, message: str) -> None: ...


@dataclass(frozen=True)
class TimingCase:
    """Training iterations to be timed in a process of their own.

    Attributes:
        dataset: Folder with photos of the right size and their cameras.
        splat: The initial Gaussians.
        threads: Compute threads.
        repeats: Number of measured iterations.
        warmup: Iterations before them; at least an epoch, so that every photo is decoded.
        sh_degree: SH degree, active in full from the first measured iteration.
        seed: Seed of the order of photos.
        statistics: Collect the statistics of density control, as the first half of a training does.
    """

    dataset: str
    splat: str
    threads: int
    repeats: int = 30
    warmup: int = 5
    sh_degree: int = 3
    seed: int = 0
    statistics: bool = True


@dataclass
class IterationParts:
    """Seconds that each part of an iteration took, one value per iteration.

    Attributes:
        wall_s: Wall-clock seconds.
        cpu_s: CPU seconds of all threads.
    """

    wall_s: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in (*PARTS, "iteration")})
    cpu_s: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in (*PARTS, "iteration")})

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function wrapped with a timer that records under a name."""

        @functools.wraps(function)
        def run(*arguments: Any, **options: Any) -> Any:
            wall, cpu = time.perf_counter(), time.process_time()
            result = function(*arguments, **options)
            self.wall_s[name].append(time.perf_counter() - wall)
            self.cpu_s[name].append(time.process_time() - cpu)
            return result

        return run

    def row(self) -> Row:
        """Return medians and minima; ``rest`` is the part of an iteration that no timer covers."""
        row: Row = {}
        for kind, times in (("wall", self.wall_s), ("cpu", self.cpu_s)):
            row[f"{kind}_s"] = statistics.median(times["iteration"])
            row[f"{kind}_min_s"] = min(times["iteration"])
            row |= {f"{name}_{kind}_s": statistics.median(times[name]) for name in PARTS}
            in_parts = zip(*(times[name] for name in PARTS), strict=True)
            rest = [whole - sum(parts) for whole, parts in zip(times["iteration"], in_parts, strict=True)]
            row[f"rest_{kind}_s"] = statistics.median(rest)
        return row


@contextlib.contextmanager
def timed_parts(parts: IterationParts) -> Iterator[None]:
    """Time the functions that ``iterate`` calls while the context lasts."""
    places = ((rasterizer, "render"), (iteration, "photo_loss"), (torch.Tensor, "backward"), (TrainState, "step"))
    with contextlib.ExitStack() as undo:
        for part, (owner, name) in zip(PARTS, places, strict=True):
            function = getattr(owner, name)
            setattr(owner, name, parts.timed(part, function))
            undo.callback(setattr, owner, name, function)
        yield


def time_case(case: TimingCase) -> Row:
    """Train a few iterations with training's own code at a fixed number of Gaussians, and return their times.

    Memory is the process's peak above what it had with its libraries imported, as measured by this call.
    """
    before = restart_peak()
    keep_freed_heap()  # as a training does
    config = TrainConfig(
        iterations=PUBLISHED_ITERATIONS,
        sh_degree=case.sh_degree,
        seed=case.seed,
        max_gaussians=10**9,
        densify=case.statistics,
    )
    views = load_views(Path(case.dataset))
    start = read_splat(Path(case.splat))
    plan = make_plan(config, views, Split(tuple(view.camera.name for view in views)), len(start))
    plan = replace(plan, schedule=replace(plan.schedule, sh_every=1))
    warmup = max(case.warmup, len(views))
    steps = warmup + case.repeats
    if steps >= plan.schedule.density.first:
        raise SystemExit(f"{steps} iterations reach density control; take fewer repeats.")
    parts, pairs, pixels = IterationParts(), [], 0
    with (
        same_bits(case.threads),
        PhotoStream.over(views, [TrainingSize()] * steps, case.seed, 1, Path(case.dataset)) as photos,
    ):
        state = TrainState.begin(start, plan, make_techniques(plan))
        for photo in islice(photos, warmup):
            iterate(state, plan, photo)

        def one() -> str:
            photo = next(photos)
            iterate(state, plan, photo)
            return photo.camera.name

        for _ in range(case.repeats):
            camera = camera_of(views, case.seed, state.iteration + 1)
            pairs.append(contributing_pairs(state.gaussians, camera, plan, state.iteration + 1))
            pixels += camera.width * camera.height
            with timed_parts(parts):
                trained_on = parts.timed("iteration", one)()
            assert trained_on == camera.name
        alone = raster_alone(state, plan, [camera_of(views, case.seed, 1 + i) for i in range(case.repeats)])
    return (
        {
            "gaussians": len(state.gaussians),
            "megapixels": round(1e-6 * pixels / case.repeats, 6),
            "threads": case.threads,
            "sh_degree": state.gaussians.sh_degree,
            "peak_bytes": peak_memory_bytes() - before,
            "pairs": round(statistics.fmean(pairs)),
            "pairs_per_pixel": sum(pairs) / pixels,
            "gpairs_per_s_per_core": 1e-9 * sum(pairs) / sum(parts.cpu_s["forward"] + parts.cpu_s["backward"]),
        }
        | alone
        | parts.row()
    )


def camera_of(views: Sequence[View], seed: int, number: int) -> Camera:
    """Return the camera of the view used in an iteration (from 1)."""
    epoch, place = divmod(number - 1, len(views))
    return views[int(permutation(seed, epoch, len(views))[place])].camera


def restart_peak() -> int:
    """Reset the kernel's record of this process's peak memory, and return its current memory, bytes."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return peak_memory_bytes()


def point_sets(data: Path) -> list[Path]:
    """List a dataset's sparse models, each a folder that contains `0`: `sparse`, and others named after it."""
    found = sorted(path.parent for path in data.glob("sparse*/0") if path.is_dir())
    if not found:
        raise SystemExit(f"{data} has no sparse/0.")
    return found


def prepare(
    data: Path,
    points: str,
    factor: float,
    folder: Path,
    photos: int | None = None,
    start: InitialSettings = DEFAULT_START,
) -> Path:
    """Write a dataset's photos and cameras at another size, lossless, in training's input format.

    Args:
        data: The dataset, undistorted.
        points: Folder name of the sparse model to use.
        factor: Scale factor of both sides of every photo.
        folder: Output folder.
        photos: Number of photos, the first in name order; None for all.
        start: How the points become Gaussians.
    """
    whole = folder / "whole"  # the whole data set, its parts linked under the pipeline's names
    whole.mkdir(parents=True)
    for link, target in ((IMAGES, IMAGES), ("masks", "masks"), ("sparse", points)):
        if (data / target).is_dir():
            (whole / link).symlink_to((data / target).resolve())
    model = pycolmap.Reconstruction(whole / MODEL)
    views = load_views(whole)
    kept = views[:photos]
    for view in views[len(kept) :]:
        model.deregister_frame(model.find_image_with_name(view.camera.name).frame_id)
    for camera in model.cameras.values():
        camera.rescale(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))
    (folder / MODEL).mkdir(parents=True)
    model.write(folder / MODEL)
    for view in kept:
        size = (max(1, round(view.camera.width * factor)), max(1, round(view.camera.height * factor)))
        how = cv2.INTER_AREA if factor < 1.0 else cv2.INTER_LINEAR
        _write_png(
            folder / IMAGES / view.camera.name, cv2.resize(load_colour(view), size, interpolation=how)[:, :, ::-1]
        )
        if (mask := load_mask(view)) is not None:
            masked = cv2.resize((~mask).astype(np.float32), size, interpolation=how)  # the share of masked pixels
            _write_png(mask_path(folder, view.camera.name), np.where(masked == 0.0, 255, 0))
    split = Split(tuple(view.camera.name for view in kept if view.camera.name not in start.held_out), start.held_out)
    (folder / "split.json").write_text(split.to_json())
    parts = {"undistort.dataset": whole, "split.views": folder / "split.json"}
    initialize.run(start.options, Inputs(parts, folder), folder, SilentReporter())
    return folder


def _write_png(path: Path, pixels: Any) -> None:
    """Write a PNG, whatever the file's name: readers go by content."""
    path.parent.mkdir(parents=True, exist_ok=True)
    _, data = cv2.imencode(".png", np.ascontiguousarray(pixels, np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    path.write_bytes(data.tobytes())


def size_factor(data: Path, megapixels: float) -> float:
    """Return the scale factor of the sides that gives a dataset's first photo a size."""
    camera = load_views(data)[0].camera
    return float((1e6 * megapixels / (camera.width * camera.height)) ** 0.5)


def parser(text: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options that all benchmarks share."""
    options = argparse.ArgumentParser(description=text)
    options.add_argument("--data", type=Path, help="a folder with images/ and sparse/0, undistorted (PINHOLE)")
    options.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    options.add_argument("--json", type=Path, help="where the figures go")
    options.add_argument("--case", help=argparse.SUPPRESS)
    return options


def parse(options: argparse.ArgumentParser) -> argparse.Namespace:
    """Parse the command line.

    Raises:
        SystemExit: if it is invalid.
    """
    arguments = options.parse_args()
    if arguments.case is None and (arguments.data is None or not arguments.data.is_dir()):
        options.error("--data must be a folder with images/ and sparse/0")
    if arguments.threads < 1:
        options.error("--threads must be at least 1")
    return arguments


def run_apart(name: str, case: TimingCase, *options: str) -> Row:
    """Run a benchmark's ``--case`` in a process of its own and return the JSON that it prints last.

    Args:
        name: The benchmark.
        case: The case to pass.
        options: Its other options.

    Raises:
        SystemExit: if it fails; the benchmark has reported why.
    """
    text = json.dumps(asdict(case))
    words = [sys.executable, *benchmark(name, *options, "--case", text)]
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"A case of {name} failed: {text}")
    row: Row = json.loads(done.stdout.splitlines()[-1])
    return row


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """Yield a folder for the run's datasets."""
    folder = Path(tempfile.mkdtemp(prefix="splatpipe-bench-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


def machine(threads: int) -> Row:
    """Describe the machine that the figures were measured on, with its ceilings."""
    facts: Row = {"cpu": cpu_model(), "cores": os.cpu_count(), "isa": isa_name(), "isas": _native.isas()}
    facts |= {"system": f"{platform.system()} {platform.release()}", "versions": versions()}
    facts["load_average"] = os.getloadavg()[0]  # mean of the last minute: well above 0, the machine was not idle
    return facts | measure_ceilings(threads)


def cpu_model() -> str:
    """Return the processor's name, if the system reports it."""
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return platform.processor() or platform.machine()


def report(name: str, facts: Row, rows: Sequence[Row], columns: Mapping[str, str], path: Path | None) -> None:
    """Print a table of the rows and write all figures.

    Args:
        name: Name of the benchmark.
        facts: Facts about the machine and the run.
        rows: The figures.
        columns: As ``print_table`` takes them.
        path: Path of the JSON; None for none.
    """
    print_table(name, rows, columns)
    write_figures(name, facts, rows, path)


def write_figures(name: str, facts: Row, rows: Sequence[Row], path: Path | None) -> None:
    """Print the facts that are single values; write all facts and rows if there is a path."""
    for fact, value in facts.items():
        if isinstance(value, str | int | float):
            console().print(f"{fact}: {value}", highlight=False)
    if path is not None:
        text = json.dumps({"benchmark": name, "machine": facts, "rows": list(rows)}, indent=1, allow_nan=False)
        path.write_text(text + "\n", encoding="utf-8")
