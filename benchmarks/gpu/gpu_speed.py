"""Parts of a visit to a GPU that measure speed and memory. Times by CUDA events, medians."""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from itertools import pairwise
from pathlib import Path

import gpu_scenes
import torch
from gpu_parts import Row
from gpu_proofs import SilentReporter
from gpu_scenes import MEGAPIXELS
from torch.profiler import ProfilerActivity, profile

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import load_split
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.cuda import cuda
from splatpipe.pipeline.raster.cuda.cuda_forecast import FrameFacts, FrameSize
from splatpipe.pipeline.raster.cuda_frame import TILE_PX
from splatpipe.pipeline.raster.definitions import RenderOptions
from splatpipe.pipeline.raster.device import Device, choose_device, cpu
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.appearance.brightness import decided_exposure
from splatpipe.pipeline.train.iteration import iterate
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import PhotoStream
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan
from splatpipe.pipeline.train.plan.windows import TrainingSize
from splatpipe.pipeline.train.state.state import TrainState
from splatpipe.pipeline.train.techniques.techniques import begin_sky, make_techniques

WARMUP, REPEATS = 30, 100  # iterations; the first ones determine how much room frames need
PROFILED = 20  # iterations
SHOWN_KERNELS = 25  # rows of the table of kernels, the slowest ones
COPY_BYTES = 1 << 32  # far larger than any cache
# Minimum traffic of a whole iteration, float32: a visible Gaussian's 59 parameters and 118 moments are read and written
# once, and the parameters read once more by the render; a pixel's colour, gradient and photo (8 bits) once each way.
FLOATS_A_GAUSSIAN = 2 * (59 + 118) + 59
BYTES_A_PIXEL = 4 * 3 * 4 + 3
MANY_PAIRS = 1 << 31
FOUR_K = (3840, 2160)
COVERING = 70_000  # Gaussians covering all of a 4K image: 2.27e9 pairs with its 32,400 tiles
# Nearest Gaussians that are rendered alone: more than a pixel blends, as each takes a hundredth of the light.
NEAREST_GAUSSIANS = 2000
FLUSHED = 1000  # iterations of the long training between rows


def card() -> Iterator[Row]:
    """Report what nvidia-smi says.

    Raises:
        SystemExit: if it finds no card.
    """
    fields = "name,driver_version,memory.total,compute_cap,clocks.sm,clocks.mem,power.limit"
    program = shutil.which("nvidia-smi")
    if program is None:
        raise SystemExit("there is no nvidia-smi")
    done = subprocess.run(
        [program, f"--query-gpu={fields}", "--format=csv,noheader"], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"nvidia-smi: {(done.stdout + done.stderr).strip()}")
    values = [text.strip() for text in done.stdout.strip().splitlines()[0].split(",")]
    yield dict(zip(fields.split(","), values, strict=False))


def event_times(function: Callable[[], object], repeats: int, where: torch.device) -> list[float]:
    """Return the seconds of each call on the device; by the wall clock if that is the CPU."""
    if where.type != "cuda":
        return [_wall(function) for _ in range(repeats)]
    events = [torch.cuda.Event(enable_timing=True) for _ in range(repeats + 1)]
    events[0].record()
    for event in events[1:]:
        function()
        event.record()
    torch.cuda.synchronize(where)
    return [1e-3 * before.elapsed_time(after) for before, after in pairwise(events)]


def copy_bandwidth(where: torch.device, size: int = COPY_BYTES) -> float:
    """Return the bandwidth of a device-to-device copy, bytes read and written per second."""
    source = torch.empty(size, dtype=torch.uint8, device=where).random_()
    target = torch.empty_like(source)
    return 2 * size / statistics.median(event_times(lambda: target.copy_(source), 10, where))


