"""Learning rates: the published ones, and their scaling for shorter runs.

Kerbl, Kopanas, Leimkühler, Drettakis: "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

PUBLISHED_RUN = 30_000  # iterations that the published lengths and rates are for
MAX_BOOST = 4.0  # largest factor on learning rates: best at 1,500 iterations; beyond it Gaussians overshoot

PUBLISHED_OPACITY_RATE = 0.05
OPACITY_RATE = 0.15  # at the published rate surfaces become opaque too late


@dataclass(frozen=True)
class Rates:
    """Learning rates of the Gaussians' parameters; all are the published ones unless marked as ours.

    Attributes:
        means: Of positions at the start, times the scene's extent.
        means_final: The same at the schedule's end; exponential in between.
        sh: Of colour, degree 0.
        sh_rest_divisor: Divisor of the rate for the higher degrees.
        opacity: Of opacity logits; ours.
        scales: Of log-scales.
        quats: Of rotations.
        boost: Factor on all rates but opacity's; the final rate of positions is multiplied by its square; ours.
        sparse: Step only the Gaussians that the photo saw; otherwise all, as published, so that unseen ones move on by
            momentum. Ours.
        by_distance: Positions far from the photo's camera take longer steps (see `step_lengths.py`) instead of equal
            ones, as published. Ours.
    """

    means: float = 1.6e-4
    means_final: float = 1.6e-6
    sh: float = 2.5e-3
    sh_rest_divisor: float = 20.0
    opacity: float = OPACITY_RATE
    scales: float = 5e-3
    quats: float = 1e-3
    boost: float = 1.0
    sparse: bool = True
    by_distance: bool = True

    def means_at(self, share: float) -> float:
        """Learning rate of positions at a share of the schedule, to be multiplied by the scene's extent."""
        share = min(1.0, share)
        first, last = self.boost * self.means, self.boost * self.boost * self.means_final
        return math.exp(math.log(first) * (1.0 - share) + math.log(last) * share)


PUBLISHED = Rates(opacity=PUBLISHED_OPACITY_RATE, sparse=False, by_distance=False)


def rates_of(iterations: int) -> Rates:
    """Learning rates of a run: a short one takes longer steps, by the square root of the ratio of lengths."""
    return Rates(boost=round(min(MAX_BOOST, max(1.0, math.sqrt(PUBLISHED_RUN / iterations))), 4))
