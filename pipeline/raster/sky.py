"""A render laid over the sky, by a kernel: one pass over the picture forward, one back, the same bits every time."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.raster.cuda import CudaKernels
from splatpipe.pipeline.raster.cuda_api import SplatSky


@dataclass(frozen=True, eq=False)
class Behind:
    """What is to be behind a render, interpolated from nodes as ``splat.panorama.between_nodes`` does.

    Attributes:
        step: Pixels from node to node.
        background: What the render has behind it.
        elsewhere: Seen instead of the nodes where ``around`` does not hold, of their shape; None: nowhere.
        around: As said; None without ``elsewhere``.
        mask: Where the nodes have a gradient; None: nowhere.
    """

    step: int
    background: tuple[float, float, float]
    elsewhere: Float[Tensor, "rows columns 3"] | None = None
    around: Bool[Tensor, "h w"] | None = None
    mask: Bool[Tensor, "h w"] | None = None


def laid_over_nodes(
    kernels: CudaKernels,
    colour: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    nodes: Float[Tensor, "rows columns 3"],
    behind: Behind,
) -> Float[Tensor, "h w 3"]:
    """A render over something else than its background; the render and the nodes get gradients.

    Args:
        kernels: Of the tensors' device.
        colour: Rendered over ``behind.background``, float32 as all are.
        alpha: The render's.
        nodes: What is behind it.
        behind: How.
    """
    result: Tensor = _LaidOver.apply(kernels, colour, alpha, nodes, behind)  # type: ignore[no-untyped-call]
    return result


class _LaidOver(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, kernels: CudaKernels, colour: Tensor, alpha: Tensor, nodes: Tensor, behind: Behind) -> Tensor:
        ctx.kernels, ctx.behind = kernels, behind
        tensors = [tensor.detach().contiguous() for tensor in (colour, alpha, nodes)]
        ctx.save_for_backward(*tensors)
        sky, _kept = _sky(kernels, tensors, behind)
        out = torch.empty_like(tensors[0])
        kernels.call("splat_sky", ctypes.byref(sky), kernels.at(out))
        return out

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[None, Tensor, Tensor, Tensor | None, None]:
        given = upstream[0].contiguous()
        _, alpha, nodes = ctx.saved_tensors
        sky, _kept = _sky(ctx.kernels, ctx.saved_tensors, ctx.behind)
        by_alpha = torch.empty_like(alpha)
        by_nodes = torch.empty_like(nodes) if ctx.behind.mask is not None and ctx.needs_input_grad[3] else None
        gradients = (ctx.kernels.at(by_alpha), ctx.kernels.at(by_nodes))
        ctx.kernels.call("splat_sky_backward", ctypes.byref(sky), ctx.kernels.at(given), *gradients)
        return None, given, by_alpha, by_nodes, None


def _sky(kernels: CudaKernels, tensors: Any, behind: Behind) -> tuple[SplatSky, list[Tensor | None]]:
    """The call's argument, and what has to live as long as it does."""
    colour, alpha, nodes = tensors
    elsewhere = None if behind.elsewhere is None else behind.elsewhere.detach().contiguous()
    masks = [None if mask is None else mask.contiguous().view(torch.uint8) for mask in (behind.around, behind.mask)]
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
        around=kernels.at(masks[0]),
        mask=kernels.at(masks[1]),
    )
    return sky, [elsewhere, *masks]
