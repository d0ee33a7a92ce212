"""The gradient of a picture's weighted sum: a vector-Jacobian product."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def pulled_back(picture: Float[Tensor, "h w 3"], weights: Float[Tensor, "h w 3"], leaf: Tensor) -> Tensor:
    """Derivative of the sum of a picture's values, each times a weight, with respect to a tensor, in its shape.

    Args:
        picture: A differentiable function of ``leaf``.
        weights: The values' weights.
        leaf: The tensor.
    """
    # Not given to autograd as `grad_outputs`: it would import SymPy to compare shapes, for most of a CPU second.
    total = torch.dot(picture.reshape(-1), weights.reshape(-1))
    (found,) = torch.autograd.grad(total, leaf)
    return found
