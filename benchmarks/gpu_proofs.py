"""Parts of ``gpu_day.py prove``: correctness checks on a GPU."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import gpu_scenes
import numpy as np
import torch
from gpu_parts import Row
from torch import Tensor

from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.dataset import load_views
from splatpipe.pipeline.photos.images import load_colour
from splatpipe.pipeline.raster import cuda, rasterizer
from splatpipe.pipeline.raster.loss import photo_loss
from splatpipe.pipeline.raster.optim import Adam
from splatpipe.pipeline.raster.rasterizer import GradientBuffers, RenderOptions
from splatpipe.pipeline.render.options import EvaluateConfig
from splatpipe.pipeline.splat import metrics
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.ply import read_splat
from splatpipe.pipeline.train import loop
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.stages import evaluate

ROOT = Path(__file__).resolve().parents[1]
TESTS = tuple(f"tests/test_cuda_{what}.py" for what in ("device", "iterations", "sky", "trainer"))
MIN_DB = 60.0  # between the CPU's render and the device's
MAX_RELATIVE = 1e-3  # difference of a gradient, relative to its norm
SHORT = 300  # iterations after which a model counts as trained
SSIM_WEIGHT = 0.2
THREADS = 2  # of a training on the CPU: several run concurrently
SMALL, SMALL_MP = 3000, 0.02  # Gaussians and image size under the sanitizer, whose tools slow it down a hundredfold
SUMMARIES = re.compile(r"(?:ERROR|RACECHECK) SUMMARY: (\d+)")


class SilentReporter:
    """A stage's Reporter that discards everything."""

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None: ...
    def metric(self, name: str, value: float, step: int | None = None) -> None: ...
    def warning(self, message: str, hint: str = "") -> None: ...
    def note(self, message: str) -> None: ...


def train_capture(capture: str, on: str, out: Path, *, start: Path | None = None, **options: object) -> tuple[Row, Row]:
    """Train and evaluate a packed capture, as the pipeline does.

    Args:
        capture: Name of the packed capture.
        on: The device.
        out: Folder for the output of both.
        start: The initial Gaussians; None for the capture's.
        **options: Training options.

    Returns:
        The facts that training reports, and those that `evaluate` reports.
    """
    given = gpu_scenes.inputs(capture, on, THREADS if on == "cpu" else os.cpu_count() or 1)
    if start is not None:
        given = replace(given, parts={**given.parts, "initialize.splat": start})
    trained = loop.run(TrainConfig.model_validate(options), given, out, SilentReporter())
    parts = {**given.parts, "clean.model": out / "model.ply", "train.rendering": out / "rendering.json"}
    parts["train.sky"] = out / "sky.npz"
    found = evaluate.run(EvaluateConfig(), Inputs(parts, out, machine=given.machine), out, SilentReporter())
    return dict(trained), dict(found)


def training(capture: str, seed: int, iterations: int, on: str) -> Iterator[Row]:
    """Train on a device and report the quality of the held-out views."""
    with tempfile.TemporaryDirectory() as scratch:
        began = time.perf_counter()
        trained, found = train_capture(capture, on, Path(scratch), iterations=iterations, seed=seed)
        facts = {name: trained.get(name) for name in ("device", "instruction_set", "gaussians", "train_seconds")}
        facts |= {name: found[name] for name in ("psnr_cc", "psnr", "ssim")}
        yield {"capture": capture, "seed": seed} | facts | {"seconds": round(time.perf_counter() - began, 1)}


def marked_tests() -> Iterator[Row]:
    """Run the tests marked ``cuda``, without tests/conftest.py, which requires a browser.

    Raises:
        SystemExit: if a test fails.
    """
    words = ["-m", "pytest", "-q", "-m", "cuda", "--noconftest", "-p", "no:cacheprovider", *TESTS]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False, cwd=ROOT)
    lines = done.stdout.strip().splitlines() or [""]
    yield {"tests": lines[-1], "failed": [line for line in lines if line.startswith(("FAILED", "ERROR"))]}
    if done.returncode:
        raise SystemExit((done.stdout + done.stderr)[-1000:])


def agreement(megapixels: float = 0.4, views: int = 4, iterations: int = SHORT) -> Iterator[Row]:
    """Compare a trained model's renders, losses and gradients on the device with the CPU's.

    Raises:
        SystemExit: if a difference exceeds its limit.
    """
    rasterizer.set_threads(os.cpu_count() or 1)
    with gpu_scenes.device() as where:
        model = _trained("sceaux", where, iterations)
        worst: list[str] = []
        for camera, photo in _photos("sceaux", megapixels, views):
            there = _gradients(model, camera, photo, where)
            with cuda.use_kernels(None):
                here = _gradients(model, camera, photo, torch.device("cpu"))
            row = _compared(here, there)
            yield {"view": camera.name} | row
            if row["psnr_db"] < MIN_DB or max(row["gradients"].values()) > MAX_RELATIVE:
                worst.append(camera.name)
        if worst:
            raise SystemExit(f"these views do not agree: {', '.join(worst)}")


def same_bits_twice(iterations: int = 200) -> Iterator[Row]:
    """Train twice with one seed and compare the digests of the outputs.

    Raises:
        SystemExit: if they differ.
    """
    digests = set()
    for _ in range(2):
        with tempfile.TemporaryDirectory() as scratch:
            train_capture("sceaux", "cuda", Path(scratch), iterations=iterations, seed=7)
            digests.add(hashlib.sha256((Path(scratch) / "model.ply").read_bytes()).hexdigest())
    yield {"same": len(digests) == 1, "digests": sorted(digests)}
    if len(digests) > 1:
        raise SystemExit("two trainings with one seed differ")


