"""Side models: small models trained beside the Gaussians that describe the photos, not the scene."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool
from torch import Tensor

from splatpipe.pipeline.raster.gradients import Rate
from splatpipe.pipeline.raster.optim import Adam

_MOMENTS = "adam."


class AuxiliaryModel:
    """Named tensors (autograd leaves) with a common row index, and their Adam moments.

    Args:
        tensors: Initial values; copied.
        epsilon: Epsilon of Adam.

    Attributes:
        tensors: (n, ...) each; changed in place.
        adam: Their optimizer.
        is_given: Whether the tensors are fixed and not trained.
    """

    is_given = False

    def __init__(self, tensors: Mapping[str, Tensor], epsilon: float = 1e-15) -> None:
        self.tensors = {name: tensor.detach().clone().requires_grad_() for name, tensor in tensors.items()}
        self.adam = Adam(self.tensors, epsilon=epsilon)

    def give(self) -> None:
        """Freeze the tensors: they were trained elsewhere."""
        self.is_given = True
        for tensor in self.tensors.values():
            tensor.requires_grad_(False)

    def move_to(self, device: torch.device) -> None:
        """Move the still untrained tensors to the training device."""
        if any(tensor.device != device for tensor in self.tensors.values()):
            moved = {name: tensor.detach().to(device) for name, tensor in self.tensors.items()}
            self.tensors = {name: tensor.requires_grad_(not self.is_given) for name, tensor in moved.items()}
            self.adam = Adam(self.tensors, epsilon=self.adam.epsilon)

    def descend(self, rates: Mapping[str, Rate], rows: Bool[Tensor, " n"] | None = None) -> None:
        """Take an optimizer step, then drop the gradients.

        Args:
            rates: Learning rate of each tensor.
            rows: Rows to step; None for all.
        """
        if all(tensor.grad is not None for tensor in self.tensors.values()):
            self.adam.step(self.tensors, rates, rows)
        self.drop_gradients()

    def roll_back(self) -> None:
        """Drop what an incomplete backward pass left behind."""
        self.drop_gradients()

    def drop_gradients(self) -> None:
        """Drop the tensors' gradients."""
        for tensor in self.tensors.values():
            tensor.grad = None

    def to_arrays(self) -> dict[str, Tensor]:
        """Mutable state by name, for a checkpoint; not copied."""
        moments = {_MOMENTS + name: tensor for name, tensor in self.adam.state_dict().items()}
        return {name: tensor.detach() for name, tensor in self.tensors.items()} | moments

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """The inverse of ``to_arrays``.

        Raises:
            KeyError, ValueError: if a tensor is missing or has a different shape; nothing is changed then.
        """
        for name, tensor in self.tensors.items():
            if arrays[name].shape != tensor.shape:
                raise ValueError(f"{name} is {tuple(arrays[name].shape)}, not {tuple(tensor.shape)}")
        moments = {name.removeprefix(_MOMENTS): array for name, array in arrays.items() if name.startswith(_MOMENTS)}
        self.adam.load_state_dict(moments)
        for name, tensor in self.tensors.items():
            tensor.detach().copy_(arrays[name])
