"""Parts of a visit to a GPU that prove something: smoke, the tests marked cuda, agreement, same bits, trainings."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import gpu_scenes
import numpy as np
import torch
from gpu_parts import Row
from torch import Tensor

from splatpipe.pipeline.engine.stage import Inputs
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.cuda import cuda
from splatpipe.pipeline.raster.loss import photo_loss
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.render.options import EvaluateConfig
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import coefficient_count
from splatpipe.pipeline.splat.quality import metrics
from splatpipe.pipeline.train import loop
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.stages import evaluate

ROOT = Path(__file__).resolve().parents[2]
TESTS = ROOT / "tests"
MARK = "mark.cuda"  # in the source of every test that needs a device
MIN_DB = 60.0  # between the CPU's render and the device's
MAX_RELATIVE = 1e-3  # difference of a gradient, relative to its norm
SSIM_WEIGHT = 0.2
# Gaussians and image size in pixels, not in whole tiles, of the first render.
SMOKE_COUNT, SMOKE_SIZE = 20_000, (403, 299)
TRAINING_MP = 0.4  # megapixels of a training photo


class SilentReporter:
    """A stage's Reporter that discards everything."""

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None: ...
    def metric(self, name: str, value: float, step: int | None = None) -> None: ...
    def warning(self, message: str, hint: str = "") -> None: ...
    def note(self, message: str) -> None: ...


def smoke(count: int = SMOKE_COUNT, size: tuple[int, int] = SMOKE_SIZE) -> Iterator[Row]:
    """Compare one render, its loss and one backward pass on the device with the CPU's; no file is needed.

    Raises:
        SystemExit: if they differ.
    """
    with gpu_scenes.device() as where:
        view = view_of(*size)
        photo = torch.rand(view.height, view.width, 3, generator=torch.Generator().manual_seed(3))
        row = compared(random_model(count), view, photo, where)
        yield row
        if not agrees(row):
            raise SystemExit("the first render or its gradients differ from the CPU's")


def relative(ours: Tensor, expected: Tensor) -> float:
    """Return the difference relative to the norm of what is expected."""
    return float((ours - expected).norm() / expected.norm())


def view_of(width: int, height: int) -> Camera:
    """Return a camera at the origin."""
    return Camera("smoke", width, height, 0.8 * width, 0.81 * width, width / 2 + 2.5, height / 2 - 1.0, np.eye(4))


def random_model(count: int) -> Gaussians:
    """Return small and large Gaussians in front of a camera at the origin, some behind it."""
    generator = torch.Generator().manual_seed(11)
    model = Gaussians.empty(count, 3)
    model.means = torch.randn(count, 3, generator=generator) * torch.tensor([2.0, 1.5, 2.5]) + torch.tensor([0, 0, 5.0])
    model.log_scales = -3.5 + 0.8 * torch.randn(count, 3, generator=generator)
    model.quats = torch.randn(count, 4, generator=generator)
    model.opacity_logits = 1.5 * torch.randn(count, generator=generator)
    model.sh = 0.2 * torch.randn(count, coefficient_count(3), 3, generator=generator)
    return model


def marked_tests(options: Sequence[str] = ()) -> Iterator[Row]:
    """Run the tests marked ``cuda``, without the conftest.py's, which want a browser and more.

    Args:
        options: Further ones of pytest.

    Raises:
        SystemExit: if a test fails.
    """
    words = [sys.executable, "-m", "pytest", "-v", "-m", "cuda", "--noconftest", "-p", "no:cacheprovider"]
    words += ["--continue-on-collection-errors"]
    words += [*options, *map(str, marked_files())]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    last = ""
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT, env=environment
    ) as run:
        assert run.stdout is not None
        for line in run.stdout:
            print(line, end="", flush=True)
            last = line.strip() or last
            if " FAILED " in line or " ERROR " in line:
                yield {"failed": line.split(" ")[0]}
    yield {"tests": last.strip("= ")}
    if run.returncode:
        raise SystemExit(f"pytest ended with {run.returncode}: {last}")


def marked_files() -> list[Path]:
    """Return the files of tests that have one marked ``cuda``; others import what the machine lacks."""
    return sorted(path for path in TESTS.rglob("test_*.py") if MARK in path.read_text(encoding="utf-8"))


