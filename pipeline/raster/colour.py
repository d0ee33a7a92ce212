"""Affine maps of an image's colours, as exposure and white balance apply them."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, kernels_of
from splatpipe.pipeline.raster.isa import _native
from splatpipe.pipeline.raster.native_arrays import arrays


def affine_colour(picture: Float[Tensor, "h w 3"], affine: Float[Tensor, "3 4"]) -> Float[Tensor, "h w 3"]:
    """Every pixel's colour c becomes A c + b, with A the map's first three columns and b its last.

    Uses kernels for float32 on the CPU and CUDA devices, bit-identical every time; both arguments get gradients.
    """
    kernels = kernels_of(picture.device)
    fits = kernels is not None or picture.device.type == "cpu"
    if not fits or picture.dtype != torch.float32 or affine.dtype != torch.float32:
        return picture @ affine[:, :3].T + affine[:, 3]
    result: Tensor = _AffineColour.apply(kernels, picture, affine)  # type: ignore[no-untyped-call]
    return result


class _AffineColour(torch.autograd.Function):
    """Kernels, because torch's product of pixels and a 3 × 3 matrix takes longer than the image's whole render."""

    @staticmethod
    def forward(ctx: Any, kernels: CudaKernels | None, picture: Tensor, affine: Tensor) -> Tensor:
        picture, affine = picture.detach().contiguous(), affine.detach().contiguous()
        ctx.kernels = kernels
        ctx.save_for_backward(picture, affine)
        if kernels is not None:
            return kernels.affine_colour(affine, picture)
        out = torch.empty_like(picture)
        _native.affine_colour(*arrays((affine, picture, out)))
        return out

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[None, Tensor, Tensor]:
        picture, affine = ctx.saved_tensors
        if ctx.kernels is not None:
            return None, *ctx.kernels.affine_colour_backward(affine, picture, upstream[0].contiguous())
        gradient, by_affine = torch.empty_like(picture), torch.empty_like(affine)
        _native.affine_colour_backward(*arrays((affine, picture, upstream[0].contiguous(), gradient, by_affine)))
        return None, gradient, by_affine
