"""The training history, without clock times: identical for every run of a plan."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from splatpipe.pipeline.train.densify import DensityEvent

CURVE_EVERY = 50  # iterations averaged in a point of the curve


@dataclass
class History:
    """The loss curve and the events of density control.

    Losses are read from the device in batches, when their sum is needed: no iteration waits for them.

    Attributes:
        curve: Points with iteration, mean loss since the previous point, number of Gaussians, SH degree and width of
            the whole photo.
        density: Steps of density control.
        resets: Iterations after which opacities were reset.
        growth_ended: Iteration from which memory allowed no more Gaussians; 0 if memory never ended growth.
        skipped_gradients: Gaussians' gradients skipped because they were not finite, over all iterations.
        loss_sum: Sum of the losses since the last point.
        loss_count: Their number.
        epochs: With `stop_when_flat`, middle iteration and mean loss of the epochs to judge by.
        epoch_sum: Sum of the losses in the current epoch.
        epoch_count: Their number.
        sizes_ended: Iterations after which a flat loss ended a photo size early.
        flat_at: Iteration after which a flat loss started the tail of the schedule; 0 if none did.
    """

    curve: list[dict[str, float | int | None]] = field(default_factory=list)
    density: list[dict[str, int]] = field(default_factory=list)
    resets: list[int] = field(default_factory=list)
    growth_ended: int = 0
    skipped_gradients: int = 0
    loss_sum: float = 0.0
    loss_count: int = 0
    epochs: list[tuple[int, float]] = field(default_factory=list)
    epoch_sum: float = 0.0
    epoch_count: int = 0
    sizes_ended: list[int] = field(default_factory=list)
    flat_at: int = 0

    def __post_init__(self) -> None:
        self._unread: list[Tensor] = []

    def add_loss(self, loss: Tensor) -> None:
        """Count an iteration's loss, a scalar on any device; a non-finite loss is left out."""
        self._unread.append(loss)

    def _read_losses(self) -> None:
        """Add up the counted losses in order, in float64: the sums do not depend on when they are read."""
        if not self._unread:
            return
        losses, self._unread = torch.stack(self._unread).tolist(), []
        for loss in filter(math.isfinite, losses):
            self.loss_sum += loss
            self.loss_count += 1
            self.epoch_sum += loss
            self.epoch_count += 1

    def add_density(self, event: DensityEvent) -> None:
        """Record a step of density control."""
        self.density.append(event.to_json())

    def end_iteration(self, iteration: int, last: bool, facts: Mapping[str, int]) -> None:
        """Add a point to the curve if one is due.

        Args:
            iteration: The current iteration.
            last: Whether the training ends here.
            facts: The point's other values.
        """
        closed = bool(self.curve) and self.curve[-1]["iteration"] == iteration
        if closed or (iteration % CURVE_EVERY != 0 and not last):
            return
        self._read_losses()
        loss = self.loss_sum / self.loss_count if self.loss_count else None
        self.curve.append({"iteration": iteration, "loss": loss, **facts})
        self.loss_sum, self.loss_count = 0.0, 0

    def end_epoch(self, middle: int, judged: bool) -> None:
        """Close an epoch, in which every photo was trained on once, with all of its windows.

        Args:
            middle: Its middle iteration.
            judged: Whether it counts for judging the end of training.
        """
        self._read_losses()
        if judged and self.epoch_count:
            self.epochs.append((middle, self.epoch_sum / self.epoch_count))
        self.epoch_sum, self.epoch_count = 0.0, 0

    def recent_loss(self) -> float | int | None:
        """Mean loss since the last point of the curve, or that point's loss if there is none since."""
        self._read_losses()
        return self.loss_sum / self.loss_count if self.loss_count else self.last_loss()

    def last_loss(self) -> float | int | None:
        """The loss of the curve's last point; None without points."""
        return self.curve[-1]["loss"] if self.curve else None

    def state(self) -> dict[str, Any]:
        """The whole history as JSON values, for a checkpoint."""
        self._read_losses()
        return {
            "curve": self.curve,
            "density": self.density,
            "resets": self.resets,
            "growth_ended": self.growth_ended,
            "skipped_gradients": self.skipped_gradients,
            "loss_sum": self.loss_sum,
            "loss_count": self.loss_count,
            "epochs": self.epochs,
            "epoch_sum": self.epoch_sum,
            "epoch_count": self.epoch_count,
            "sizes_ended": self.sizes_ended,
            "flat_at": self.flat_at,
        }

    def to_json(self) -> str:
        """The text of `history.json`."""
        kept = {name: value for name, value in self.state().items() if not name.startswith(("loss_", "epoch"))}
        for name in ("sizes_ended", "flat_at"):
            if not kept[name]:
                del kept[name]
        return json.dumps(kept, indent=1, allow_nan=False) + "\n"
