"""The rasterizer: one ``render`` over a slow torch definition and fast native kernels."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.autograd import GradientBuffers, render_native
from splatpipe.pipeline.raster.definitions import Render, RenderOptions, check
from splatpipe.pipeline.raster.isa import _native, isa_name, isa_names
from splatpipe.pipeline.raster.reference import render_reference
from splatpipe.pipeline.splat.gaussians import Gaussians

__all__ = ["GradientBuffers", "Render", "RenderOptions", "isa_name", "isa_names", "render", "set_threads"]

Backend = Literal["auto", "reference", "native"]


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

    The native backend gives the same bits for any number of threads. A Gaussian with anything that is not finite, or
    absurdly large on the screen, is skipped and has zero gradients.

    Args:
        gaussians: The scene, raw parameters; the activations are inside.
        camera: The view, pinhole.
        options: SH degree, background, near plane, variant.
        backend: ``native`` wants float32 on the CPU; ``auto`` takes it where it can.
        means2d_probe: Zeros (n, 2) whose gradient becomes dL/d(centre on screen), pixels, for density control; with
            `options.magnitudes` the sum of its absolute values over the pixels.
        buffers: Where the native backend's backward pass writes its gradients; fresh memory without.

    Returns:
        Colour, alpha and depth of every pixel, and which Gaussians are visible.

    Raises:
        ValueError: if an argument makes no sense, or the native backend is asked for other tensors than it takes.
        SplatpipeError: if the scene covers more pixels than memory or 32-bit indices hold.
    """
    check(gaussians, camera, options, means2d_probe)
    means = gaussians.means
    native_fits = means.device.type == "cpu" and means.dtype == torch.float32
    if backend == "reference" or (backend == "auto" and not native_fits):
        return render_reference(gaussians, camera, options, means2d_probe)
    return render_native(gaussians, camera, options, means2d_probe, buffers)


def set_threads(threads: int) -> None:
    """Size the one pool that all native kernels share.

    Args:
        threads: Threads that compute, the caller included; at least 1.
    """
    _native.set_threads(threads)
