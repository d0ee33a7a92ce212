"""Passing the gradients of a training's backward pass to the optimizer without storing them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from splatpipe.pipeline.raster.step_lengths import FarSteps
from splatpipe.pipeline.splat.model.gaussians import PARAMETERS

Rate = float | Tensor
"""A learning rate, or a CPU tensor of them that broadcasts to a row's shape."""


@dataclass(frozen=True, eq=False)
class FusedStep:
    """A step of Adam over all parameters of the Gaussians, fused with the end of a backward pass.

    Attributes:
        values: The parameters, or their first rows, changed in place; if a function of the model's logits was rendered,
            with its derivative as the gradient of the logits.
        means: First moments of each, changed in place.
        squares: Second moments of each, changed in place.
        rates: Learning rates of each: one, or for ``sh`` one per coefficient, the same for all but the first.
        options: Beta 1, beta 2, epsilon and the step, counted from 1.
        log_scale_limits: Limits to which the log-scales of the stepped rows are clamped.
        visible: The rows to step; None for all.
        far: Lengthens the steps of far means.
        skipped: Counter to which the rows skipped for their gradients are added.
    """

    values: Mapping[str, Tensor]
    means: Mapping[str, Tensor]
    squares: Mapping[str, Tensor]
    rates: Mapping[str, Rate]
    options: tuple[float, float, float, int]
    log_scale_limits: tuple[float, float]
    visible: Bool[Tensor, " n"] | None
    far: FarSteps | None
    skipped: Int64[Tensor, ""]


@runtime_checkable
class Unfinished(Protocol):
    """A backward pass that stopped at the screen."""

    def can_step(self, parameters: Mapping[str, Tensor], visible: Tensor | None) -> bool:
        """Whether the pass can be fused with a step of some parameters' visible rows; None for all rows."""

    def step(self, step: FusedStep) -> None:
        """Finish the pass and step the parameters; the render's probe gets its gradient."""

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


def can_fuse(parameters: Mapping[str, Tensor], rendered: Sequence[Tensor], logits_are_leaf: bool) -> bool:
    """Whether parameters are those that were rendered, or their first rows, without gradients of their own.

    Args:
        parameters: The parameters to step.
        rendered: The rendered parameters, in the order of ``PARAMETERS``.
        logits_are_leaf: False if a function of the model's logits was rendered, which may be anywhere.
    """
    if tuple(parameters) != PARAMETERS:
        return False
    return all(
        parameters[name].data_ptr() == tensor.data_ptr()
        and len(parameters[name]) <= len(tensor)
        and parameters[name].grad is None
        for name, tensor in zip(PARAMETERS, rendered, strict=True)
        if logits_are_leaf or name != "opacity_logits"
    )


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


def rate_columns(rate: Rate, parameter: Tensor) -> Float32[np.ndarray, " width"]:
    """The rate of every value of a row."""
    each = rate.numpy() if isinstance(rate, Tensor) else rate
    return np.full(parameter.shape[1:], each, np.float32).reshape(-1)
