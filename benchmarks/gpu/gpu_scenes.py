"""Shared by the parts of a visit to a GPU: the packed capture, any number of Gaussians, and the device."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View, load_split, load_views
from splatpipe.pipeline.photos.pixels.images import load_colour
from splatpipe.pipeline.raster.cuda import cuda
from splatpipe.pipeline.raster.cuda.cuda_library import load, unavailable_reason
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import coefficient_count
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.plan.plan import TrainingPlan, make_plan

PACK = Path(os.environ.get("SPLATPIPE_PACK", ".gpu_visit"))
CAPTURE = "sceaux"  # the packed capture
TRAINED = "trained.ply"  # beside its parts: the model of a training
MEGAPIXELS = 1.6  # size of a photo
HARNESS = "SPLATPIPE_HARNESS"  # a libsplat_cuda built for the CPU, to try the parts without a GPU
PARTS = ("undistort.dataset", "split.views", "initialize.splat", "georef.frame", "georef.control", "georef.accuracy")
# No technique beyond plain Gaussian splatting, as in every trainer.
PLAIN = {
    "antialias": False,
    "background": "black",
    "sky": "off",
    "prune_free_space": 0,
    "dropout": 0.0,
    "exposure": "off",
    "densify": False,
    "max_gaussians": 10**9,
}
PUBLISHED_ITERATIONS = 30_000  # learning rates of a long run, so the measured iterations hardly change the model


@contextlib.contextmanager
def device() -> Iterator[torch.device]:
    """Yield the device of the CUDA kernels: a GPU, or the CPU under the harness if its library is named.

    Raises:
        MachineError: if neither is available.
    """
    if harness := os.environ.get(HARNESS):
        with cuda.use_kernels(cuda.CudaKernels(load(Path(harness)), torch.device("cpu"))):
            yield torch.device("cpu")
        return
    if missing := unavailable_reason():
        raise missing.error()
    yield torch.device("cuda", torch.cuda.current_device())


def inputs(device_name: str, threads: int = 2) -> Inputs:
    """Return the packed capture's inputs for the stages, under the pipeline's names.

    Raises:
        FileNotFoundError: if it is not packed.
    """
    folder = PACK / "captures" / CAPTURE
    if not folder.is_dir():
        raise FileNotFoundError(f"{CAPTURE} is not in {PACK}: `make gpu-visit` packs it, and it is carried here")
    parts = {name: folder / name for name in PARTS if (folder / name).exists()}
    return Inputs(parts, folder, machine=Machine(device_name, threads))


def views() -> list[View]:
    """Return the packed capture's views that are trained on."""
    given = inputs("cpu")
    trained = set(load_split(given["split.views"]).train)
    return [view for view in load_views(given["undistort.dataset"]) if view.camera.name in trained]


def cameras(megapixels: float) -> list[Camera]:
    """Return the cameras of these views, scaled to a size."""
    found = [view.camera for view in views()]
    return [scaled(camera, math.sqrt(1e6 * megapixels / (camera.width * camera.height))) for camera in found]


def photos(megapixels: float) -> Iterator[tuple[Camera, Tensor]]:
    """Yield each of these views' cameras at a size, with its photo, (h, w, 3) of 0..1."""
    import cv2

    for view, camera in zip(views(), cameras(megapixels), strict=True):
        photo = load_colour(view).astype(np.float32) / 255.0
        photo = cv2.resize(photo, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        yield camera, torch.from_numpy(np.ascontiguousarray(photo))


def scaled(camera: Camera, factor: float) -> Camera:
    """Return a camera with more or fewer pixels."""
    width, height = round(camera.width * factor), round(camera.height * factor)
    x, y = width / camera.width, height / camera.height
    focal = {"fx": camera.fx * x, "fy": camera.fy * y, "cx": camera.cx * x, "cy": camera.cy * y}
    return replace(camera, width=width, height=height, **focal)


def gaussians(count: int | None, where: torch.device, seed: int = 0) -> Gaussians:
    """Return the trained model, or ``count`` made Gaussians.

    These are the initial ones, each repeated next to itself, smaller the more there are.

    Args:
        count: Number of Gaussians; None for the trained model.
        where: Device of the tensors.
        seed: Seed of the positions.
    """
    if count is None:
        return read_splat(PACK / "captures" / CAPTURE / TRAINED).to(where)
    start = read_splat(inputs("cpu")["initialize.splat"])
    generator = torch.Generator(where).manual_seed(seed)
    rows = torch.arange(count, device=where) % len(start)
    shrink = math.sqrt(min(1.0, len(start) / count))  # keeps the coverage of surfaces
    scales = start.log_scales.to(where)[rows]
    noise = torch.randn(count, 3, generator=generator, device=where)
    sh = 0.05 * torch.randn(count, coefficient_count(3), 3, generator=generator, device=where)
    sh[:, 0] = start.sh.to(where)[rows, 0]
    return Gaussians(
        means=start.means.to(where)[rows] + scales.exp() * noise,
        log_scales=scales + math.log(shrink),
        quats=torch.randn(count, 4, generator=generator, device=where),
        opacity_logits=start.opacity_logits.to(where)[rows],
        sh=sh,
    )


def activated(model: Gaussians, channels: int | None) -> dict[str, Tensor]:
    """Return a model's activated values, and its spherical harmonics or features of either sign, for rasterization."""
    colors = model.sh
    if channels is not None:
        generator = torch.Generator(model.means.device).manual_seed(1)
        colors = torch.randn(len(model), channels, generator=generator, device=model.means.device)
    opacities, scales = torch.sigmoid(model.opacity_logits), torch.exp(model.log_scales)
    given = {"means": model.means, "quats": model.quats, "scales": scales, "opacities": opacities, "colors": colors}
    return {name: tensor.detach().clone() for name, tensor in given.items()}


def matrices(camera: Camera, where: torch.device) -> tuple[Tensor, Tensor]:
    """Return a camera's pose, (1, 4, 4), and intrinsics, (1, 3, 3)."""
    pose = torch.as_tensor(camera.cam_from_world, dtype=torch.float32)
    matrix = torch.tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    return pose[None].to(where), matrix[None].to(where)


def plain_plan(count: int, **options: object) -> TrainingPlan:
    """Return the plan of a plain training, with all SH bands from the first iteration."""
    config = TrainConfig.model_validate({"iterations": PUBLISHED_ITERATIONS} | PLAIN | options)
    given = inputs("cpu")
    plan = make_plan(config, load_views(given["undistort.dataset"]), load_split(given["split.views"]), count)
    return replace(plan, schedule=replace(plan.schedule, sh_every=1))
