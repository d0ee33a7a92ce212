"""``fused_ssim``: the mean structural similarity of images with its gradient, by the photometric loss's kernels."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import pad

from splatpipe.pipeline.raster.loss import SSIM_REACH_PX, photo_loss

_CHANNELS = 3  # of an image that the kernels take


def fused_ssim(img1: Tensor, img2: Tensor, padding: Literal["same", "valid"] = "same", train: bool = True) -> Tensor:
    """Mean SSIM over all pixels and channels: windows of 11 pixels, σ = 1.5 (Wang et al., 2004), values of 0..1.

    Arguments, and zeros beyond the borders, are those of the package ``fused-ssim``. Kernels for float32 on the CPU
    (bit-identical for any number of threads) and CUDA devices; float64 and other devices use plain torch.

    Args:
        img1: Images (B, C, H, W), 0..1; the only argument that gets a gradient.
        img2: What they are compared with, of the same shape.
        padding: ``same``: every pixel has a window, with zeros beyond the borders. ``valid``: only those whose window
            lies inside.
        train: False: no gradient.

    Returns:
        A scalar, at most 1; 1 - it is a loss.

    Raises:
        ValueError: if shapes, dtypes or devices differ, a size is 0, or the images are too small for a window.
    """
    _check(img1, img2, padding)
    b, c, h, w = img1.shape
    margin = SSIM_REACH_PX if padding == "same" else 0
    planes = [_in_threes(image.reshape(b * c, h, w), margin) for image in (img1, img2.detach())]
    reach = SSIM_REACH_PX  # from a border, beyond which windows lie inside
    inner = (reach, reach, w + 2 * margin - reach, h + 2 * margin - reach)
    with torch.set_grad_enabled(train and torch.is_grad_enabled()):
        each = [1.0 - photo_loss(one, other, 1.0, None, inner) for one, other in zip(*planes, strict=True)]
    # Channels that fill up the last three are equal, with a similarity of 1.
    filled = _CHANNELS * len(each) - b * c
    return (_CHANNELS * torch.stack(each).sum() - filled) / (b * c)


def _in_threes(planes: Tensor, margin: int) -> list[Tensor]:
    """Three planes (n, h, w) at a time as an image, with a margin of zeros; the last ones are filled up with zeros."""
    planes = pad(planes, [margin] * 4 + [0, -len(planes) % _CHANNELS])
    return [three.permute(1, 2, 0).contiguous() for three in torch.split(planes, _CHANNELS)]


def _check(img1: Tensor, img2: Tensor, padding: str) -> None:
    if img1.ndim != 4 or img1.shape != img2.shape or 0 in img1.shape:
        raise ValueError(f"img1 {tuple(img1.shape)} and img2 {tuple(img2.shape)} are not both (B, C, H, W).")
    if img1.dtype not in (torch.float32, torch.float64) or img1.dtype != img2.dtype or img1.device != img2.device:
        raise ValueError("img1 and img2 must be float32, or float64, on one device.")
    if padding not in ("same", "valid"):
        raise ValueError(f"padding is {padding!r}; choose from same, valid.")
    least = 2 * SSIM_REACH_PX + 1 if padding == "valid" else 1
    if min(img1.shape[2:]) < least:
        raise ValueError(f"images of {tuple(img1.shape[2:])} pixels have no whole window of {least}.")
