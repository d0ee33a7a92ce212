"""Parts of a visit to a GPU: our kernels on a small scene under compute-sanitizer, if the machine permits it."""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import gpu_scenes
import torch
from gpu_parts import Refusal, Row
from gpu_proofs import SSIM_WEIGHT, random_model, view_of

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.colour import affine_colour
from splatpipe.pipeline.raster.cuda import cuda
from splatpipe.pipeline.raster.cuda.cuda_forecast import Forecast, FrameFacts, FrameSize
from splatpipe.pipeline.raster.cuda_frame import TILE_PX
from splatpipe.pipeline.raster.gradients import GradientBuffers
from splatpipe.pipeline.raster.loss import photo_loss
from splatpipe.pipeline.raster.optim import Adam
from splatpipe.pipeline.raster.rasterization import rasterization
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.raster.sky import STEP_PX, SkyLayer, laid_over_nodes
from splatpipe.pipeline.splat.model.gaussians import Gaussians

KERNELS = "splat4cuda"  # in the mangled name of each kernel of ours, and of no other
SMALL, SMALL_SIZE = 3000, (161, 117)  # Gaussians, and image size: a tool slows kernels down a hundredfold
LOG_SCALE_INCREASE = 1.5  # added: several tiles a Gaussian, so that a chunk of one pair each is far too small
FOUND = 3  # exit code of a run in which the tool found something
PROBE_S = 5.0  # for a machine's refusal
REFUSALS = ("Device not supported", "device is not supported", "not supported on")
SLANTED: Row = {"render_mode": "RGB+D", "depth": "ray"}
FEATURES: tuple[Row, ...] = (
    *({"sh_degree": degree} for degree in range(4)),
    {"channels": 4, "absgrad": True},
    {"channels": 2} | SLANTED,
    {"channels": 3, "absgrad": True} | SLANTED,
    {"channels": 20, "absgrad": True} | SLANTED,
)
"""Of every kernel of features; the last two of those for what was not foreseen."""
SUMMARIES = re.compile(r"(?:ERROR|RACECHECK) SUMMARY: (\d+)")
PROBE = """
import ctypes, sys
cuda = ctypes.CDLL("libcuda.so.1")
context, memory = ctypes.c_void_p(), ctypes.c_uint64()
codes = [cuda.cuInit(0), cuda.cuDevicePrimaryCtxRetain(ctypes.byref(context), 0), cuda.cuCtxSetCurrent(context)]
codes.append(cuda.cuMemAlloc_v2(ctypes.byref(memory), ctypes.c_size_t(1024)))
sys.exit(f"the driver answers {codes}" if any(codes) else 0)
"""


def sanitized(tool: str, entry: str = "gpu_sanitized:every_kernel", **arguments: object) -> Iterator[Row]:
    """Run a part's function under one of compute-sanitizer's tools.

    Args:
        tool: memcheck, racecheck, synccheck or initcheck.
        entry: The function, as in ``GpuPart``; run in a process of its own.
        **arguments: Its arguments.

    Raises:
        Refusal: if the machine does not permit it, within seconds.
        SystemExit: if the tool found something, or the function failed.
    """
    program = shutil.which("compute-sanitizer") or shutil.which("/usr/local/cuda/bin/compute-sanitizer")
    if program is None:
        raise Refusal("compute-sanitizer is not installed here")
    _probe([program, "--tool", tool])
    words = [sys.executable, __file__, entry, json.dumps(arguments)]
    options = [program, "--tool", tool, "--error-exitcode", str(FOUND)]
    code, said = _run([*options, "--kernel-name", f"kernel_substring={KERNELS}", *words])
    if code and "kernel-name" in said and not SUMMARIES.search(said):  # another version's options
        code, said = _run([*options, *words])
    summary = SUMMARIES.findall(said)
    found = int(summary[-1]) if summary else None
    yield {"tool": tool, "of": entry.partition(":")[2], "found": found, "exit_code": code}
    if code or not summary:
        raise SystemExit(f"{tool} found something" if code == FOUND else f"{tool} ended with {code}")


def _probe(words: Sequence[str]) -> None:
    """Raise a Refusal if the tool does not run here."""
    try:
        done = subprocess.run(
            [*words, sys.executable, "-c", PROBE], capture_output=True, text=True, check=False, timeout=PROBE_S
        )
    except subprocess.TimeoutExpired as error:
        raise Refusal(f"compute-sanitizer does not answer within {PROBE_S:.0f} s") from error
    said = done.stdout + done.stderr
    if done.returncode or any(text in said for text in REFUSALS):
        lines = [line for line in said.splitlines() if any(text in line for text in REFUSALS)] or said.splitlines()
        raise Refusal(lines[0].strip("= ")[:200] if lines else f"compute-sanitizer ends with {done.returncode}")


