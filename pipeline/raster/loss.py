"""The photometric loss of training, (1 - w) · L1 + w · (1 - mean SSIM), with its gradient for the render."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.raster.cuda.cuda import CudaKernels, kernels_of
from splatpipe.pipeline.raster.isa import _native
from splatpipe.pipeline.raster.native_arrays import array, array_or_none
from splatpipe.pipeline.splat.quality.metrics import SSIM_WINDOW

Rectangle = tuple[int, int, int, int]
"""Left, top, right, bottom, pixels: columns left to right - 1 of rows top to bottom - 1."""

SSIM_REACH_PX = SSIM_WINDOW // 2
"""Reach of an SSIM window from its centre pixel."""

MIN_SIDE_PX = SSIM_REACH_PX + 1
"""The smallest image whose border can be reflected by half a window."""


def photo_loss(
    render: Float[Tensor, "h w 3"],
    photo: Float[Tensor, "h w 3"],
    ssim_weight: float = 0.2,
    mask: Bool[Tensor, "h w"] | None = None,
    inner: Rectangle | None = None,
) -> Float[Tensor, ""]:
    """The loss of ``photo_loss_reference``, with kernels for float32 on the CPU and CUDA devices.

    The native kernel is within 5e-5 of the reference in float64 (the gradient within 2e-4, L2) and bit-identical for
    any number of threads. On a device the value stays there, without synchronizing.

    For a window cut from a larger image with a margin of ``SSIM_REACH_PX`` on its inner sides, and ``inner`` without
    that margin, the loss equals that of the whole image over those pixels: the losses of windows that tile a photo,
    weighted by their counting pixels, add up to the photo's loss, and so do the gradients.

    Args:
        render: 0..1; the only argument that gets a gradient.
        photo: 0..1.
        ssim_weight: λ of 3D Gaussian splatting, 0..1.
        mask: True where a pixel counts; None for all. If none counts, the loss and its gradient are zero.
        inner: Rectangle of pixels that may count; SSIM windows still see everything. None for all.

    Returns:
        A scalar, in the render's dtype.

    Raises:
        ValueError: if the sizes differ, a side is under 6 pixels, or ``inner`` is empty or not inside the image.
    """
    _check(render, photo, mask, inner)
    kernels = kernels_of(render.device)
    if render.dtype != torch.float32 or (kernels is None and render.device.type != "cpu"):
        return photo_loss_reference(render, photo, ssim_weight, mask, inner)
    result: Tensor = _PhotoLoss.apply(kernels, render, photo, ssim_weight, mask, inner)  # type: ignore[no-untyped-call]
    return result


def photo_loss_reference(
    render: Float[Tensor, "h w 3"],
    photo: Float[Tensor, "h w 3"],
    ssim_weight: float = 0.2,
    mask: Bool[Tensor, "h w"] | None = None,
    inner: Rectangle | None = None,
) -> Float[Tensor, ""]:
    """The loss by its definition: Kerbl et al., 3D Gaussian Splatting (SIGGRAPH 2023), eq. 7, with kornia's SSIM.

    Masked pixels of the render are replaced by the photo's before SSIM; means are over counting pixels.

    Args, returns and errors as ``photo_loss``, in any dtype and on any device.
    """
    from kornia.metrics import ssim  # importing it takes most of a second

    _check(render, photo, mask, inner)
    photo = photo.to(render.dtype)
    counts = torch.ones(render.shape[:2], dtype=torch.bool, device=render.device) if mask is None else mask
    seen = torch.where(counts[..., None], render, photo)
    if inner is not None:
        left, top, right, bottom = inner
        inner_counts = torch.zeros_like(counts)
        inner_counts[top:bottom, left:right] = counts[top:bottom, left:right]
        counts = inner_counts
    similarity = ssim(seen.permute(2, 0, 1)[None], photo.permute(2, 0, 1)[None], SSIM_WINDOW)[0]  # (3, h, w)
    number = 3 * max(1, int(counts.sum()))
    l1 = torch.where(counts[..., None], (seen - photo).abs(), 0.0).sum() / number
    dissimilarity = torch.where(counts, 1.0 - similarity, 0.0).sum() / number
    return (1.0 - ssim_weight) * l1 + ssim_weight * dissimilarity


class _PhotoLoss(torch.autograd.Function):
    """Computes the value and its gradient in one pass over the images."""

    @staticmethod
    def forward(
        ctx: Any,
        kernels: CudaKernels | None,
        render: Tensor,
        photo: Tensor,
        ssim_weight: float,
        mask: Tensor | None,
        inner: Rectangle | None,
    ) -> Tensor:
        seen, compared = render.detach().contiguous(), photo.detach().to(torch.float32).contiguous()
        counts = None if mask is None else mask.contiguous().view(torch.uint8)
        ctx.on_device = kernels is not None
        if kernels is not None:
            loss, gradient = kernels.photo_loss(seen, compared, counts, ssim_weight, inner)
        else:
            gradient = torch.empty_like(seen)
            images = (array(seen), array(compared), array_or_none(counts))
            loss = render.new_tensor(_native.photo_loss(*images, ssim_weight, array(gradient), inner))
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[None, Tensor, None, None, None, None]:
        (gradient,) = ctx.saved_tensors
        if ctx.on_device:  # where reading the factor would synchronize
            return None, gradient * upstream[0], None, None, None, None
        scale = float(upstream[0])
        return None, (gradient if scale == 1.0 else gradient * scale), None, None, None, None


def _check(render: Tensor, photo: Tensor, mask: Tensor | None, inner: Rectangle | None) -> None:
    size = tuple(render.shape[:2])
    if render.ndim != 3 or render.shape[2] != 3 or render.shape != photo.shape:
        raise ValueError(f"render {tuple(render.shape)} and photo {tuple(photo.shape)} are not both (h, w, 3)")
    if mask is not None and (tuple(mask.shape) != size or mask.dtype != torch.bool):
        raise ValueError(f"mask {tuple(mask.shape)} of {mask.dtype} is not a bool mask of {size}")
    if min(size) < MIN_SIDE_PX:
        raise ValueError(f"the loss needs images of {MIN_SIDE_PX} pixels a side, got {size}")
    if inner is not None:
        left, top, right, bottom = inner
        if not (0 <= left < right <= size[1] and 0 <= top < bottom <= size[0]):
            raise ValueError(f"{inner} is no part of an image of {size}")
