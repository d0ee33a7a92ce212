"""Where the gradients of a training's backward pass go."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from splatpipe.pipeline.raster.cuda_frame import UnfinishedBackward


class GradientBuffers:
    """Memory for a model's gradients that every backward pass writes anew.

    The system hands out large memory page by page, cleared: with a million Gaussians that is a quarter of the backward
    pass. The gradients of one pass are gone with the next one, so they must have been used by then, not added up.

    On a CUDA device they are not even written: the backward pass stops at the screen and leaves what is left of it
    here for the optimiser, which does it together with its step (``optim.Adam.step``).

    Attributes:
        unfinished: What the last backward pass left for the optimiser.
    """

    def __init__(self) -> None:
        self._buffers: tuple[Tensor, ...] = ()
        self.unfinished: UnfinishedBackward | None = None

    def like(self, parameters: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Tensors of the parameters' shapes, not initialised; in the memory of the last ones, where those fit."""
        if [buffer.shape for buffer in self._buffers] != [tensor.shape for tensor in parameters]:
            self._buffers = ()
            self._buffers = tuple(torch.empty_like(tensor) for tensor in parameters)
        return tuple(buffer.detach() for buffer in self._buffers)

    def take_unfinished(self) -> UnfinishedBackward | None:
        """What is left of the backward pass, once."""
        unfinished, self.unfinished = self.unfinished, None
        return unfinished
