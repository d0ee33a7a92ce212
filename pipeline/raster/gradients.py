"""Where the gradients of a training's backward pass go: to the optimiser, never to memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from splatpipe.pipeline.splat.gaussians import PARAMETERS

if TYPE_CHECKING:
    from splatpipe.pipeline.raster.autograd import UnfinishedRender
    from splatpipe.pipeline.raster.cuda_frame import UnfinishedBackward


class GradientBuffers:
    """What a backward pass leaves for the optimiser.

    Gradients of all Gaussians would take as much memory as the model, most of them zeros where a photo or a window
    shows a part of it. So the pass stops at the screen and leaves the rest of it here for the optimiser, which does
    it together with its step (``optim.Adam.step``).

    Attributes:
        unfinished: What the last backward pass left for the optimiser.
    """

    def __init__(self) -> None:
        self.unfinished: UnfinishedBackward | UnfinishedRender | None = None

    def take_unfinished(self) -> UnfinishedBackward | UnfinishedRender | None:
        """What is left of the backward pass, once."""
        unfinished, self.unfinished = self.unfinished, None
        return unfinished


def can_wait(wanted: Sequence[bool], leaves: Sequence[bool], probe: Tensor | None) -> bool:
    """Whether the parameters' gradients can be left to the optimiser: all are the model's own, but for the logits.

    Args:
        wanted: Whether each has one, in the order of ``PARAMETERS``.
        leaves: Whether each is the model's own.
        probe: The render's.
    """
    own = (leaf for name, leaf in zip(PARAMETERS, leaves, strict=True) if name != "opacity_logits")
    return all(wanted) and all(own) and (probe is None or probe.is_leaf)


def add_gradients(parameters: Mapping[str, Tensor], gradients: Sequence[Tensor], logits_are_leaf: bool) -> None:
    """Add what a backward pass gives to the parameters' gradients.

    Args:
        parameters: Changed; what was rendered, or its first rows.
        gradients: In the order of ``PARAMETERS``.
        logits_are_leaf: False where the model's logits hold the derivative of the rendered ones for a gradient.
    """
    for name, gradient in zip(PARAMETERS, gradients, strict=True):
        before, gradient = parameters[name].grad, gradient[: len(parameters[name])]
        if name == "opacity_logits" and not logits_are_leaf:
            assert before is not None
            parameters[name].grad = gradient * before
        else:
            parameters[name].grad = gradient if before is None else before + gradient
