"""The CUDA rasterizer under torch's autograd, and the deferred end of its backward pass for the optimizer."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.geometry.camera import Camera, Window
from splatpipe.pipeline.raster.cuda.cuda import CudaKernels
from splatpipe.pipeline.raster.cuda.cuda_api import (
    SplatFrame,
    SplatPictureGradients,
    SplatPictures,
    SplatShot,
    SplatStep,
)
from splatpipe.pipeline.raster.cuda.cuda_forecast import FrameSize
from splatpipe.pipeline.raster.definitions import Render, RenderOptions
from splatpipe.pipeline.raster.gradients import FusedStep, GradientBuffers, add_gradients, can_fuse, can_wait
from splatpipe.pipeline.splat.model.gaussians import PARAMETERS, Gaussians

TILE_PX = 16  # a tile's side


@dataclass(frozen=True, eq=False)
class CudaFrame:
    """A frame on the device, with the memory that its backward pass needs.

    Attributes:
        kernels: The kernels that rendered it.
        view: The camera and render settings.
        parameters: The rendered parameters, in the order of ``PARAMETERS``.
        memory: The frame's memory.
        capacity: Number of pairs that it holds at a time.
        passes: Number of chunks that get launches of their own.
    """

    kernels: CudaKernels
    view: SplatShot
    parameters: tuple[Tensor, ...]
    memory: Tensor
    capacity: int
    passes: int

    @staticmethod
    def render(
        kernels: CudaKernels,
        view: SplatShot,
        parameters: tuple[Tensor, ...],
        outputs: Sequence[Tensor | None],
        may_shrink: bool = True,
    ) -> CudaFrame:
        """Render to colour, alpha, the three depths or None, radii and visible (uint8); all contiguous.

        Args:
            kernels: The kernels to use.
            view: The camera and render settings.
            parameters: The model's parameters, in the order of ``PARAMETERS``.
            outputs: As above.
            may_shrink: Whether to make chunks smaller if memory is short; a training does that itself, with a warning.

        Raises:
            torch.OutOfMemoryError: if memory is short and smaller chunks did not help or are not allowed.
        """
        tiles = -(-view.width // TILE_PX) * -(-view.height // TILE_PX)
        size = FrameSize(len(parameters[0]), tiles)
        while True:
            room = kernels.forecast.room(size)
            try:
                memory = kernels.empty(kernels.frame_bytes(view, size.count, room.capacity))
                break
            except torch.OutOfMemoryError:
                if not may_shrink or not kernels.forecast.shrink():
                    raise
        frame = CudaFrame(kernels, view, parameters, memory, room.capacity, room.passes)
        *pictures, radii, visible = outputs
        kernels.call(
            "splat_forward",
            *frame.arguments(None),
            ctypes.byref(SplatPictures(*map(kernels.at, pictures))),
            kernels.at(radii),
            kernels.at(visible),
        )
        kernels.forecast.read_later(memory, size, room.capacity)
        return frame

    def blend_backward(self, pictures: Sequence[Tensor | None]) -> Tensor:
        """From the gradients of colour, alpha, depth sum and sum of squares (None: zero) to screen-space gradients.

        Returns:
            Memory of the backward pass, which holds them.

        Raises:
            torch.OutOfMemoryError: if there is too little.
        """
        back = self.kernels.empty(self.kernels.back_bytes(self.view, len(self.parameters[0]), self.capacity))
        gradients = SplatPictureGradients(*map(self.kernels.at, pictures))
        self.kernels.call("splat_blend_backward", *self.arguments(back), ctypes.byref(gradients))
        return back

    def project_backward(self, back: Tensor) -> tuple[tuple[Tensor, ...], Float[Tensor, "n 2"]]:
        """From screen-space gradients to those of the parameters and of the projected centres."""
        gradients = tuple(torch.empty_like(tensor) for tensor in self.parameters)
        means2d = torch.empty(len(self.parameters[0]), 2, device=self.kernels.device)
        rows, at = self.kernels.rows(gradients), self.kernels.at(means2d)
        self.kernels.call("splat_project_backward", *self.arguments(back), ctypes.byref(rows), at)
        return gradients, means2d

    def arguments(self, back: Tensor | None) -> tuple[object, object, object]:
        """The view, the parameters and the frame in the form that the library takes."""
        frame = SplatFrame(
            memory=self.kernels.at(self.memory),
            bytes=self.memory.numel(),
            back=self.kernels.at(back),
            back_bytes=0 if back is None else back.numel(),
            count=len(self.parameters[0]),
            capacity=self.capacity,
            passes=self.passes,
        )
        return ctypes.byref(self.view), ctypes.byref(self.kernels.rows(self.parameters)), ctypes.byref(frame)


@dataclass(frozen=True, eq=False)
class UnfinishedBackward:
    """A backward pass that stopped at the screen.

    Attributes:
        frame: The rendered frame.
        back: The screen-space gradients of each Gaussian.
        visible: The visible Gaussians.
        probe: Gets its gradient when the pass is finished.
        means2d: Memory for that gradient, if there is a probe.
        logits_are_leaf: False if a function of the model's logits was rendered; until the pass is finished, the
            gradient of the model's logits is then the derivative of the rendered logits with respect to them.
    """

    frame: CudaFrame
    back: Tensor
    visible: Bool[Tensor, " n"]
    probe: Float[Tensor, "n 2"] | None
    means2d: Float[Tensor, "n 2"] | None
    logits_are_leaf: bool

    def can_step(self, parameters: Mapping[str, Tensor], visible: Tensor | None) -> bool:
        """Whether the pass can be fused with a step: of all or the first rendered rows, without other gradients."""
        if visible is not None and visible.data_ptr() != self.visible.data_ptr():
            return False
        return can_fuse(parameters, self.frame.parameters, self.logits_are_leaf)

    def step(self, step: FusedStep) -> None:
        """Finish the pass and step the parameters; the probe gets their gradient, and zeros for other rows."""
        frame, kernels, logits = self.frame, self.frame.kernels, step.values["opacity_logits"]
        sh = torch.as_tensor(step.rates["sh"], dtype=torch.float32).reshape(-1)
        given = SplatStep(
            values=kernels.rows([step.values[name] for name in PARAMETERS]),
            means=kernels.rows([step.means[name] for name in PARAMETERS]),
            squares=kernels.rows([step.squares[name] for name in PARAMETERS]),
            rows=len(logits),
            rate_sh_rest=float(sh[-1]),
            sparse=step.visible is not None,
            log_scale_min=step.log_scale_limits[0],
            log_scale_max=step.log_scale_limits[1],
            skipped=kernels.at(step.skipped),
        )
        given.beta1, given.beta2, given.epsilon, given.step = step.options
        given.rates = (*(float(step.rates[name]) for name in PARAMETERS if name != "sh"), float(sh[0]))
        if not self.logits_are_leaf:
            assert logits.grad is not None
            given.logit_gain = kernels.at(logits.grad)
            given.logits = kernels.at(frame.parameters[PARAMETERS.index("opacity_logits")])
        means = step.values["means"].detach()
        with nullcontext() if step.far is None else step.far.lengthened(means, step.visible):
            view, _, memory = frame.arguments(self.back)
            kernels.call("splat_step", view, memory, ctypes.byref(given), kernels.at(self.means2d))
        if self.probe is not None and self.means2d is not None:
            if len(logits) < len(self.means2d):
                self.means2d[len(logits) :] = 0.0
            self.probe.grad = self.means2d

    def finish(self, parameters: Mapping[str, Tensor]) -> None:
        """Finish the pass: add its gradients to those of the parameters, as any backward pass does."""
        gradients, means2d = self.frame.project_backward(self.back)
        add_gradients(parameters, gradients, self.logits_are_leaf)
        if self.probe is not None:
            self.probe.grad = means2d


def render_cuda(
    kernels: CudaKernels,
    gaussians: Gaussians,
    camera: Camera,
    options: RenderOptions,
    means2d_probe: Float[Tensor, "n 2"] | None,
    buffers: GradientBuffers | None = None,
) -> Render:
    """Render with CUDA kernels; arguments as for ``rasterizer.render``.

    Raises:
        ValueError: if a parameter is not float32 on the kernels' device.
        torch.OutOfMemoryError: if memory is short in training, which can shrink the chunks and then the model.
        MachineError: if memory is short elsewhere.
    """
    parameters = tuple(gaussians.tensors().values())
    for name, tensor in gaussians.tensors().items():
        if tensor.device.type != kernels.device.type or tensor.dtype != torch.float32:
            raise ValueError(f"the CUDA rasterizer takes float32 on {kernels.device}, not {name} of {tensor.dtype}")
    try:
        outputs = _Rasterize.apply(kernels, camera, options, buffers, means2d_probe, *parameters)  # type: ignore[no-untyped-call]
    except torch.OutOfMemoryError as error:
        if buffers is not None:
            raise
        raise MachineError(
            f"Not enough memory on the graphics card to rasterize {len(gaussians)} Gaussians.",
            hint="Lower train.max_megapixels or train.max_gaussians, or give --device cpu.",
        ) from error
    return Render(*outputs)


class _Rasterize(torch.autograd.Function):
    """Forward and backward pass of a ``CudaFrame``."""

    @staticmethod
    def forward(
        ctx: Any,
        kernels: CudaKernels,
        camera: Camera,
        options: RenderOptions,
        buffers: GradientBuffers | None,
        probe: Tensor | None,
        *leaves: Tensor,
    ) -> tuple[Tensor, ...]:
        parameters = tuple(tensor.detach().contiguous() for tensor in leaves)
        n, size = len(parameters[0]), (camera.height, camera.width)
        colour, alpha, radii = (parameters[0].new_empty(shape) for shape in ((*size, 3), size, (n,)))
        depths = tuple(alpha.new_empty(size) if options.depth else None for _ in range(3))
        visible = torch.empty(n, dtype=torch.uint8, device=colour.device)
        view = shot_of(camera, options, parameters[-1].shape[1])
        outputs = (colour, alpha, *depths, radii, visible)
        frame = CudaFrame.render(kernels, view, parameters, outputs, may_shrink=buffers is None)
        seen = visible.view(torch.bool)
        depth_outputs = tuple(alpha.new_zeros(()).expand(size) if depth is None else depth for depth in depths)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(depth_outputs[2], seen, radii, *(() if options.depth else depth_outputs[:2]))
        if any(ctx.needs_input_grad):
            ctx.frame, ctx.visible, ctx.buffers, ctx.probe = frame, seen, buffers, probe
            ctx.leaves = [tensor.is_leaf for tensor in leaves]
            ctx.save_for_backward(*parameters)
        return colour, alpha, *depth_outputs, seen, radii

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
        _ = ctx.saved_tensors  # raises if one was changed since
        frame: CudaFrame = ctx.frame
        wanted = ctx.needs_input_grad[4:]
        upstream = (colour, alpha, depth_sum, depth_square_sum)
        back = frame.blend_backward([None if grad is None else grad.contiguous() for grad in upstream])
        if ctx.buffers is not None and can_wait(wanted[1:], ctx.leaves, ctx.probe):
            logits_are_leaf = ctx.leaves[PARAMETERS.index("opacity_logits")]
            means2d = None if ctx.probe is None else torch.empty_like(ctx.probe)
            gain = None if logits_are_leaf else torch.ones_like(frame.parameters[PARAMETERS.index("opacity_logits")])
            ctx.buffers.unfinished = UnfinishedBackward(frame, back, ctx.visible, ctx.probe, means2d, logits_are_leaf)
            given = {"opacity_logits": gain}
            return (None,) * 5 + tuple(given.get(name) for name in PARAMETERS)
        gradients, means2d = frame.project_backward(back)
        asked = (grad if needs else None for grad, needs in zip((means2d, *gradients), wanted, strict=True))
        return (None, None, None, None, *asked)


def shot_of(camera: Camera, options: RenderOptions, sh_count: int) -> SplatShot:
    """A camera and render options in the form that the library takes."""
    pose = np.asarray(camera.cam_from_world, np.float64)[:3]
    part = camera.window or Window(0, 0, camera.width, camera.height)
    return SplatShot(
        (ctypes.c_double * 12)(*pose.ravel().tolist()),
        *(camera.fx, camera.fy, camera.cx, camera.cy, options.near, options.depth_origin),
        (ctypes.c_double * 3)(*options.background),
        *(camera.width, camera.height, part.left, part.top, part.whole_width, part.whole_height),
        *(options.sh_degree, sh_count),
        *(options.antialias, options.depth, options.magnitudes),
    )
