"""Parts of a visit to a GPU: ``rasterization``, of activated values and features, against the CPU's, and its speed."""

from __future__ import annotations

import math
import os
import statistics
from collections.abc import Iterator, Sequence

import gpu_scenes
import torch
from gpu_parts import Row
from gpu_proofs import SMOKE_COUNT, SMOKE_SIZE, agrees, random_model, relative, view_of
from gpu_scenes import MEGAPIXELS
from gpu_speed import REPEATS, WARMUP, event_times, forget_peak, peak_gb
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.native import _native
from splatpipe.pipeline.raster.cuda import cuda
from splatpipe.pipeline.raster.rasterization import rasterization
from splatpipe.pipeline.splat.model.gaussians import Gaussians

COMPARED: tuple[Row, ...] = (
    {"channels": 3, "render_mode": "RGB+D", "rasterize_mode": "antialiased", "depth": "ray"},
    {"channels": 33, "render_mode": "RGB", "rasterize_mode": "classic"},
    {"sh_degree": 3, "render_mode": "RGB+ED", "rasterize_mode": "classic"},
)
"""What is rendered of features: channels or the degree of spherical harmonics, and other arguments."""
TIMED = (None, 3, 32)
"""Channels; None: spherical harmonics of degree 3, as the peers render."""


def agreement(count: int = SMOKE_COUNT, size: tuple[int, int] = SMOKE_SIZE) -> Iterator[Row]:
    """Compare ``rasterization`` and its backward pass on the device with the CPU's kernels; no file is needed.

    Raises:
        SystemExit: if they differ.
    """
    _native.set_threads(os.cpu_count() or 1)
    with gpu_scenes.device() as where:
        view, model = view_of(*size), random_model(count)
        wrong = []
        for named in COMPARED:
            there = feature_gradients(model, view, named, where)
            with cuda.use_kernels(None):
                here = feature_gradients(model, view, named, torch.device("cpu"))
            again = feature_gradients(model, view, named, where)
            same = all(torch.equal(value, again[name]) for name, value in there.items())
            gradients = {name: relative(there[name], value) for name, value in here.items() if name != "images"}
            row = dict(named) | {"psnr_db": psnr(there["images"], here["images"]), "same": same}
            yield row | {"gradients": gradients}
            if not (same and agrees(row | {"gradients": gradients})):
                wrong.append(named)
        if wrong:
            raise SystemExit(f"these differ from the CPU's, or from run to run: {wrong}")


def psnr(ours: Tensor, expected: Tensor) -> float:
    """Return the PSNR of images of any channels, dB; their peak is the largest value expected, at least 1."""
    error = float((ours - expected).square().mean())
    return 10.0 * math.log10(max(1.0, float(expected.abs().max())) ** 2 / max(error, 1e-30))


def feature_gradients(model: Gaussians, view: Camera, named: Row, where: torch.device) -> dict[str, Tensor]:
    """Return images of ``rasterization``, and the gradients of activated values, features and centres; on the CPU."""
    given, arguments = gpu_scenes.activated(model, named.get("channels")), dict(named)
    arguments.pop("channels", None)
    leaves = {name: tensor.to(where).requires_grad_() for name, tensor in given.items()}
    images, alphas, meta = rasterization(
        *leaves.values(), *gpu_scenes.matrices(view, where), view.width, view.height, absgrad=True, **arguments
    )
    meta["means2d"].retain_grad()
    upstream = torch.randn(images.shape, generator=torch.Generator().manual_seed(3)).to(where)
    ((images * upstream).sum() + alphas.sum()).backward()
    found = {name: leaf.grad for name, leaf in leaves.items()}
    found |= {"means2d": meta["means2d"].grad, "absgrad": meta["means2d"].absgrad, "images": images.detach()}
    return {name: tensor.cpu() for name, tensor in found.items() if tensor is not None}


def speed(count: int | None, megapixels: float = MEGAPIXELS, repeats: int = REPEATS) -> Iterator[Row]:
    """Time ``rasterization``, forward and with its backward pass to all arguments, as ``gpu_peers`` times gsplat's."""
    with gpu_scenes.device() as where:
        model, views = gpu_scenes.gaussians(count, where), gpu_scenes.cameras(megapixels)
        for channels in TIMED:
            row: Row = {"scene": "trained" if count is None else "made", "count": len(model), "channels": channels}
            yield row | feature_times(model, channels, views, where, repeats)


def feature_times(
    model: Gaussians, channels: int | None, views: Sequence[Camera], where: torch.device, repeats: int
) -> Row:
    """Return median times of ``rasterization`` and its peak of tensor memory."""
    given = gpu_scenes.activated(model, channels)
    leaves = [tensor.requires_grad_() for tensor in given.values()]
    matrices = [gpu_scenes.matrices(view, where) for view in views]
    turn, degree = iter(range(1 << 30)), model.sh_degree if channels is None else None

    def forward() -> torch.Tensor:
        number = next(turn) % len(views)
        size = (views[number].width, views[number].height)
        return rasterization(*leaves, *matrices[number], *size, sh_degree=degree)[0]

    def both() -> None:
        for leaf in leaves:
            leaf.grad = None
        images = forward()
        images.backward(upstream[:, : images.shape[1], : images.shape[2]])

    with torch.no_grad():
        upstream = torch.randn_like(forward())
    event_times(both, min(WARMUP, repeats), where)
    forget_peak(where)
    together = statistics.median(event_times(both, repeats, where))
    peak = peak_gb(where)
    with torch.no_grad():
        once = statistics.median(event_times(forward, repeats, where))
    return {"features_ms": 1e3 * together, "features_forward_ms": 1e3 * once, "features_peak_gb": peak}
