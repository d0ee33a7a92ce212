"""The native rasterizer under torch's autograd, and the deferred end of its backward pass for the optimizer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.definitions import Render, RenderOptions
from splatpipe.pipeline.raster.gradients import (
    FusedStep,
    GradientBuffers,
    add_gradients,
    can_fuse,
    can_wait,
    rate_columns,
)
from splatpipe.pipeline.raster.isa import _native
from splatpipe.pipeline.raster.native_arrays import array, array_or_none, arrays
from splatpipe.pipeline.raster.native_camera import native_camera
from splatpipe.pipeline.splat.model.gaussians import PARAMETERS, Gaussians

_LOGITS = PARAMETERS.index("opacity_logits")


@dataclass(frozen=True, eq=False)
class UnfinishedRender:
    """A backward pass that stopped at the screen.

    Attributes:
        frame: The rendered frame, with the screen-space gradients of its Gaussians.
        parameters: The rendered parameters, in the order of ``PARAMETERS``.
        visible: The visible Gaussians.
        probe: Gets its gradient when the pass is finished.
        logits_are_leaf: False if a function of the model's logits was rendered; until the pass is finished, the
            gradient of the model's logits is then the derivative of the rendered logits with respect to them.
    """

    frame: _native.Frame
    parameters: tuple[Tensor, ...]
    visible: Bool[Tensor, " n"]
    probe: Float[Tensor, "n 2"] | None
    logits_are_leaf: bool

    def can_step(self, parameters: Mapping[str, Tensor], visible: Tensor | None) -> bool:
        """Whether the pass can be fused with a step: of the visible rows, or of the first ones of them."""
        if visible is None or visible.data_ptr() != self.visible.data_ptr():
            return False
        return can_fuse(parameters, self.parameters, self.logits_are_leaf)

    def step(self, step: FusedStep) -> None:
        """Finish the pass and step the visible rows of the parameters; the probe gets a sparse gradient."""
        count = self.frame.visible
        seen = None if self.probe is None else (torch.empty(count, dtype=torch.int64), torch.empty(count, 2))
        logits = step.values["opacity_logits"]
        skipped = self.frame.step(
            arrays(self.parameters),
            arrays(step.values[name] for name in PARAMETERS),
            arrays(step.means[name] for name in PARAMETERS),
            arrays(step.squares[name] for name in PARAMETERS),
            tuple(rate_columns(step.rates[name], step.values[name]) for name in PARAMETERS),
            step.options,
            step.log_scale_limits,
            None if step.far is None else (*step.far.centre, step.far.unit),
            None if self.logits_are_leaf else array_or_none(logits.grad),
            None if seen is None else arrays(seen),
        )
        if skipped:
            step.skipped.add_(skipped)
        if self.probe is not None and seen is not None:
            if len(logits) < len(self.visible):
                count = int(self.visible[: len(logits)].sum())
            rows, means2d = (each[:count] for each in seen)
            shape = self.probe.shape
            self.probe.grad = torch.sparse_coo_tensor(
                rows[None], means2d, shape, is_coalesced=True, check_invariants=False
            )

    def finish(self, parameters: Mapping[str, Tensor]) -> None:
        """Finish the pass: add its gradients to those of the parameters, as any backward pass does."""
        gradients, means2d = _project_backward(self.frame, self.parameters)
        add_gradients(parameters, gradients, self.logits_are_leaf)
        if self.probe is not None:
            self.probe.grad = means2d


def render_native(
    gaussians: Gaussians,
    camera: Camera,
    options: RenderOptions,
    means2d_probe: Float[Tensor, "n 2"] | None,
    buffers: GradientBuffers | None = None,
) -> Render:
    """Render with the native kernels; arguments as for ``render``.

    Raises:
        ValueError: if a parameter is not float32 on the CPU.
        SplatpipeError: if the Gaussians cover more of the image than memory or 32-bit indices allow.
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
        probe: Tensor | None,
        *leaves: Tensor,
    ) -> tuple[Tensor, ...]:
        parameters = tuple(tensor.detach().contiguous() for tensor in leaves)
        n, h, w = len(parameters[0]), camera.height, camera.width
        colour = torch.empty(h, w, 3)
        alpha = torch.empty(h, w)
        depths = (torch.empty(h, w), torch.empty(h, w), torch.empty(h, w)) if options.depth else None
        radii, visible = torch.empty(n), torch.empty(n, dtype=torch.uint8)
        part = camera.window
        frame = _native.Frame()
        try:
            frame.forward(
                arrays(parameters),
                native_camera(camera),
                (options.sh_degree, options.antialias, options.near, options.depth_origin, options.background),
                (array(colour), array(alpha), depths and arrays(depths), array(radii), array(visible)),
                None if part is None else (part.left, part.top, part.whole_width, part.whole_height),
            )
        except (_native.TooManyPairs, MemoryError) as error:
            refuse(error, n)
        visible = visible.view(torch.bool)
        depth_sum, depth_square_sum, median_depth = depths or (torch.zeros(()).expand(h, w),) * 3
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(
            median_depth, visible, radii, *(() if options.depth else (depth_sum, depth_square_sum))
        )
        if any(ctx.needs_input_grad):
            ctx.frame, ctx.visible, ctx.buffers, ctx.probe = frame, visible, buffers, probe
            ctx.magnitudes = options.magnitudes
            ctx.leaves = [tensor.is_leaf for tensor in leaves]
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
        pictures = tuple(None if grad is None else array(grad.contiguous()) for grad in upstream)
        parameters = ctx.saved_tensors  # raises if one was changed since
        wanted = ctx.needs_input_grad[3:]
        try:
            ctx.frame.blend_backward(pictures, ctx.magnitudes)
        except MemoryError as error:
            refuse(error, len(parameters[0]))
        if ctx.buffers is not None and can_wait(wanted[1:], ctx.leaves, ctx.probe):
            is_leaf = ctx.leaves[_LOGITS]
            gain = None if is_leaf else torch.ones_like(parameters[_LOGITS])
            ctx.buffers.unfinished = UnfinishedRender(ctx.frame, parameters, ctx.visible, ctx.probe, is_leaf)
            return (None,) * 4 + tuple({"opacity_logits": gain}.get(name) for name in PARAMETERS)
        gradients, means2d = _project_backward(ctx.frame, parameters)
        asked = (grad if needs else None for grad, needs in zip((means2d, *gradients), wanted, strict=True))
        return (None, None, None, *asked)


def _project_backward(
    frame: _native.Frame, parameters: Sequence[Tensor]
) -> tuple[tuple[Tensor, ...], Float[Tensor, "n 2"]]:
    """From a frame's screen-space gradients to those of its parameters and of the projected centres."""
    gradients = tuple(torch.empty_like(tensor) for tensor in parameters)
    means2d = torch.empty(len(parameters[0]), 2)
    frame.project_backward(arrays(parameters), arrays(gradients), array(means2d))
    return gradients, means2d


def refuse(error: Exception, gaussians: int) -> NoReturn:
    """Say in words why a render of so many Gaussians does not fit.

    Raises:
        SplatpipeError: always.
    """
    if isinstance(error, MemoryError):
        raise MachineError(
            f"Not enough memory to rasterize {gaussians} Gaussians.",
            hint="Lower train.max_megapixels or train.max_gaussians.",
        ) from error
    raise SplatpipeError(
        f"{gaussians} Gaussians overlap so much in the picture that 32-bit indices overflow.",
        hint="Lower train.max_megapixels or train.max_gaussians.",
    ) from error
