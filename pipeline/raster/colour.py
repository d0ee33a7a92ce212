"""Affine maps of a picture's colours: what exposure and white balance do to it, all over or by place and brightness."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample

from splatpipe.pipeline.raster import _native

LUMA = (0.299, 0.587, 0.114)
"""ITU-R BT.601 luma from gamma-coded RGB."""


def affine_colour(picture: Float[Tensor, "h w 3"], affine: Float[Tensor, "3 4"]) -> Float[Tensor, "h w 3"]:
    """Every pixel's colour c becomes A c + b, with A the map's first three columns and b its last.

    Natively for float32 on the CPU, with the same bits for any number of threads; both arguments get gradients.
    """
    if picture.device.type != "cpu" or picture.dtype != torch.float32 or affine.dtype != torch.float32:
        return picture @ affine[:, :3].T + affine[:, 3]
    result: Tensor = _AffineColour.apply(picture, affine)  # type: ignore[no-untyped-call]
    return result


def bilateral_colour(
    picture: Float[Tensor, "h w 3"], grid: Float[Tensor, "levels rows columns 12"]
) -> Float[Tensor, "h w 3"]:
    """Every pixel's colour through the affine map that a bilateral grid has for its place and luminance.

    The grid of Chen, Paris and Durand, "Real-time edge-aware image processing with the bilateral grid" (SIGGRAPH 2007),
    with affine maps in it. Its nodes lie evenly from edge to edge of the picture, whatever the picture's size, and of
    luminance from 0 to 1; between them the maps are interpolated linearly. Natively for float32 on the CPU, with the
    same bits for any number of threads. Both arguments get gradients; the picture's is exact: it counts that with its
    luminance a pixel's map changes.

    Args:
        picture: Its colours; luminance is cut off at 0 and 1, the colours are not.
        grid: The rows of each map one behind the other, 2 to 16 levels and 2 to 64 nodes a side.

    Raises:
        ValueError: if the grid has another size.
    """
    if picture.device.type != "cpu" or picture.dtype != torch.float32 or grid.dtype != torch.float32:
        return bilateral_colour_reference(picture, grid)
    result: Tensor = _BilateralColour.apply(picture, grid)  # type: ignore[no-untyped-call]
    return result


def bilateral_colour_reference(
    picture: Float[Tensor, "h w 3"], grid: Float[Tensor, "levels rows columns 12"]
) -> Float[Tensor, "h w 3"]:
    """The definition of ``bilateral_colour``, in torch on any device."""
    height, width, _ = picture.shape
    x, y = ((2.0 * torch.arange(size).to(picture) + 1.0) / size - 1.0 for size in (width, height))  # -1..1, outer edges
    z = 2.0 * (picture @ picture.new_tensor(LUMA)).clamp(0.0, 1.0) - 1.0
    place = torch.stack([x.expand(height, width), y[:, None].expand(height, width), z], dim=-1)  # (h, w, 3)
    entries = grid.permute(3, 0, 1, 2)[None]  # (1, 12, levels, rows, columns)
    maps = grid_sample(entries, place[None, None], padding_mode="border", align_corners=True)  # (1, 12, 1, h, w)
    rows = maps[0, :, 0].permute(1, 2, 0).reshape(height, width, 3, 4)
    return torch.einsum("hwij,hwj->hwi", rows[..., :3], picture) + rows[..., 3]


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


class _BilateralColour(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, picture: Tensor, grid: Tensor) -> Tensor:
        picture, grid = picture.detach().contiguous(), grid.detach().contiguous()
        out = torch.empty_like(picture)
        _native.bilateral_colour(grid, picture, out)
        ctx.save_for_backward(picture, grid)
        return out

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, Tensor]:
        picture, grid = ctx.saved_tensors
        gradient, by_grid = torch.empty_like(picture), torch.empty_like(grid)
        _native.bilateral_colour_backward(grid, picture, upstream[0].contiguous(), gradient, by_grid)
        return gradient, by_grid
