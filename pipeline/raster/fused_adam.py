"""``FusedAdam``: torch's interface to the Adam kernels, for tensors of any shape."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, overload

import torch
from jaxtyping import Bool
from torch import Tensor

from splatpipe.pipeline.raster.cuda.cuda import AdamRows, kernels_of
from splatpipe.pipeline.raster.optim import step_on_cpu

_MAX_WIDTH = 64
"""Values of a row that the kernels take."""


class FusedAdam(torch.optim.Optimizer):
    """Adam (Kingma and Ba, ICLR 2015) with one pass over values, gradients and moments.

    The state has torch's names (``step``, ``exp_avg``, ``exp_avg_sq``), so that code that edits the state of
    ``torch.optim.Adam`` edits this one's, as gsplat's strategies do when they add and remove Gaussians. Kernels for
    contiguous float32 tensors on the CPU (bit-identical for any number of threads) and CUDA devices; plain torch
    otherwise. A row (along the first dimension; a part of it where it has more than 64 values) with a gradient that is
    not finite is left as it is.
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        """Start with moments of zero.

        Args:
            params: Tensors, or groups of them with their own ``lr``, ``betas`` and ``eps``.
            lr: Learning rate, ≥ 0.
            betas: Decay of the moments a step, each in [0, 1).
            eps: Added to the root of the second moment, > 0; 3DGS uses 1e-15.

        Raises:
            ValueError: if a number is out of its range.
        """
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add tensors with their own numbers; torch calls this for the first groups as well.

        Args:
            param_group: ``params``, and those of ``lr``, ``betas`` and ``eps`` that are not the optimizer's.

        Raises:
            ValueError: if a number is out of its range.
        """
        lr, betas, eps = ((self.defaults | param_group)[name] for name in ("lr", "betas", "eps"))
        fits = len(betas) == 2 and all(math.isfinite(number) for number in (lr, *betas, eps))
        if not fits or lr < 0.0 or not all(0.0 <= beta < 1.0 for beta in betas) or eps <= 0.0:
            raise ValueError(f"Adam cannot work with lr {lr}, betas {betas}, eps {eps}.")
        super().add_param_group(param_group)

    @overload
    def step(self, closure: None = None, *, visible: Bool[Tensor, " n"] | None = None) -> None: ...
    @overload
    def step(self, closure: Callable[[], float], *, visible: Bool[Tensor, " n"] | None = None) -> float: ...
    @torch.no_grad()
    def step(
        self, closure: Callable[[], float] | None = None, *, visible: Bool[Tensor, " n"] | None = None
    ) -> float | None:
        """Step every parameter that has a gradient.

        Args:
            closure: Evaluates the loss again and returns it.
            visible: Rows to step, along the first dimension of every parameter; the others keep their moments, too.
                None for all.

        Returns:
            What the closure returned.

        Raises:
            ValueError: if ``visible`` does not fit a parameter, or a gradient is sparse.
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._step_one(parameter, group, visible)
        return loss

    def _step_one(self, parameter: Tensor, group: dict[str, Any], visible: Tensor | None) -> None:
        if visible is not None and (visible.dtype != torch.bool or visible.shape != parameter.shape[:1]):
            raise ValueError(
                f"visible is {tuple(visible.shape)} of {visible.dtype}, not a bool for each row of a parameter "
                f"{tuple(parameter.shape)}."
            )
        assert parameter.grad is not None
        if parameter.grad.layout != torch.strided:
            raise ValueError("a gradient is sparse: FusedAdam steps dense ones, and the rows of visible.")
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32, device="cpu")
            state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.contiguous_format)
            state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.contiguous_format)
        state["step"] += 1
        options = (*group["betas"], group["eps"], int(state["step"]))
        moments = (state["exp_avg"], state["exp_avg_sq"])
        kernels = kernels_of(parameter.device)
        on_kernels = kernels is not None or parameter.device.type == "cpu"
        values = (parameter, *moments)
        if not on_kernels or not all(each.is_contiguous() and each.dtype == torch.float32 for each in values):
            _step_plainly(parameter, moments, group["lr"], options, visible)
            return
        rows = _rows(parameter, moments, group["lr"], visible)
        if kernels is not None:
            kernels.adam(rows, options, torch.zeros((), dtype=torch.int64, device=parameter.device))
        else:
            step_on_cpu(rows, options)


def _rows(parameter: Tensor, moments: tuple[Tensor, Tensor], rate: float, visible: Tensor | None) -> AdamRows:
    """The parameter as rows that the kernels take: a wide one is cut into several."""
    assert parameter.grad is not None
    row = math.prod(parameter.shape[1:])
    width = max(size for size in range(1, _MAX_WIDTH + 1) if max(1, row) % size == 0)
    if visible is not None:
        visible = visible.repeat_interleave(row // width).to(torch.uint8)
    cut = [each.detach().contiguous().view(-1, width) for each in (parameter, parameter.grad, *moments)]
    rates = torch.full((width,), rate, dtype=torch.float32, device="cpu")
    return AdamRows([cut[0]], [cut[1]], [cut[2]], [cut[3]], [rates], visible)


def _step_plainly(
    parameter: Tensor,
    moments: tuple[Tensor, Tensor],
    rate: float,
    options: tuple[float, float, float, int],
    visible: Tensor | None,
) -> None:
    """The same step in plain torch."""
    assert parameter.grad is not None
    gradient, (mean, square), (beta1, beta2, epsilon, step) = parameter.grad, moments, options
    rows = len(parameter) if parameter.ndim else 1
    stepped = gradient.isfinite().reshape(rows, math.prod(parameter.shape[1:])).all(1)
    stepped = stepped if visible is None else stepped & visible
    which = stepped.view(-1, *[1] * (parameter.ndim - 1)) if parameter.ndim else stepped[0]
    gradient = torch.where(which, gradient, 0.0)
    mean.copy_(torch.where(which, mean.lerp(gradient, 1.0 - beta1), mean))
    square.copy_(torch.where(which, square * beta2 + gradient.square() * (1.0 - beta2), square))
    denominator = (square / (1.0 - beta2**step)).sqrt() + epsilon
    parameter.sub_(torch.where(which, rate / (1.0 - beta1**step) * mean / denominator, 0.0))