def agreement(megapixels: float = 0.4, views: int = 4) -> Iterator[Row]:
    """Compare the trained model's renders, losses and gradients on the device with the CPU's.

    Raises:
        SystemExit: if a difference exceeds its limit.
    """
    _native.set_threads(os.cpu_count() or 1)
    with gpu_scenes.device() as where:
        model = gpu_scenes.gaussians(None, torch.device("cpu"))
        worst: list[str] = []
        for camera, photo in itertools.islice(gpu_scenes.photos(megapixels), views):
            row = compared(model, camera, photo, where)
            yield {"view": camera.name, "gaussians": len(model)} | row
            if not agrees(row):
                worst.append(camera.name)
        if worst:
            raise SystemExit(f"these views do not agree: {', '.join(worst)}")


def agrees(row: Row) -> bool:
    """Whether a comparison is within its limits; NaN is not."""
    return bool(row["psnr_db"] >= MIN_DB and all(value <= MAX_RELATIVE for value in row["gradients"].values()))


def compared(model: Gaussians, camera: Camera, photo: Tensor, where: torch.device) -> Row:
    """Compare a view's render, loss and gradients on a device with the CPU's."""
    there = _gradients(model, camera, photo, where)
    with cuda.use_kernels(None):
        here = _gradients(model, camera, photo, torch.device("cpu"))
    gradients = {name: relative(there[name], value) for name, value in here.items() if name not in ("colour", "loss")}
    return {
        "psnr_db": float(metrics.psnr(there["colour"], here["colour"])),
        "largest": float((there["colour"] - here["colour"]).abs().max()),
        "loss": float((there["loss"] - here["loss"]) / here["loss"]),
        "gradients": gradients,
    }


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


def same_bits_twice(iterations: int = 200) -> Iterator[Row]:
    """Train twice with one seed and compare the digests of the outputs.

    Raises:
        SystemExit: if they differ.
    """
    digests = set()
    for _ in range(2):
        with tempfile.TemporaryDirectory() as scratch:
            train_capture("cuda", Path(scratch), iterations=iterations, seed=7)
            digests.add(hashlib.sha256((Path(scratch) / "model.ply").read_bytes()).hexdigest())
    yield {"same": len(digests) == 1, "digests": sorted(digests)}
    if len(digests) > 1:
        raise SystemExit("two trainings with one seed differ")


def training(seed: int, iterations: int, on: str = "cuda", megapixels: float = TRAINING_MP) -> Iterator[Row]:
    """Train on a device and report the quality of the held-out views, as the CPU's were that are carried."""
    with tempfile.TemporaryDirectory() as scratch:
        began = time.perf_counter()
        trained, found = train_capture(on, Path(scratch), iterations=iterations, seed=seed, max_megapixels=megapixels)
        facts = {name: trained.get(name) for name in ("device", "instruction_set", "gaussians", "train_seconds")}
        facts |= {name: found[name] for name in ("psnr_cc", "psnr", "ssim")}
        row = {"seed": seed, "iterations": iterations} | facts | {"seconds": round(time.perf_counter() - began, 1)}
    yield row


def carried_trainings() -> list[Row]:
    """Return the rows of the CPU's trainings, as ``make gpu-visit`` has run them."""
    path = gpu_scenes.PACK / "cpu.json"
    return list(json.loads(path.read_text())) if path.exists() else []


def train_capture(on: str, out: Path, *, start: Path | None = None, **options: object) -> tuple[Row, Row]:
    """Train and evaluate the packed capture, as the pipeline does.

    Args:
        on: The device.
        out: Folder for the output of both.
        start: The initial Gaussians; None for the capture's.
        **options: Training options.

    Returns:
        The facts that training reports, and those that `evaluate` reports.
    """
    given = gpu_scenes.inputs(on, os.cpu_count() or 1)
    if start is not None:
        given = replace(given, parts={**given.parts, "initialize.splat": start})
    trained = loop.run(TrainConfig.model_validate(options), given, out, SilentReporter())
    parts = {**given.parts, "clean.model": out / "model.ply", "train.rendering": out / "rendering.json"}
    parts["train.sky"] = out / "sky.npz"
    found = evaluate.run(EvaluateConfig(), Inputs(parts, out, machine=given.machine), out, SilentReporter())
    return dict(trained), dict(found)