def speed(
    count: int | None, preset: bool = False, megapixels: float = MEGAPIXELS, repeats: int = REPEATS
) -> Iterator[Row]:
    """Time whole iterations of training's own code at a fixed number of Gaussians, then the rasterizer alone.

    Args:
        count: Number of made Gaussians; None for the trained model.
        preset: With the default preset's techniques, instead of plain splatting.
        megapixels: Size of the photos.
        repeats: Measured iterations.
    """
    with gpu_scenes.device() as where:
        number = len(gpu_scenes.gaussians(count, where))
        row: Row = {"scene": "trained" if count is None else "made", "count": number, "preset": preset}
        row |= {"megapixels": megapixels, "optimiser": "sparse Adam, fused with the backward pass"}
        row |= iteration_times(count, planned(number, where, preset), megapixels, where, repeats)
        if where.type == "cuda":
            row["least_ms"] = 1e3 * row["least_bytes"] / copy_bandwidth(where)
        yield row
        if not preset:
            yield {"scene": row["scene"], "count": number} | alone(count, megapixels, where, repeats)


Planned = tuple[TrainingPlan, Callable[[Gaussians], TrainState]]
"""A plan, and what begins its training from a model, of which it keeps a copy."""


def planned(number: int, where: torch.device, preset: bool = False, **options: object) -> Planned:
    """Return the plan of a training of so many Gaussians, plain or with the default preset's techniques."""
    if not preset:
        plan = gpu_scenes.plain_plan(number, **options)
        return plan, lambda start: TrainState.begin(start, plan, make_techniques(plan))
    from splatpipe.pipeline.engine.config import load_preset

    given, views = gpu_scenes.inputs("cpu", os.cpu_count() or 1), gpu_scenes.views()
    dataset, threads, quiet = given["undistort.dataset"], given.machine.threads, SilentReporter()
    fixed = {"iterations": gpu_scenes.PUBLISHED_ITERATIONS, "max_gaussians": number, "densify": False}
    chosen = {name: value for name, value in load_preset("standard")["train"].items() if name != "least_iterations"}
    config = TrainConfig.model_validate(chosen | fixed | options)
    config = decided_exposure(config, views, dataset, threads, quiet)
    sky = begin_sky(config, views, dataset, threads, quiet)
    plan = make_plan(config, views, load_split(given["split.views"]), number)
    return plan, lambda start: TrainState.begin(start, plan, make_techniques(plan, sky, views, dataset, where))


def iteration_times(count: int | None, what: Planned, megapixels: float, where: torch.device, repeats: int) -> Row:
    """Return median times of an iteration, on the device and on the host, and the peak tensor memory."""
    plan, begin = what
    views, warmup, host = gpu_scenes.views(), min(WARMUP, repeats), list[float]()
    with tempfile.TemporaryDirectory() as cache, choose_rules(where):
        state = begin(gpu_scenes.gaussians(count, where))
        sizes = [TrainingSize()] * (warmup + repeats)
        with PhotoStream.over(views, sizes, 0, 1, Path(cache), megapixels).to(where) as photos:

            def one() -> None:
                photo = next(photos)
                began = time.perf_counter()
                iterate(state, plan, photo)
                host.append(time.perf_counter() - began)

            event_times(one, warmup, where)
            forget_peak(where)
            host.clear()
            times = event_times(one, repeats, where)
        peak = peak_gb(where)
    visible = sum_visible(state.gaussians, views[0].camera, megapixels)
    return {
        "iteration_ms": 1e3 * statistics.median(times),
        "slowest_ms": 1e3 * max(times),
        "host_ms": 1e3 * statistics.median(host),
        "repeats": repeats,
        "peak_gb": peak,
        "visible": visible,
        "least_bytes": 4 * FLOATS_A_GAUSSIAN * visible + BYTES_A_PIXEL * 1e6 * megapixels,
    }


def choose_rules(where: torch.device) -> AbstractContextManager[None]:
    """Select torch's settings as training does on a device: a fixed order of summation."""
    return chosen(where).deterministic()


