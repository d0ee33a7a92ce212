"""Passing the gradients of a training's backward pass to the optimizer without storing them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from torch import Tensor

from splatpipe.pipeline.splat.model.gaussians import PARAMETERS


class Unfinished(Protocol):
    """A backward pass that stopped at the screen; each backend has its own step that finishes it."""

    def can_step(self, parameters: Mapping[str, Tensor], visible: Tensor | None) -> bool:
        """Whether the pass can be fused with a step."""

    def finish(self, parameters: Mapping[str, Tensor]) -> None:
        """Finish the pass: add its gradients to those of the parameters, as any backward pass does."""


class GradientBuffers:
    """The unfinished part of a backward pass, for the optimizer.

    Gradients of all Gaussians would take as much memory as the model, most of them zeros if a photo or window shows
    only a part of it. So the pass stops at the screen and leaves the rest to the optimizer, which fuses it with its
    step (``optim.Adam.step``).

    Attributes:
        unfinished: What the last backward pass left for the optimizer.
    """

    def __init__(self) -> None:
        self.unfinished: Unfinished | None = None

    def take_unfinished(self) -> Unfinished | None:
        """Return the unfinished pass and forget it."""
        unfinished, self.unfinished = self.unfinished, None
        return unfinished


def can_wait(wanted: Sequence[bool], leaves: Sequence[bool], probe: Tensor | None) -> bool:
    """Whether the gradients can be left to the optimizer: all parameters except the logits must be the model's own.

    Args:
        wanted: Whether each parameter needs a gradient, in the order of ``PARAMETERS``.
        leaves: Whether each is the model's own (an autograd leaf).
        probe: The render's probe.
    """
    own = (leaf for name, leaf in zip(PARAMETERS, leaves, strict=True) if name != "opacity_logits")
    return all(wanted) and all(own) and (probe is None or probe.is_leaf)


def add_gradients(parameters: Mapping[str, Tensor], gradients: Sequence[Tensor], logits_are_leaf: bool) -> None:
    """Add the gradients of a backward pass to those of the parameters.

    Args:
        parameters: The rendered parameters, or their first rows; their gradients are changed.
        gradients: In the order of ``PARAMETERS``.
        logits_are_leaf: False if the gradient of the model's logits is the derivative of the rendered logits.
    """
    for name, gradient in zip(PARAMETERS, gradients, strict=True):
        before, gradient = parameters[name].grad, gradient[: len(parameters[name])]
        if name == "opacity_logits" and not logits_are_leaf:
            assert before is not None
            parameters[name].grad = gradient * before
        else:
            parameters[name].grad = gradient if before is None else before + gradient
