"""What it costs a splat that a format rounds its positions, in terms of the sizes of its Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float64
from torch import Tensor

from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import NO_OFFSET, SceneFacts

MIN_REPORTED_SHARE = 0.05  # share of Gaussians smaller than a step: fewer are not seen
LOST_STEPS = 4.0  # a Gaussian's largest sizes in a step that displaces it by more than one (a step / √12)
FEW = 10  # Gaussians that may well lie nearer to each other than a step
SAMPLE, EXTENT = 200_000, (0.05, 0.95)  # Gaussians and quantiles that bound a splat's main extent
DESTROYED = 0.2  # share of such Gaussians beyond which the splat falls apart
_ROWS_AT_ONCE = 1 << 16


@dataclass(frozen=True)
class PositionCost:
    """Steps of the positions in a file, against the sizes of its Gaussians, in the splat's units.

    Attributes:
        count: Number of Gaussians.
        step: Median step of a coordinate.
        size: Median size of a Gaussian: the middle one of its standard deviations, as one of many is zero.
        smaller: Number of Gaussians smaller than their step.
        lost: Number of Gaussians displaced by more than their largest standard deviation.
        rounded: Whether the format rounds; false for float32, which a splat had before.
        notes: What else the format does to some Gaussians, a sentence each.
    """

    count: int
    step: float
    size: float
    smaller: int
    lost: int
    rounded: bool = True
    notes: tuple[str, ...] = ()

    @staticmethod
    def of(
        steps: Float64[np.ndarray, " n"] | float,
        sizes: Float64[np.ndarray, "n 2"],
        rounded: bool = True,
        notes: tuple[str, ...] = (),
    ) -> PositionCost:
        """The cost of each Gaussian's step, or of one for all, with the sizes of ``sizes_of``."""
        if not len(sizes):
            return PositionCost(0, 0.0, 0.0, 0, 0, rounded, notes)
        smaller, lost = int((sizes[:, 0] < steps).sum()), int((LOST_STEPS * sizes[:, 1] < steps).sum())
        step, size = float(np.median(steps)), float(np.median(sizes[:, 0]))
        return PositionCost(len(sizes), step, size, smaller, lost, rounded, notes)

    @property
    def destroys(self) -> bool:
        """Whether the file would no longer show the splat."""
        return self.rounded and self.lost > DESTROYED * self.count

    def collapses(self, gaussians: Gaussians) -> bool:
        """Whether all Gaussians, however large, come to lie on a line or in a point."""
        if not self.rounded or self.count < FEW:
            return False
        every = max(1, self.count // SAMPLE)
        low, high = np.quantile(gaussians.means[::every].detach().double().numpy(), EXTENT, axis=0)
        return 0.0 < float(np.sort(high - low)[1]) < self.step

    def summary(self, facts: SceneFacts) -> dict[str, Any]:
        """The origin of the coordinates (z up), steps and sizes, in metres or the file's unit."""
        origin = None if facts.offset == NO_OFFSET else list(facts.turned("z up").offset)
        return {"origin": origin, "metres": facts.metres, "position_step": self.step, "gaussian_size": self.size}

    def warnings(self) -> tuple[str, ...]:
        """What the user has to know about the file, a sentence each; nothing about most files."""
        if not self.rounded or self.smaller <= MIN_REPORTED_SHARE * self.count:
            return self.notes
        few = (
            f"{self.smaller:,} of {self.count:,} Gaussians are smaller than the steps of their positions in this file "
            f"(half of the steps are larger than {two_digits(self.step)}).",
        )
        return few + self.notes


def two_digits(value: float) -> str:
    """A length in an unknown unit."""
    return f"{value:.2g}" if abs(value) < 100.0 else f"{value:,.0f}"


def sizes_of(log_scales: Float[Tensor, "n 3"]) -> Float64[np.ndarray, "n 2"]:
    """The middle one and the largest of each Gaussian's standard deviations."""
    found = np.empty((len(log_scales), 2))
    for start in range(0, len(log_scales), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        found[rows] = log_scales[rows].double().sort(1).values[:, 1:].exp().numpy()
    return found


def float32_cost(gaussians: Gaussians) -> PositionCost:
    """The cost of a format that stores positions as float32."""
    steps = np.empty(len(gaussians))
    for start in range(0, len(gaussians), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        steps[rows] = np.spacing(gaussians.means[rows].detach().float().abs().amax(1).numpy())
    return PositionCost.of(steps, sizes_of(gaussians.log_scales.detach()), rounded=False)
