"""Copy small constants to a device without synchronizing with it."""

from __future__ import annotations

import torch
from jaxtyping import Float, Shaped
from torch import Tensor


def upload(tensor: Shaped[Tensor, "*shape"], device: torch.device) -> Shaped[Tensor, "*shape"]:
    """Copy a small CPU tensor to a device, through pinned memory, because other copies wait for the device."""
    pinned = tensor.pin_memory() if device.type == "cuda" else tensor
    return pinned.to(device, non_blocking=True)


def rgb_beside(colour: tuple[float, float, float], other: Tensor) -> Float[Tensor, " 3"]:
    """A colour with another tensor's dtype and device."""
    return upload(torch.tensor(colour, dtype=other.dtype), other.device)
