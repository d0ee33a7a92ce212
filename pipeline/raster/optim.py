"""Adam over the Gaussians' parameters: fused, sparse over visible rows, with its state open to density control."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatpipe.pipeline.raster.cuda.cuda import AdamRows, kernels_of
from splatpipe.pipeline.raster.device import take_rows
from splatpipe.pipeline.raster.gradients import FusedStep, GradientBuffers, Rate, rate_columns
from splatpipe.pipeline.raster.isa import _native
from splatpipe.pipeline.raster.native_arrays import array_or_none, arrays
from splatpipe.pipeline.raster.step_lengths import FarSteps

_MEAN = "mean."
_SQUARE = "square."
_STEP = "step"
NO_LIMITS = (-math.inf, math.inf)

Limits = Mapping[str, tuple[float, float]]
"""Minimum and maximum of the values, by parameter name."""


class Adam:
    """Adam (Kingma and Ba, ICLR 2015) over named tensors with common rows, one per Gaussian.

    Only the moments live here, on the parameters' device; the parameters are passed to each step, with their ``.grad``.
    The step count, and thus the bias correction, is shared by all rows: a row that joins late or was skipped is
    corrected like the others. Bit-identical for any number of threads, and on every run on a CUDA device.

    Attributes:
        step_count: Steps taken.
        mean: Running means of the gradients, float32, shaped as the parameters.
        square: Running means of their squares.
    """

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        betas: tuple[float, float] = (0.9, 0.999),
        epsilon: float = 1e-15,
    ) -> None:
        """Start with moments of zero.

        Args:
            parameters: (n, ...) tensors, for their names and shapes.
            betas: Decay per step of the moments, each in [0, 1).
            epsilon: Added to the root of the second moment; 3DGS's default.

        Raises:
            ValueError: if the numbers of rows or the constants are wrong.
        """
        if len({tensor.shape[0] for tensor in parameters.values()}) > 1:
            raise ValueError("the parameters differ in their number of rows")
        if not all(0.0 <= beta < 1.0 for beta in betas) or not epsilon > 0.0:
            raise ValueError(f"Adam cannot work with betas {betas} and epsilon {epsilon}")
        self.betas, self.epsilon, self.step_count = betas, epsilon, 0
        self.mean = {name: _zeros(tensor.shape, tensor.device) for name, tensor in parameters.items()}
        self.square = {name: _zeros(tensor.shape, tensor.device) for name, tensor in parameters.items()}
        self._skipped = torch.zeros((), dtype=torch.int64, device=self.device)
        self._held: Limits | None = None  # all rows are within these limits; rows that are not stepped stay so

    def __len__(self) -> int:
        return next((tensor.shape[0] for tensor in self.mean.values()), 0)

    @property
    def device(self) -> torch.device:
        """Device of the moments."""
        return next((tensor.device for tensor in self.mean.values()), torch.device("cpu"))

    @torch.no_grad()
    def step(
        self,
        parameters: Mapping[str, Tensor],
        rates: Mapping[str, Rate],
        visible: Bool[Tensor, " n"] | None = None,
        buffers: GradientBuffers | None = None,
        limits: Limits | None = None,
        far: FarSteps | None = None,
    ) -> None:
        """Step the parameters in place against their ``.grad``; those without one are left alone.

        A row with a non-finite gradient in any parameter is left unchanged, moments included, and counted: see
        ``take_skipped``. If the backward pass deferred its end to the optimizer, it is finished now, fused with the
        step if the parameters have no other gradients; the render's probe then gets its gradient.

        Args:
            parameters: The tensors by the names given at the start: float32, contiguous, on the moments' device.
            rates: Learning rate of each; for ``sh`` see ``sh_rates``.
            visible: Rows to step; the others also keep their moments. None for all.
            buffers: The gradient buffers of the render.
            limits: Values are clamped to these after the step, including rows not stepped (except on CUDA, where those
                have been clamped before).
            far: Lengthens the steps of far ``means``.

        Raises:
            ValueError: if a tensor does not match the moments, or cannot be stepped in place.
        """
        if parameters.keys() != self.mean.keys() or rates.keys() != self.mean.keys():
            raise ValueError(f"parameters and rates are not those of {sorted(self.mean)}")
        unfinished = None if buffers is None else buffers.take_unfinished()
        self._check(parameters, visible, [*self.mean] if unfinished else _with_gradients(parameters))
        fuses = unfinished is not None and _is_fused(rates, limits) and unfinished.can_step(parameters, visible)
        if unfinished is not None and not fuses:
            unfinished.finish(parameters)  # before anything is changed, because it needs memory
        self.step_count += 1
        if unfinished is not None and fuses:
            options, scales = (*self.betas, self.epsilon, self.step_count), (limits or {}).get("log_scales", NO_LIMITS)
            step = FusedStep(parameters, self.mean, self.square, rates, options, scales, visible, far, self._skipped)
            unfinished.step(step)
            if kernels_of(self.device) is not None:  # rows not stepped were clamped by their last step
                return
        else:
            with nullcontext() if far is None else far.lengthened(parameters["means"].detach(), visible):
                self._step_rows(parameters, rates, visible)
            self._held = None
        if self._held != limits:
            for name, (least, most) in (limits or {}).items():
                parameters[name].detach().clamp_(least, most)
            self._held = limits

    def take_skipped(self) -> int:
        """Number of visible rows skipped for their gradients since the last call; waits for the device."""
        skipped = int(self._skipped)
        self._skipped.zero_()
        return skipped

    def _step_rows(
        self, parameters: Mapping[str, Tensor], rates: Mapping[str, Rate], visible: Bool[Tensor, " n"] | None
    ) -> None:
        """Step the parameters that have a gradient."""
        names = _with_gradients(parameters)
        rows = AdamRows(
            [parameters[name].detach() for name in names],
            [_gradient(parameters[name]) for name in names],
            [self.mean[name] for name in names],
            [self.square[name] for name in names],
            [torch.from_numpy(rate_columns(rates[name], parameters[name])) for name in names],
            None if visible is None else visible.contiguous().view(torch.uint8),
        )
        options = (*self.betas, self.epsilon, self.step_count)
        kernels = kernels_of(self.device)
        if kernels is not None:
            kernels.adam(rows, options, self._skipped)
        else:
            self._skipped += step_on_cpu(rows, options)

    def _check(
        self, parameters: Mapping[str, Tensor], visible: Bool[Tensor, " n"] | None, stepped: Iterable[str]
    ) -> None:
        """Reject tensors that cannot be stepped.

        Raises:
            ValueError: as in ``step``.
        """
        device = self.device
        taken = device.type == "cpu" or kernels_of(device) is not None
        for name in stepped:
            tensor = parameters[name]
            if tensor.shape != self.mean[name].shape:
                raise ValueError(f"{name} is {tuple(tensor.shape)}, its moments {tuple(self.mean[name].shape)}")
            if tensor.dtype != torch.float32 or tensor.device != device or not tensor.is_contiguous() or not taken:
                raise ValueError(f"{name} is not a contiguous float32 tensor that kernels on {device} step")
        if visible is not None and (visible.shape != (len(self),) or visible.dtype != torch.bool):
            raise ValueError(
                f"visible is {tuple(visible.shape)} of {visible.dtype}, not a bool for each of {len(self)}"
            )

    def select(self, index: Int[Tensor, " m"] | Bool[Tensor, " n"]) -> None:
        """Keep the rows of an index or a mask, in its order; one tensor at a time, because memory is tight."""
        self._held = None
        for moments in (self.mean, self.square):
            take_rows(moments, index)

    def append(self, count: int) -> None:
        """Add rows of zero moments."""
        self._held = None
        self._each(lambda tensor: torch.cat([tensor, _zeros((count, *tensor.shape[1:]), tensor.device)]))

    def zero_state(
        self, rows: Int[Tensor, " m"] | Bool[Tensor, " n"] | None = None, names: Iterable[str] | None = None
    ) -> None:
        """Clear moments.

        Args:
            rows: Rows to clear; None for all.
            names: Parameters to clear; None for all.
        """
        for name in self.mean if names is None else names:
            for moments in (self.mean[name], self.square[name]):
                moments[slice(None) if rows is None else rows] = 0.0

    def state_dict(self) -> dict[str, Tensor]:
        """Mutable state as plain tensors, not copied."""
        state = {_STEP: torch.tensor(self.step_count, dtype=torch.int64)}
        state |= {_MEAN + name: tensor for name, tensor in self.mean.items()}
        return state | {_SQUARE + name: tensor for name, tensor in self.square.items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """The inverse of ``state_dict``; the number of rows may differ from the current one, the parameters may not.

        Raises:
            ValueError: if the state belongs to other parameters.
        """
        given: list[dict[str, Tensor]] = []
        for prefix in (_MEAN, _SQUARE):
            moments = {name: state.get(prefix + name, torch.empty(0)) for name in self.mean}
            for name, tensor in moments.items():
                if tensor.shape[1:] != self.mean[name].shape[1:] or tensor.dtype != torch.float32:
                    raise ValueError(f"the state has no moments of {name} in its shape")
            given.append(moments)
        if len({tensor.shape[0] for part in given for tensor in part.values()}) > 1 or _STEP not in state:
            raise ValueError("the state's moments differ in their number of rows, or its step is missing")
        device, self._held = self.device, None
        for moments, part in zip((self.mean, self.square), given, strict=True):
            for name, tensor in part.items():
                moments[name] = _zeros((0,), device)  # frees the old ones first: a device may not hold both
                moments[name] = tensor.to(device, copy=True)
        self.step_count = int(state[_STEP])

    def _each(self, change: Callable[[Tensor], Tensor]) -> None:
        self.mean = {name: change(tensor) for name, tensor in self.mean.items()}
        self.square = {name: change(tensor) for name, tensor in self.square.items()}


def step_on_cpu(rows: AdamRows, options: tuple[float, float, float, int]) -> int:
    """Step rows with the native kernel, and return how many were skipped for their gradients.

    Args:
        rows: Tensors on the CPU.
        options: Beta 1, beta 2, epsilon and the step, counted from 1.
    """
    values, gradients = arrays(rows.values), arrays(rows.gradients)
    means, squares, rates = arrays(rows.means), arrays(rows.squares), arrays(rows.rates)
    return _native.adam_step(values, gradients, means, squares, rates, array_or_none(rows.visible), options)


@functools.lru_cache(maxsize=8)
def sh_rates(coefficients: int, constant: float, higher: float) -> Float[Tensor, "k 1"]:
    """Learning rates of an (n, k, 3) tensor of spherical harmonics; not to be changed, for they are kept.

    Args:
        coefficients: k.
        constant: Rate of the constant band.
        higher: Rate of the other bands; 3DGS divides by 20.
    """
    rates = torch.full((coefficients, 1), higher)
    rates[0] = constant
    return rates


def _zeros(shape: Iterable[int], device: torch.device) -> Tensor:
    return torch.zeros(tuple(shape), dtype=torch.float32, device=device)


def _with_gradients(parameters: Mapping[str, Tensor]) -> list[str]:
    return [name for name, tensor in parameters.items() if tensor.grad is not None]


def _is_fused(rates: Mapping[str, Rate], limits: Limits | None) -> bool:
    """Whether the fused step supports these: one rate per parameter, two for SH, limits for scales only."""
    plain = all(not isinstance(rate, Tensor) or rate.numel() == 1 for name, rate in rates.items() if name != "sh")
    sh = rates.get("sh", 0.0)
    higher = sh.flatten()[1:].tolist() if isinstance(sh, Tensor) else []
    return plain and len(set(higher)) <= 1 and (limits or {}).keys() <= {"log_scales"}


def _gradient(parameter: Tensor) -> Tensor:
    assert parameter.grad is not None
    return parameter.grad.detach().contiguous()
