"""Compositing a render over the sky with a kernel: one pass over the image each way, bit-identical every time."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, kernels_of
from splatpipe.pipeline.raster.cuda.cuda_api import SplatSky
from splatpipe.pipeline.raster.isa import _native
from splatpipe.pipeline.raster.native_arrays import array, array_or_none, arrays
from splatpipe.pipeline.splat.sky.panorama import STEP_PX, between_nodes, composite_over


@dataclass(frozen=True, eq=False)
class SkyLayer:
    """The layer behind a render, interpolated from nodes as in ``splat.sky.panorama.between_nodes``.

    Attributes:
        background: Background that the render was made with.
        elsewhere: Nodes used instead where ``around`` is False, in the same shape; None to use none.
        around: Where the sky's own nodes are used; None without ``elsewhere``.
        mask: Where the nodes get a gradient; None for nowhere.
        step: Node spacing, pixels.
    """

    background: tuple[float, float, float]
    elsewhere: Float[Tensor, "rows columns 3"] | None = None
    around: Bool[Tensor, "h w"] | None = None
    mask: Bool[Tensor, "h w"] | None = None
    step: int = STEP_PX


def laid_over_nodes(
    colour: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    nodes: Float[Tensor, "rows columns 3"],
    behind: SkyLayer,
) -> Float[Tensor, "h w 3"]:
    """Replace a render's background by the nodes: ``laid_over_nodes_reference``, with kernels for float32.

    The CPU kernels are bit-identical for any number of threads, and sums have a fixed order on any device. The render
    and the nodes get gradients.

    Args:
        colour: Rendered over ``behind.background``.
        alpha: Alpha of the render.
        nodes: Colours behind the render, at the nodes.
        behind: How to composite them.
    """
    kernels = kernels_of(colour.device)
    fits = kernels is not None or colour.device.type == "cpu"
    if not fits or any(tensor.dtype != torch.float32 for tensor in (colour, alpha, nodes)):
        return laid_over_nodes_reference(colour, alpha, nodes, behind)
    result: Tensor = _SkyComposite.apply(kernels, colour, alpha, nodes, behind)  # type: ignore[no-untyped-call]
    return result


def laid_over_nodes_reference(
    colour: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    nodes: Float[Tensor, "rows columns 3"],
    behind: SkyLayer,
) -> Float[Tensor, "h w 3"]:
    """The same by its definition, in any dtype and on any device."""
    height, width = alpha.shape
    moving = between_nodes(nodes, height, width, behind.step)
    sky = moving.detach()
    if behind.mask is not None:
        sky = torch.where(behind.mask[:, :, None], moving, sky)
    if behind.elsewhere is not None and behind.around is not None:
        other = between_nodes(behind.elsewhere, height, width, behind.step)
        sky = torch.where(behind.around[:, :, None], sky, other)
    return composite_over(colour, alpha, behind.background, sky)


class _SkyComposite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, kernels: CudaKernels | None, colour: Tensor, alpha: Tensor, nodes: Tensor, behind: SkyLayer
    ) -> Tensor:
        ctx.kernels, ctx.behind = kernels, behind
        colour, alpha, nodes = (tensor.detach().contiguous() for tensor in (colour, alpha, nodes))
        ctx.save_for_backward(colour, alpha, nodes)
        out = torch.empty_like(colour)
        if kernels is None:
            _native.lay_over(_sky(alpha, nodes, behind), *arrays((colour, out)))
            return out
        sky, _kept = _cuda_sky(kernels, colour, alpha, nodes, behind)
        kernels.call("splat_sky", ctypes.byref(sky), kernels.at(out))
        return out

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[None, Tensor, Tensor, Tensor | None, None]:
        kernels, behind, given = ctx.kernels, ctx.behind, upstream[0].contiguous()
        colour, alpha, nodes = ctx.saved_tensors
        by_alpha = torch.empty_like(alpha)
        by_nodes = torch.empty_like(nodes) if behind.mask is not None and ctx.needs_input_grad[3] else None
        if kernels is None:
            into = (array(by_alpha), array_or_none(by_nodes))
            _native.lay_over_backward(_sky(alpha, nodes, behind), array(given), *into)
        else:
            sky, _kept = _cuda_sky(kernels, colour, alpha, nodes, behind)
            gradients = (kernels.at(by_alpha), kernels.at(by_nodes))
            kernels.call("splat_sky_backward", ctypes.byref(sky), kernels.at(given), *gradients)
        return None, given, by_alpha, by_nodes, None


def _contiguous(behind: SkyLayer) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """``elsewhere``, ``around`` and the mask in the form that kernels take."""
    elsewhere = None if behind.elsewhere is None else behind.elsewhere.detach().contiguous()
    around, mask = (
        None if mask is None else mask.contiguous().view(torch.uint8) for mask in (behind.around, behind.mask)
    )
    return elsewhere, around, mask


def _sky(alpha: Tensor, nodes: Tensor, behind: SkyLayer) -> tuple[Any, ...]:
    """The argument of the CPU kernels."""
    masks = (array_or_none(each) for each in _contiguous(behind))
    return *arrays((alpha, nodes)), *masks, behind.step, behind.background


def _cuda_sky(
    kernels: CudaKernels, colour: Tensor, alpha: Tensor, nodes: Tensor, behind: SkyLayer
) -> tuple[SplatSky, tuple[Tensor | None, ...]]:
    """The argument of the CUDA kernels, and the tensors that have to live as long."""
    elsewhere, around, mask = kept = _contiguous(behind)
    sky = SplatSky(
        width=colour.shape[1],
        height=colour.shape[0],
        rows=nodes.shape[0],
        columns=nodes.shape[1],
        step=behind.step,
        background=behind.background,
        colour=kernels.at(colour),
        alpha=kernels.at(alpha),
        nodes=kernels.at(nodes),
        elsewhere=kernels.at(elsewhere),
        around=kernels.at(around),
        mask=kernels.at(mask),
    )
    return sky, kept
