"""The rasterizer: one ``render`` for the slow torch reference and the fast native kernels."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.autograd import render_native
from splatpipe.pipeline.raster.cuda.cuda import kernels_of
from splatpipe.pipeline.raster.cuda_frame import render_cuda
from splatpipe.pipeline.raster.definitions import Render, RenderOptions, check
from splatpipe.pipeline.raster.gradients import GradientBuffers
from splatpipe.pipeline.raster.isa import _native, isa_name, isa_names
from splatpipe.pipeline.raster.reference import render_reference
from splatpipe.pipeline.splat.model.gaussians import Gaussians

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

    The native backend is bit-identical for any number of threads, the CUDA backend for repeated runs on a device. A
    Gaussian with non-finite values, or one absurdly large on the screen, is skipped and has zero gradients.

    Args:
        gaussians: The scene's raw parameters; activations are applied here.
        camera: The view, pinhole.
        options: SH degree, background, near plane, variant.
        backend: ``native`` requires float32 on the CPU, ``cuda`` on a device; ``auto`` uses them where possible.
        means2d_probe: Zeros (n, 2) whose gradient becomes dL/d(centre on screen), pixels, for density control; with
            `options.magnitudes` the sum of its absolute values over the pixels.
        buffers: Where the backward pass defers its end to the optimizer, including the probe's gradient (see
            ``GradientBuffers``); without them gradients are written as usual.

    Returns:
        Colour, alpha and depth of every pixel, and which Gaussians are visible.

    Raises:
        ValueError: if an argument is invalid, or a backend gets tensors that it does not support.
        SplatpipeError: if the scene covers more pixels than memory or 32-bit indices allow.
        torch.OutOfMemoryError: if a CUDA device's memory is short in training, i.e. with ``buffers``.
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
    """The part of a device that may change the last bits: an instruction set, or a card with its driver.

    Raises:
        ValueError: if there are no kernels for the device.
    """
    kernels = kernels_of(device)
    if kernels is not None:
        return kernels.facts.described()
    if device.type != "cpu":
        raise ValueError(f"there are no kernels for {device}")
    return isa_name()


def free_frames() -> None:
    """Free the memory that the CPU kernels keep for later renders; the next render allocates it again."""
    _native.free_frames()
    _native.free_feature_frames()


def set_threads(threads: int) -> None:
    """Set the size of the thread pool that all native kernels share.

    Args:
        threads: Number of computing threads, including the caller; at least 1.
    """
    _native.set_threads(threads)