def chosen(where: torch.device) -> Device:
    """Return the trainer's device."""
    return choose_device("cuda") if where.type == "cuda" else cpu()


def alone(count: int | None, megapixels: float, where: torch.device, repeats: int) -> Row:
    """Time the rasterizer's forward pass, alone and with its backward pass to all parameters."""
    model = gpu_scenes.gaussians(count, where).requires_grad_()
    views = gpu_scenes.cameras(megapixels)
    upstream = torch.randn(views[0].height, views[0].width, 3, device=where)
    options = RenderOptions(sh_degree=model.sh_degree, depth=False)
    turn = iter(range(1 << 30))

    def forward() -> torch.Tensor:
        return rasterizer.render(model, views[next(turn) % len(views)], options).colour

    def both() -> None:
        for tensor in model.tensors().values():
            tensor.grad = None
        colour = forward()
        colour.backward(upstream[: colour.shape[0], : colour.shape[1]])  # type: ignore[no-untyped-call]

    event_times(both, min(WARMUP, repeats), where)
    forget_peak(where)
    together = statistics.median(event_times(both, repeats, where))
    peak = peak_gb(where)
    with torch.no_grad():
        once = statistics.median(event_times(forward, repeats, where))
    return {"raster_ms": 1e3 * together, "forward_ms": 1e3 * once, "raster_peak_gb": peak}


def kernels(count: int, megapixels: float = MEGAPIXELS, iterations: int = PROFILED) -> Iterator[Row]:
    """Yield a table of kernels: each one's time in an iteration, by torch's profiler.

    Raises:
        SystemExit: if the profiler sees none.
    """
    with gpu_scenes.device() as where, tempfile.TemporaryDirectory() as cache, choose_rules(where):
        plan, begin = planned(count, where)
        state, steps = begin(gpu_scenes.gaussians(count, where)), WARMUP + iterations
        stream = PhotoStream.over(gpu_scenes.views(), [TrainingSize()] * steps, 0, 1, Path(cache), megapixels)
        with stream.to(where) as photos:
            for _ in range(WARMUP):
                iterate(state, plan, next(photos))
            chosen(where).wait()
            with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as profiled:
                for _ in range(iterations):
                    iterate(state, plan, next(photos))
                chosen(where).wait()
    found = [event for event in profiled.key_averages() if event.device_type != torch.autograd.DeviceType.CPU]
    whole = sum(event.self_device_time_total for event in found)
    for event in sorted(found, key=lambda event: -event.self_device_time_total)[:SHOWN_KERNELS]:
        spent = event.self_device_time_total
        row = {"kernel": event.key[:120], "calls": event.count / iterations, "us": spent / iterations}
        yield row | {"share": spent / whole}
    if not found:
        raise SystemExit("the profiler saw no kernel")


def memory(count: int, megapixels: float = MEGAPIXELS, repeats: int = 20) -> Iterator[Row]:
    """Measure the peak tensor memory of iterations at ``count`` Gaussians with all SH bands."""
    with gpu_scenes.device() as where:
        row = iteration_times(count, planned(count, where), megapixels, where, repeats)
        yield {"count": count} | {name: row[name] for name in ("peak_gb", "iteration_ms", "visible")}


def covering(count: int, where: torch.device) -> Gaussians:
    """Return Gaussians behind one another, each covering the whole image and taking about a hundredth of the light."""
    model = Gaussians.empty(count, 0).to(where)
    model.means[:, 2] = 2.0 + 4.0 * torch.arange(count, device=where) / count
    model.log_scales[:] = torch.tensor([5.0, 5.0, -6.0], device=where)
    model.opacity_logits[:] = -4.6
    model.sh[:, 0] = torch.rand(count, 3, generator=torch.Generator(where).manual_seed(0), device=where)
    return model


