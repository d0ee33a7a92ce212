"""Small constants on a device, without waiting for what it does."""

from __future__ import annotations

import torch
from jaxtyping import Float, Shaped
from torch import Tensor


def upload(tensor: Shaped[Tensor, "*shape"], device: torch.device) -> Shaped[Tensor, "*shape"]:
    """A small tensor of the CPU's on a device: through pinned memory, for copies from any other wait for the device."""
    pinned = tensor.pin_memory() if device.type == "cuda" else tensor
    return pinned.to(device, non_blocking=True)


def rgb_beside(colour: tuple[float, float, float], other: Tensor) -> Float[Tensor, " 3"]:
    """A colour in another tensor's type and on its device."""
    return upload(torch.tensor(colour, dtype=other.dtype), other.device)
