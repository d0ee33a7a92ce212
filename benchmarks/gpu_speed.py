"""Parts of ``gpu_day.py measure``: speed and memory on a GPU. Times by CUDA events, medians."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from itertools import islice, pairwise
from pathlib import Path

import gpu_scenes
import torch
from gpu_parts import Row
from gpu_proofs import train_capture

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.dataset import load_split, load_views
from splatpipe.pipeline.raster import cuda, rasterizer
from splatpipe.pipeline.raster.cuda_forecast import FrameFacts, FrameSize
from splatpipe.pipeline.raster.cuda_frame import TILE_PX
from splatpipe.pipeline.raster.definitions import RenderOptions
from splatpipe.pipeline.raster.device import choose_device
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.ply import write_splat
from splatpipe.pipeline.train.iteration import iterate
from splatpipe.pipeline.train.state import TrainState
from splatpipe.pipeline.train.stream import PhotoStream
from splatpipe.pipeline.train.techniques import make_techniques
from splatpipe.pipeline.train.windows import TrainingSize

CAPTURE = "speed"  # as packed by `prepare`
MEGAPIXELS = 1.6
WARMUP, REPEATS = 30, 100  # iterations; the first ones determine how much room frames need
COPY_BYTES = 1 << 32  # far larger than any cache
# Minimum traffic of a whole iteration, float32: a visible Gaussian's 59 parameters and 118 moments are read and written
# once, and the parameters read once more by the render; a pixel's colour, gradient and photo (8 bits) once each way.
FLOATS_A_GAUSSIAN = 2 * (59 + 118) + 59
BYTES_A_PIXEL = 4 * 3 * 4 + 3
MANY_PAIRS = 1 << 31
FOUR_K = (3840, 2160)
COVERING = 70_000  # Gaussians covering all of a 4K image: 2.27e9 pairs with its 32,400 tiles
ENDING = 2000  # of these, more than any pixel blends: each takes a hundredth of the light


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


def card() -> Iterator[Row]:
    """Report the device and its copy bandwidth, bytes read and written both counted."""
    with gpu_scenes.device() as where:
        kernels = cuda.kernels_of(where)
        assert kernels is not None
        yield {"device": kernels.facts.described(), "memory_gb": 1e-9 * kernels.facts.memory_bytes}
        yield {"copy_gb_s": 1e-9 * copy_bandwidth(where)}


def copy_bandwidth(where: torch.device, size: int = COPY_BYTES) -> float:
    """Return the bandwidth of a device-to-device copy, bytes per second."""
    source = torch.empty(size, dtype=torch.uint8, device=where).random_()
    target = torch.empty_like(source)
    return 2 * size / statistics.median(event_times(lambda: target.copy_(source), 10, where))


def speed(count: int, megapixels: float = MEGAPIXELS, repeats: int = REPEATS) -> Iterator[Row]:
    """Time whole iterations of training's own code, and the rasterizer alone, at a fixed number of Gaussians."""
    with gpu_scenes.device() as where:
        row: Row = {"count": count, "megapixels": megapixels}
        row |= iteration_times(count, megapixels, where, repeats)
        yield row | {"least_ms": 1e3 * row["least_bytes"] / copy_bandwidth(where)} if where.type == "cuda" else row
        yield {"count": count} | alone(count, megapixels, where, repeats)


def iteration_times(count: int, megapixels: float, where: torch.device, repeats: int) -> Row:
    """Return median device and wall-clock times of an iteration, and the peak tensor memory."""
    given = gpu_scenes.inputs(CAPTURE, "cpu")
    views, split = load_views(given["undistort.dataset"]), load_split(given["split.views"])
    views = [view for view in views if view.camera.name in set(split.train)]
    plan = gpu_scenes.plain_plan(CAPTURE, count)
    steps = WARMUP + repeats
    with tempfile.TemporaryDirectory() as cache, choose_rules(where):
        state = TrainState.begin(gpu_scenes.gaussians(CAPTURE, count, where), plan, make_techniques(plan))
        with PhotoStream.over(views, [TrainingSize()] * steps, 0, 1, Path(cache), megapixels).to(where) as photos:
            for photo in islice(photos, WARMUP):
                iterate(state, plan, photo)
            forget_peak(where)
            began = time.perf_counter()
            times = event_times(lambda: iterate(state, plan, next(photos)), repeats, where)
            wall = (time.perf_counter() - began) / repeats
    visible = sum_visible(state.gaussians, views[0].camera, megapixels)
    pixels = 1e6 * megapixels
    return {
        "iteration_ms": 1e3 * statistics.median(times),
        "slowest_ms": 1e3 * max(times),
        "wall_ms": 1e3 * wall,
        "peak_gb": peak_gb(where),
        "visible": visible,
        "least_bytes": 4 * FLOATS_A_GAUSSIAN * visible + BYTES_A_PIXEL * pixels,
    }


