"""Adam over the Gaussians' parameters: fused, sparse over what was seen, its state open to density control."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatpipe.pipeline.raster.isa import _native

_MEAN = "mean."
_SQUARE = "square."
_STEP = "step"

Rate = float | Tensor
"""A learning rate, or a tensor of them that broadcasts to a row's shape."""


class Adam:
    """Adam (Kingma and Ba, ICLR 2015) over named tensors that share their rows, one a Gaussian.

    Only the moments live here; the parameters are handed to each step, with their ``.grad``. The step count, and with
    it the bias correction, is one for all rows: a row that joins late, or sat out, is corrected as the others are.
    The same bits for any number of threads.

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
            betas: Decay a step of the moments, each in [0, 1).
            epsilon: Added to the root of the second moment; 3DGS's default.

        Raises:
            ValueError: if the numbers of rows or the constants are wrong.
        """
        if len({tensor.shape[0] for tensor in parameters.values()}) > 1:
            raise ValueError("the parameters differ in their number of rows")
        if not all(0.0 <= beta < 1.0 for beta in betas) or not epsilon > 0.0:
            raise ValueError(f"Adam cannot work with betas {betas} and epsilon {epsilon}")
        self.betas, self.epsilon, self.step_count = betas, epsilon, 0
        self.mean = {name: _zeros(tensor.shape) for name, tensor in parameters.items()}
        self.square = {name: _zeros(tensor.shape) for name, tensor in parameters.items()}

    def __len__(self) -> int:
        return next((tensor.shape[0] for tensor in self.mean.values()), 0)

    @torch.no_grad()
    def step(
        self,
        parameters: Mapping[str, Tensor],
        rates: Mapping[str, Rate],
        visible: Bool[Tensor, " n"] | None = None,
    ) -> int:
        """Step the parameters in place against their ``.grad``; those without one are left alone.

        A row with a gradient that is not finite in any parameter is left as it is, moments included.

        Args:
            parameters: The tensors by the names given at the start: float32, on the CPU, contiguous.
            rates: Learning rate of each; for ``sh`` see ``sh_rates``.
            visible: Rows that take part; the others keep their moments too. None: all.

        Returns:
            How many visible rows were left out for their gradients.

        Raises:
            ValueError: if a tensor is not what the moments belong to, or cannot be stepped in place.
        """
        if parameters.keys() != self.mean.keys() or rates.keys() != self.mean.keys():
            raise ValueError(f"parameters and rates are not those of {sorted(self.mean)}")
        names = [name for name, tensor in parameters.items() if tensor.grad is not None]
        values = [parameters[name].detach() for name in names]
        for name, tensor in zip(names, values, strict=True):
            if tensor.shape != self.mean[name].shape:
                raise ValueError(f"{name} is {tuple(tensor.shape)}, its moments {tuple(self.mean[name].shape)}")
            if tensor.dtype != torch.float32 or tensor.device.type != "cpu" or not tensor.is_contiguous():
                raise ValueError(f"{name} is not a contiguous float32 tensor on the CPU")
        if visible is not None and (visible.shape != (len(self),) or visible.dtype != torch.bool):
            raise ValueError(
                f"visible is {tuple(visible.shape)} of {visible.dtype}, not a bool for each of {len(self)}"
            )
        self.step_count += 1
        skipped: int = _native.adam_step(
            values,
            [_gradient(parameters[name]) for name in names],
            [self.mean[name] for name in names],
            [self.square[name] for name in names],
            [_columns(rates[name], parameters[name]) for name in names],
            None if visible is None else visible.contiguous().view(torch.uint8),
            (*self.betas, self.epsilon, self.step_count),
        )
        return skipped

    def select(self, index: Int[Tensor, " m"] | Bool[Tensor, " n"]) -> None:
        """Keep the rows of an index or a mask, in its order."""
        self._each(lambda tensor: tensor[index])

    def append(self, count: int) -> None:
        """Add rows of zero moments."""
        self._each(lambda tensor: torch.cat([tensor, _zeros((count, *tensor.shape[1:]))]))

    def zero_state(
        self, rows: Int[Tensor, " m"] | Bool[Tensor, " n"] | None = None, names: Iterable[str] | None = None
    ) -> None:
        """Clear moments.

        Args:
            rows: Which rows; None: all.
            names: Of which parameters; None: of all.
        """
        for name in self.mean if names is None else names:
            for moments in (self.mean[name], self.square[name]):
                moments[slice(None) if rows is None else rows] = 0.0

    def state_dict(self) -> dict[str, Tensor]:
        """All that changes, as plain tensors, not copied."""
        state = {_STEP: torch.tensor(self.step_count, dtype=torch.int64)}
        state |= {_MEAN + name: tensor for name, tensor in self.mean.items()}
        return state | {_SQUARE + name: tensor for name, tensor in self.square.items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """The inverse of ``state_dict``; the number of rows may differ from this one's, the parameters not.

        Raises:
            ValueError: if the state is of other parameters.
        """
        loaded: list[dict[str, Tensor]] = []
        for prefix in (_MEAN, _SQUARE):
            moments = {name: state.get(prefix + name, torch.empty(0)) for name in self.mean}
            for name, tensor in moments.items():
                if tensor.shape[1:] != self.mean[name].shape[1:] or tensor.dtype != torch.float32:
                    raise ValueError(f"the state has no moments of {name} in its shape")
            loaded.append({name: tensor.clone() for name, tensor in moments.items()})
        if len({tensor.shape[0] for part in loaded for tensor in part.values()}) > 1 or _STEP not in state:
            raise ValueError("the state's moments differ in their number of rows, or its step is missing")
        self.mean, self.square = loaded
        self.step_count = int(state[_STEP])

    def _each(self, change: Callable[[Tensor], Tensor]) -> None:
        self.mean = {name: change(tensor) for name, tensor in self.mean.items()}
        self.square = {name: change(tensor) for name, tensor in self.square.items()}


def sh_rates(coefficients: int, constant: float, higher: float) -> Float[Tensor, "k 1"]:
    """Learning rates of an (n, k, 3) tensor of spherical harmonics.

    Args:
        coefficients: k.
        constant: Rate of the constant band.
        higher: Rate of the other bands; 3DGS divides by 20.
    """
    rates = torch.full((coefficients, 1), higher)
    rates[0] = constant
    return rates


def _zeros(shape: Iterable[int]) -> Tensor:
    return torch.zeros(tuple(shape), dtype=torch.float32)


def _gradient(parameter: Tensor) -> Tensor:
    assert parameter.grad is not None
    return parameter.grad.detach().contiguous()


def _columns(rate: Rate, parameter: Tensor) -> Float[Tensor, " width"]:
    """The rate of every value of a row."""
    return torch.as_tensor(rate, dtype=torch.float32).expand(parameter.shape[1:]).reshape(-1).contiguous()