def many_pairs(count: int = COVERING, size: tuple[int, int] = FOUR_K) -> Iterator[Row]:
    """Render a view with more Gaussian-tile pairs than 31 bits can count; it must show its nearest Gaussians.

    Raises:
        SystemExit: if it does not.
    """
    with gpu_scenes.device() as where, torch.no_grad():
        model = covering(count, where)
        pose = torch.eye(4, dtype=torch.float64).numpy()
        middle = {"cx": size[0] / 2, "cy": size[1] / 2, "fx": float(size[0]), "fy": float(size[0])}
        camera = Camera("4K", size[0], size[1], cam_from_world=pose, **middle)
        nearest = Gaussians(*(tensor[:NEAREST_GAUSSIANS].clone() for tensor in model.tensors().values()))
        options = RenderOptions(sh_degree=0, depth=False)
        expected = rasterizer.render(nearest, camera, options).colour
        tiles = -(-size[0] // TILE_PX) * -(-size[1] // TILE_PX)
        pairs = count * tiles
        kernels = cuda.kernels_of(where)
        assert kernels is not None
        most = kernels.forecast.most_pairs  # as after some training, which foresees the view
        kernels.forecast.update(FrameFacts(FrameSize(count, tiles), most, pairs, -(-pairs // most)))
        forget_peak(where)
        took = event_times(lambda: rasterizer.render(model, camera, options), 3, where)
        got = rasterizer.render(model, camera, options).colour
        same = bool(torch.equal(got, expected))
        facts = {"pairs": pairs, "over_2_31": pairs > MANY_PAIRS, "same": same}
        yield facts | {"forward_s": min(took), "peak_gb": peak_gb(where)}
        if not same:
            raise SystemExit("the view differs from that of its nearest Gaussians")


def long_training(
    count: int, iterations: int = 30_000, megapixels: float = MEGAPIXELS, every: int = FLUSHED
) -> Iterator[Row]:
    """Train with the default preset and density control at the cap, with a row every thousand iterations.

    Args:
        count: Number of Gaussians at the start, and the cap.
        iterations: As many of these as there is time for.
        megapixels: Size of the photos.
        every: Iterations between rows.
    """
    with gpu_scenes.device() as where, tempfile.TemporaryDirectory() as cache, choose_rules(where):
        plan, begin = planned(count, where, preset=True, iterations=iterations, densify=True)
        state = begin(gpu_scenes.gaussians(count, where))
        sizes = [TrainingSize()] * iterations
        with PhotoStream.over(gpu_scenes.views(), sizes, 0, 1, Path(cache), megapixels).to(where) as photos:
            forget_peak(where)
            began = time.perf_counter()
            for number in range(1, iterations + 1):
                iterate(state, plan, next(photos))
                if number % every == 0:
                    chosen(where).wait()
                    row: Row = {"iterations": number, "of": iterations, "seconds": time.perf_counter() - began}
                    row |= {"gaussians": len(state.gaussians), "loss": state.history.last_loss()}
                    yield row | {"peak_gb": peak_gb(where)}


def sum_visible(model: Gaussians, camera: Camera, megapixels: float) -> int:
    """Count the Gaussians visible in a view."""
    factor = (1e6 * megapixels / (camera.width * camera.height)) ** 0.5
    with torch.no_grad():
        options = RenderOptions(sh_degree=0, depth=False)
        return int(rasterizer.render(model, gpu_scenes.scaled(camera, factor), options).visible.sum())


def forget_peak(where: torch.device) -> None:
    """Reset the record of peak memory."""
    if where.type == "cuda":
        torch.cuda.synchronize(where)
        torch.cuda.reset_peak_memory_stats(where)


def peak_gb(where: torch.device) -> float | None:
    """Return the peak tensor memory since the reset; None if the device does not count it."""
    return 1e-9 * torch.cuda.max_memory_allocated(where) if where.type == "cuda" else None


def _wall(function: Callable[[], object]) -> float:
    began = time.perf_counter()
    function()
    return time.perf_counter() - began