def choose_rules(where: torch.device) -> AbstractContextManager[None]:
    """Select torch's settings as training does on a device: a fixed order of summation."""
    return choose_device("cuda" if where.type == "cuda" else "cpu").one_order()


def alone(count: int, megapixels: float, where: torch.device, repeats: int) -> Row:
    """Time the rasterizer's forward pass, alone and with its backward pass to all parameters."""
    model = gpu_scenes.gaussians(CAPTURE, count, where).requires_grad_()
    views = gpu_scenes.cameras(CAPTURE, megapixels)
    upstream = torch.randn(views[0].height, views[0].width, 3, device=where)
    options = RenderOptions(sh_degree=3, depth=False)
    turn = iter(range(1 << 30))

    def forward() -> torch.Tensor:
        return rasterizer.render(model, views[next(turn) % len(views)], options).colour

    def both() -> None:
        for tensor in model.tensors().values():
            tensor.grad = None
        colour = forward()
        colour.backward(upstream[: colour.shape[0], : colour.shape[1]])  # type: ignore[no-untyped-call]

    event_times(both, WARMUP, where)
    forget_peak(where)
    together = statistics.median(event_times(both, repeats, where))
    peak = peak_gb(where)
    with torch.no_grad():
        once = statistics.median(event_times(forward, repeats, where))
    return {"raster_ms": 1e3 * together, "forward_ms": 1e3 * once, "raster_peak_gb": peak}


def memory(count: int, megapixels: float = MEGAPIXELS) -> Iterator[Row]:
    """Measure the peak tensor memory of iterations at ``count`` Gaussians with all SH bands."""
    with gpu_scenes.device() as where:
        row = iteration_times(count, megapixels, where, 20)
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
        nearest = Gaussians(*(tensor[:ENDING].clone() for tensor in model.tensors().values()))
        options = RenderOptions(sh_degree=0, depth=False)
        expected = rasterizer.render(nearest, camera, options).colour
        tiles = -(-size[0] // TILE_PX) * -(-size[1] // TILE_PX)
        pairs = count * tiles
        kernels = cuda.kernels_of(where)
        assert kernels is not None
        # As after some training: an unforeseen count is one block's work, and would take minutes here.
        most = kernels.forecast.most_pairs
        kernels.forecast.learn(FrameFacts(FrameSize(count, tiles), most, pairs, -(-pairs // most)))
        forget_peak(where)
        took = event_times(lambda: rasterizer.render(model, camera, options), 3, where)
        got = rasterizer.render(model, camera, options).colour
        same = bool(torch.equal(got, expected))
        facts = {"pairs": pairs, "over_2_31": pairs > MANY_PAIRS, "same": same}
        yield facts | {"forward_s": min(took), "peak_gb": peak_gb(where)}
        if not same:
            raise SystemExit("the view differs from that of its nearest Gaussians")


def whole_training(count: int = 1_000_000, iterations: int = 30_000) -> Iterator[Row]:
    """Train from start to end at 1.6 MP, including density control, with the cap's number of Gaussians."""
    with gpu_scenes.device() as where, tempfile.TemporaryDirectory() as scratch:
        start = Path(scratch) / "start.ply"
        write_splat(start, gpu_scenes.gaussians(CAPTURE, count, where).to("cpu"))
        began = time.perf_counter()
        options = {"iterations": iterations, "max_gaussians": count}
        trained, found = train_capture(CAPTURE, "cuda", Path(scratch), start=start, **options)
        yield trained_row(trained, found) | {"seconds": time.perf_counter() - began}


def line(capture: str) -> Iterator[Row]:
    """Train and evaluate a packed run of the pipeline, with the preset's own options.

    Raises:
        SystemExit: if it is not packed.
    """
    from splatpipe.pipeline.engine.config import load_preset

    if not (gpu_scenes.PACK / "captures" / capture).is_dir():
        raise SystemExit(f"{capture} was not packed")
    options = dict(load_preset(capture.partition("-")[2]).get("train", {}))
    with tempfile.TemporaryDirectory() as scratch:
        began = time.perf_counter()
        trained, found = train_capture(capture, "cuda", Path(scratch), **options)
        yield {"capture": capture} | trained_row(trained, found) | {"seconds": time.perf_counter() - began}


def trained_row(trained: Row, found: Row) -> Row:
    """Return a training's row."""
    names = ("device", "iterations", "gaussians", "train_seconds", "train_megapixels")
    return {name: trained[name] for name in names} | {name: found[name] for name in ("psnr", "psnr_cc", "ssim")}


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