def _run(words: Sequence[str]) -> tuple[int, str]:
    """Run a program, printing its output as it comes; return its exit code and the output."""
    environment = {**os.environ, "PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}  # otherwise it sees one large allocation
    said = []
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace", env=environment
    ) as run:
        assert run.stdout is not None
        for line in run.stdout:
            print(line, end="", flush=True)
            said.append(line)
    return run.returncode, "".join(said)


def every_kernel(count: int = SMALL, size: Sequence[int] = SMALL_SIZE) -> Iterator[Row]:
    """Run every kernel: renders, losses, backward passes, steps, the sky, features, and density control's draws."""
    with gpu_scenes.device() as where:
        kernels = cuda.kernels_of(where)
        assert kernels is not None
        model, view = random_model(count), view_of(*size)
        model.log_scales += LOG_SCALE_INCREASE
        model = model.to(where).requires_grad_()
        for foreseen in (True, False):
            for depth in (False, True):
                forget_frames(kernels, count, view, foreseen)
                train_step(model, view, depth)
            for named in FEATURES if foreseen else FEATURES[-2:]:
                render_features(model, view, named)
        rows = torch.arange(count, device=where)
        kernels.uniform(1, 2, 3, count)
        kernels.split_offsets((1, 2, 3), rows, model.log_scales.detach(), model.quats.detach())
        kernels.morton(model.means.detach(), (-1.0, -1.0, -1.0), (2.0, 2.0, 2.0))
        if where.type == "cuda":
            torch.cuda.synchronize(where)
        chunks = kernels.forecast.room(FrameSize(count, tiles_of(view))).passes
        yield {"gaussians": count, "chunks": chunks, "finite": bool(torch.isfinite(model.means).all())}


def tiles_of(view: Camera) -> int:
    """Return the number of a view's tiles."""
    return -(-view.width // TILE_PX) * -(-view.height // TILE_PX)


def forget_frames(kernels: cuda.CudaKernels, count: int, view: Camera, foreseen: bool) -> None:
    """Set the forecast to a new one, or to one that expects a single pair, so that most of a frame is unforeseen."""
    kernels.forecast, kernels.feature_forecast = Forecast(count), Forecast(count)
    for forecast in (kernels.forecast, kernels.feature_forecast):
        if not foreseen:
            forecast.update(FrameFacts(FrameSize(count, tiles_of(view)), count, 1, 1))


def render_features(model: Gaussians, view: Camera, named: Row) -> None:
    """Run ``rasterization`` and its backward pass: of channels or a degree of spherical harmonics."""
    arguments, where = dict(named), model.means.device
    given = gpu_scenes.activated(model, arguments.pop("channels", None))
    leaves = [tensor.requires_grad_() for tensor in given.values()]
    images, alphas, _ = rasterization(
        *leaves, *gpu_scenes.matrices(view, where), view.width, view.height, rasterize_mode="antialiased", **arguments
    )
    (images.mean() + alphas.mean()).backward()


def train_step(model: Gaussians, view: Camera, depth: bool) -> None:
    """Train a model by one step on noise, with an exposure and a sky, and once more without fusing pass and step."""
    where, (height, width) = model.means.device, (view.height, view.width)
    nodes = [torch.rand(-(-(height - 1) // STEP_PX) + 1, -(-(width - 1) // STEP_PX) + 1, 3, device=where) for _ in "12"]
    mask = torch.rand(height, width, device=where) < 0.5
    behind = SkyLayer((0.1, 0.2, 0.3), nodes[1], around=~mask | mask.roll(1, 0), mask=mask)
    options = RenderOptions(3, (0.1, 0.2, 0.3), antialias=depth, depth=depth, magnitudes=not depth)
    adam, beside = Adam(model.tensors()), Adam({"affine": torch.zeros(1, 3, 4, device=where)})
    rates = dict.fromkeys(model.tensors(), 1e-3)
    for buffers in (GradientBuffers(), None):  # the step fused with the backward pass, and gradients for themselves
        affine = torch.eye(3, 4, device=where).requires_grad_()
        probe = torch.zeros(len(model.means), 2, device=where, requires_grad=True)
        render = rasterizer.render(model, view, options, means2d_probe=probe, buffers=buffers)
        picture = laid_over_nodes(render.colour, render.alpha, nodes[0].requires_grad_(), behind)
        loss = photo_loss(affine_colour(picture, affine), torch.rand(height, width, 3, device=where), SSIM_WEIGHT, mask)
        (loss + (0.1 * render.depth_sum.mean() if depth else 0.0)).backward()
        with torch.no_grad():
            adam.step(model.tensors(), rates, render.visible, buffers=buffers or GradientBuffers())
            maps = affine.detach()[None].clone()
            maps.grad = affine.grad[None]
            beside.step({"affine": maps}, {"affine": 1e-2})
        for tensor in model.tensors().values():
            tensor.grad = None


def main(entry: str, arguments: str) -> None:
    """Run a part's function and print its rows."""
    module, _, function = entry.partition(":")
    own = sys.modules["__main__"] if module == Path(__file__).stem else importlib.import_module(module)
    for row in getattr(own, function)(**json.loads(arguments)):
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
