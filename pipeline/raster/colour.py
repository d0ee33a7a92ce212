"""Affine maps of a picture's colours: what exposure and white balance do to it."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.raster.isa import _native


def affine_colour(picture: Float[Tensor, "h w 3"], affine: Float[Tensor, "3 4"]) -> Float[Tensor, "h w 3"]:
    """Every pixel's colour c becomes A c + b, with A the map's first three columns and b its last.

    Natively for float32 on the CPU, with the same bits for any number of threads; both arguments get gradients.
    """
    if picture.device.type != "cpu" or picture.dtype != torch.float32 or affine.dtype != torch.float32:
        return picture @ affine[:, :3].T + affine[:, 3]
    result: Tensor = _AffineColour.apply(picture, affine)  # type: ignore[no-untyped-call]
    return result


class _AffineColour(torch.autograd.Function):
    """torch's own product of pixels and a 3 × 3 matrix takes longer than the picture's whole render."""

    @staticmethod
    def forward(ctx: Any, picture: Tensor, affine: Tensor) -> Tensor:
        picture, affine = picture.detach().contiguous(), affine.detach().contiguous()
        out = torch.empty_like(picture)
        _native.affine_colour(affine, picture, out)
        ctx.save_for_backward(picture, affine)
        return out

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, Tensor]:
        picture, affine = ctx.saved_tensors
        gradient, by_affine = torch.empty_like(picture), torch.empty_like(affine)
        _native.affine_colour_backward(affine, picture, upstream[0].contiguous(), gradient, by_affine)
        return gradient, by_affine
