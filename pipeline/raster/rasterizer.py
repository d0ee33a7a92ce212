"""The rasterizer: one ``render`` over a slow torch definition and fast native kernels."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.autograd import render_native
from splatpipe.pipeline.raster.cuda import kernels_of
from splatpipe.pipeline.raster.cuda_frame import render_cuda
from splatpipe.pipeline.raster.definitions import Render, RenderOptions, check
from splatpipe.pipeline.raster.gradients import GradientBuffers
from splatpipe.pipeline.raster.isa import _native, isa_name, isa_names
from splatpipe.pipeline.raster.reference import render_reference
from splatpipe.pipeline.splat.gaussians import Gaussians

__all__ = [
    "GradientBuffers",
    "Render",
    "RenderOptions",
    "free_frames",
    "isa_name",
    "isa_names",
    "kernels_name",
    "render",
    "set_threads",
]

Backend = Literal["auto", "reference", "native", "cuda"]


def render(
    gaussians: Gaussians,
    camera: Camera,
    options: RenderOptions,
    *,
    backend: Backend = "auto",
    means2d_probe: Tensor | None = None,
    buffers: GradientBuffers | None = None,
) -> Render:
    """Render Gaussians as a camera sees them; differentiable with respect to every raw parameter.

    The native backend gives the same bits for any number of threads, CUDA's on any number of runs on a device. A
    Gaussian with anything that is not finite, or absurdly large on the screen, is skipped and has zero gradients.

    Args:
        gaussians: The scene, raw parameters; the activations are inside.
        camera: The view, pinhole.
        options: SH degree, background, near plane, variant.
        backend: ``native`` wants float32 on the CPU, ``cuda`` on a device; ``auto`` takes them where it can.
        means2d_probe: Zeros (n, 2) whose gradient becomes dL/d(centre on screen), pixels, for density control; with
            `options.magnitudes` the sum of its absolute values over the pixels.
        buffers: Where the native backend's backward pass writes its gradients; fresh memory without. CUDA's leaves
            them there for the optimiser to finish, the probe's too (see ``GradientBuffers``).

    Returns:
        Colour, alpha and depth of every pixel, and which Gaussians are visible.

    Raises:
        ValueError: if an argument makes no sense, or a backend is asked for other tensors than it takes.
        SplatpipeError: if the scene covers more pixels than memory or 32-bit indices hold.
        torch.OutOfMemoryError: if a CUDA device's memory is short in training, which is where buffers are given.
    """
    check(gaussians, camera, options, means2d_probe)
    means = gaussians.means
    kernels = kernels_of(means.device) if means.dtype == torch.float32 else None
    if backend == "cuda" or (backend == "auto" and kernels is not None):
        if kernels is None:
            raise ValueError(f"no CUDA kernels take {means.dtype} on {means.device}")
        return render_cuda(kernels, gaussians, camera, options, means2d_probe, buffers)
    native_fits = means.device.type == "cpu" and means.dtype == torch.float32
    if backend == "reference" or (backend == "auto" and not native_fits):
        return render_reference(gaussians, camera, options, means2d_probe)
    return render_native(gaussians, camera, options, means2d_probe, buffers)


def kernels_name(device: torch.device) -> str:
    """What computes on a device, as far as it may change the last bits: an instruction set, or a card with its driver.

    Raises:
        ValueError: if no kernels do.
    """
    kernels = kernels_of(device)
    if kernels is not None:
        return kernels.facts.described()
    if device.type != "cpu":
        raise ValueError(f"there are no kernels for {device}")
    return isa_name()


def free_frames() -> None:
    """Give back the memory that the CPU's kernels keep for renders to come; the next one takes it anew."""
    _native.free_frames()


def set_threads(threads: int) -> None:
    """Size the one pool that all native kernels share.

    Args:
        threads: Threads that compute, the caller included; at least 1.
    """
    _native.set_threads(threads)
