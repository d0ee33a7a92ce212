"""The native rasterizer under torch's autograd."""

from __future__ import annotations

from typing import Any, NoReturn

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.definitions import Render, RenderOptions
from splatpipe.pipeline.raster.gradients import GradientBuffers
from splatpipe.pipeline.raster.isa import _native
from splatpipe.pipeline.splat.gaussians import Gaussians


def render_native(
    gaussians: Gaussians,
    camera: Camera,
    options: RenderOptions,
    means2d_probe: Float[Tensor, "n 2"] | None,
    buffers: GradientBuffers | None = None,
) -> Render:
    """Render with the native kernels; arguments as of ``render``.

    Raises:
        ValueError: if a parameter is not float32 on the CPU.
        SplatpipeError: if the Gaussians cover more of the picture than memory or 32-bit indices hold.
    """
    parameters = tuple(gaussians.tensors().values())
    for name, tensor in gaussians.tensors().items():
        if tensor.device.type != "cpu" or tensor.dtype != torch.float32:
            raise ValueError(f"the native rasterizer takes float32 on the CPU, not {name} of {tensor.dtype}")
    return Render(*_Rasterize.apply(camera, options, buffers, means2d_probe, *parameters))  # type: ignore[no-untyped-call]


class _Rasterize(torch.autograd.Function):
    """Forward and backward pass of ``_native.Frame``."""

    @staticmethod
    def forward(
        ctx: Any,
        camera: Camera,
        options: RenderOptions,
        buffers: GradientBuffers | None,
        _means2d_probe: Tensor | None,
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        parameters = tuple(tensor.detach().contiguous() for tensor in parameters)
        n, h, w = len(parameters[0]), camera.height, camera.width
        colour = torch.empty(h, w, 3)
        alpha = torch.empty(h, w)
        depths = (torch.empty(h, w), torch.empty(h, w), torch.empty(h, w)) if options.depth else None
        radii, visible = torch.empty(n), torch.empty(n, dtype=torch.uint8)
        part = camera.window
        pose = np.ascontiguousarray(camera.cam_from_world, np.float64)
        frame = _native.Frame()
        try:
            frame.forward(
                parameters,
                (pose, (w, h), (camera.fx, camera.fy, camera.cx, camera.cy)),
                (options.sh_degree, options.antialias, options.near, options.depth_origin, options.background),
                (colour, alpha, depths, radii, visible),
                None if part is None else (part.left, part.top, part.whole_width, part.whole_height),
            )
        except (_native.TooManyPairs, MemoryError) as error:
            _refuse(error, n)
        visible = visible.view(torch.bool)
        depth_sum, depth_square_sum, median_depth = depths or (torch.zeros(()).expand(h, w),) * 3
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(
            median_depth, visible, radii, *(() if options.depth else (depth_sum, depth_square_sum))
        )
        if any(ctx.needs_input_grad):
            ctx.frame = frame
            ctx.magnitudes = options.magnitudes
            ctx.buffers = buffers
            ctx.save_for_backward(*parameters)
        return colour, alpha, depth_sum, depth_square_sum, median_depth, visible, radii

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any,
        colour: Tensor | None,
        alpha: Tensor | None,
        depth_sum: Tensor | None,
        depth_square_sum: Tensor | None,
        *_: None,
    ) -> tuple[Tensor | None, ...]:
        upstream = (colour, alpha, depth_sum, depth_square_sum)
        pictures = tuple(None if grad is None else grad.contiguous() for grad in upstream)
        parameters = ctx.saved_tensors
        # New memory a pass where none was given: a second pass must not write over the gradients of the first.
        gradients = (ctx.buffers or GradientBuffers()).like(parameters)
        means2d = torch.empty(len(parameters[0]), 2)
        try:
            ctx.frame.backward(parameters, pictures, gradients, means2d, ctx.magnitudes)
        except MemoryError as error:
            _refuse(error, len(parameters[0]))
        wanted = ctx.needs_input_grad[3:]
        asked = (grad if needs else None for grad, needs in zip((means2d, *gradients), wanted, strict=True))
        return (None, None, None, *asked)


def _refuse(error: Exception, gaussians: int) -> NoReturn:
    if isinstance(error, MemoryError):
        raise MachineError(
            f"Not enough memory to rasterize {gaussians} Gaussians.",
            hint="Lower undistort.max_megapixels or train.max_gaussians.",
        ) from error
    raise SplatpipeError(
        f"{gaussians} Gaussians cover the picture so often over that 32-bit indices do not hold it.",
        hint="Lower undistort.max_megapixels or train.max_gaussians.",
    ) from error