def sanitized(tool: str) -> Iterator[Row]:
    """Run every kernel on a small scene under one of compute-sanitizer's tools, if the machine permits it.

    Raises:
        SystemExit: if it cannot run, or reports an error.
    """
    program = shutil.which("compute-sanitizer")
    if program is None:
        raise SystemExit("compute-sanitizer is not installed here")
    words = [program, "--tool", tool, "--error-exitcode", "3", sys.executable, __file__]
    environment = {**os.environ, "PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}  # otherwise it sees one large allocation
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
    said = done.stdout + done.stderr
    summary = SUMMARIES.findall(said)
    yield {"tool": tool, "found": int(summary[-1]) if summary else None, "exit_code": done.returncode}
    if done.returncode or not summary:
        raise SystemExit(said[-1000:])


def every_kernel() -> None:
    """Run renders, losses, backward passes, steps and draws of a small scene, for the sanitizer."""
    with gpu_scenes.device() as where:
        kernels = cuda.kernels_of(where)
        assert kernels is not None
        model = gpu_scenes.gaussians("sceaux", SMALL, where).requires_grad_()
        adam, buffers = Adam(model.tensors()), GradientBuffers()
        for camera in gpu_scenes.cameras("sceaux", SMALL_MP)[:2]:
            for depth in (False, True):
                options = RenderOptions(sh_degree=3, antialias=depth, depth=depth, magnitudes=not depth)
                probe = torch.zeros(SMALL, 2, device=where, requires_grad=True)
                render = rasterizer.render(model, camera, options, means2d_probe=probe, buffers=buffers)
                affine = torch.eye(3, 4, device=where)
                colour = kernels.affine_colour(affine, render.colour.detach())
                kernels.affine_colour_backward(affine, colour, colour)
                loss = photo_loss(render.colour, torch.rand_like(colour), SSIM_WEIGHT)
                (loss + (0.1 * render.depth_sum.mean() if depth else 0.0)).backward()  # type: ignore[no-untyped-call]
                rates: dict[str, float | Tensor] = dict.fromkeys(model.tensors(), 1e-3)
                with torch.no_grad():
                    adam.step(model.tensors(), rates, render.visible, buffers=buffers)
        rows = torch.arange(SMALL, device=where)
        kernels.uniform(1, 2, 3, SMALL)
        kernels.split_offsets((1, 2, 3), rows, model.log_scales.detach(), model.quats.detach())
        kernels.morton(model.means.detach(), (-1.0, -1.0, -1.0), (2.0, 2.0, 2.0))
        if where.type == "cuda":
            torch.cuda.synchronize(where)


def _trained(capture: str, where: torch.device, iterations: int) -> Gaussians:
    """Return a model after a short training; under the harness, an initial model with anisotropic Gaussians."""
    if where.type == "cpu":
        model = read_splat(gpu_scenes.inputs(capture, "cpu")["initialize.splat"])
        model.log_scales += 0.5 * torch.randn(model.log_scales.shape, generator=torch.Generator().manual_seed(0))
        return model
    with tempfile.TemporaryDirectory() as scratch:
        train_capture(capture, "cuda", Path(scratch), iterations=iterations)
        return read_splat(Path(scratch) / "model.ply")


def _photos(capture: str, megapixels: float, views: int) -> Iterator[tuple[Camera, Tensor]]:
    """Yield cameras of a packed capture at a size, each with its photo at that size, (h, w, 3) of 0..1."""
    import cv2

    dataset = gpu_scenes.inputs(capture, "cpu")["undistort.dataset"]
    for view, camera in list(zip(load_views(dataset), gpu_scenes.cameras(capture, megapixels), strict=True))[:views]:
        photo = load_colour(view).astype(np.float32) / 255.0
        photo = cv2.resize(photo, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        yield camera, torch.from_numpy(np.ascontiguousarray(photo))


def _gradients(model: Gaussians, camera: Camera, photo: Tensor, where: torch.device) -> dict[str, Tensor]:
    """Return a render, its loss, and the gradients of all parameters and screen positions; on the CPU."""
    leaves = model.clone().to(where).requires_grad_()
    probe = torch.zeros(len(model), 2, device=where, requires_grad=True)
    options = RenderOptions(sh_degree=model.sh_degree, antialias=True, depth=False)
    render = rasterizer.render(leaves, camera, options, means2d_probe=probe)
    loss = photo_loss(render.colour, photo.to(where), SSIM_WEIGHT)
    loss.backward()  # type: ignore[no-untyped-call]
    found = {name: tensor.grad for name, tensor in leaves.tensors().items()} | {"means2d": probe.grad}
    found |= {"colour": render.colour.detach(), "loss": loss.detach()}
    return {name: tensor.cpu() for name, tensor in found.items() if tensor is not None}


def _compared(here: dict[str, Tensor], there: dict[str, Tensor]) -> Row:
    gradients = {
        name: float((there[name] - value).norm() / value.norm())
        for name, value in here.items()
        if name not in ("colour", "loss")
    }
    difference = (there["colour"] - here["colour"]).double()
    return {
        "psnr_db": float(metrics.psnr(there["colour"], here["colour"])),
        "largest": float(difference.abs().max()),
        "loss": float((there["loss"] - here["loss"]) / here["loss"]),
        "gradients": gradients,
    }


if __name__ == "__main__":
    every_kernel()
