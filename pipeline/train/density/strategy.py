"""What a strategy of density control is asked for, and what it is told."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.raster.rasterizer import Render
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.train.densify import DensitySchedule, DensityStatistics, Growth, grow, prune_mask


@dataclass(frozen=True)
class Look:
    """What a strategy wants of an iteration's render.

    Attributes:
        probe: The gradient by the means on the image plane.
        magnitudes: As the sum of its absolute values over the pixels.
    """

    probe: bool = False
    magnitudes: bool = False


BLIND = Look()


@dataclass(frozen=True)
class Seen:
    """An iteration after the loss's backward pass, before the parameters step.

    Attributes:
        rendered: What was compared with the photo.
        gradient_px: (n, 2) by the means on the image plane, pixels; None where ``Look.probe`` did not ask for it.
    """

    rendered: Render
    gradient_px: Float[Tensor, "n 2"] | None


@dataclass(frozen=True)
class DensityStep:
    """A step of density control.

    Attributes:
        schedule: Of density control.
        extent: Of the scene, world units.
        limit: The most Gaussians that may be left.
        iteration: The one that ends.
        rendered: The model as it is rendered, for its opacities and sizes.
        unwanted: (n,) Gaussians that have to go, whatever their size and opacity.
    """

    schedule: DensitySchedule
    extent: float
    limit: int
    iteration: int
    rendered: Gaussians
    unwanted: Bool[Tensor, " n"]


class Density(ABC):
    """A strategy, with what it has observed since its last step.

    Attributes:
        look: What it wants of an iteration's render, up to its last step.
    """

    look: ClassVar[Look] = BLIND

    @abstractmethod
    def __init__(self, count: int) -> None: ...

    @abstractmethod
    def observe(self, seen: Seen, schedule: DensitySchedule) -> None:
        """Add an iteration that was rendered as ``look`` asks for."""

    @abstractmethod
    def add_gradients(self, gaussians: Gaussians, visible: Bool[Tensor, " n"], extent: float) -> None:
        """Add to the gradients of the loss what the strategy wants besides, in place.

        Args:
            gaussians: With gradients.
            visible: Those that step.
            extent: Of the scene, world units.
        """

    @abstractmethod
    def stepped(self, gaussians: Gaussians, schedule: DensitySchedule, means_rate: float, iteration: int) -> None:
        """Change the parameters after the optimiser has stepped them, in place.

        Args:
            gaussians: Detached.
            schedule: Of density control.
            means_rate: Learning rate of positions, world units.
            iteration: Names the random numbers.
        """

    @abstractmethod
    def control(self, gaussians: Gaussians, step: DensityStep) -> tuple[Growth, dict[str, int]]:
        """The new rows of the model, and the counts of a ``DensityEvent``; nothing is changed."""

    @abstractmethod
    def restart(self, count: int) -> None:
        """Forget what was observed: the model has new rows."""

    @abstractmethod
    def to_arrays(self) -> dict[str, Tensor]:
        """What was observed, by name, for a checkpoint; not copied."""

    @abstractmethod
    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """The inverse of ``to_arrays``.

        Raises:
            KeyError: if something is missing.
            RuntimeError: if it is of another number of Gaussians.
        """


class ScoredDensity(Density):
    """What the strategies share that prune, then clone or split the Gaussians of the largest mean score.

    Attributes:
        statistics: The score's sums.
    """

    def __init__(self, count: int) -> None:
        self.statistics = DensityStatistics(count)

    def add_gradients(self, gaussians: Gaussians, visible: Bool[Tensor, " n"], extent: float) -> None:
        """Nothing."""

    def stepped(self, gaussians: Gaussians, schedule: DensitySchedule, means_rate: float, iteration: int) -> None:
        """Nothing: the optimiser alone moves the Gaussians."""

    def control(self, gaussians: Gaussians, step: DensityStep) -> tuple[Growth, dict[str, int]]:
        """Prune, then grow to at most the limit."""
        schedule, extent, iteration = step.schedule, step.extent, step.iteration
        gone = prune_mask(step.rendered, schedule, extent, iteration, self.statistics.max_radius_px)
        if not bool((gone | step.unwanted).all()):  # a model is never emptied
            gone |= step.unwanted
        pruned = int(gone.sum())
        score = torch.where(gone, 0.0, self.statistics.score())
        growth, counts = grow(gaussians, score, step.limit - len(gaussians) + pruned, schedule, extent, iteration)
        return growth.select(~gone[growth.source]), {**counts, "pruned": pruned}

    def restart(self, count: int) -> None:
        """Sums of zero."""
        self.statistics = DensityStatistics(count)

    def to_arrays(self) -> dict[str, Tensor]:
        """The sums."""
        return self.statistics.to_arrays()

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """Take the sums over."""
        for name, tensor in self.statistics.to_arrays().items():
            if arrays[name].shape != tensor.shape:
                raise RuntimeError(f"{name} is {tuple(arrays[name].shape)}, not {tuple(tensor.shape)}")
            tensor.copy_(arrays[name])

    def observe_radii(self, seen: Seen, schedule: DensitySchedule) -> None:
        """Add the sizes on screen where pruning looks at them."""
        if schedule.prune_screen_px > 0.0:
            self.statistics.observe_radii(seen.rendered.radii)
