"""Density control by the gradient of the loss by a Gaussian's place on the image plane.

Published: Kerbl, Kopanas, Leimkühler, Drettakis: "3D Gaussian Splatting for Real-Time Radiance Field Rendering",
SIGGRAPH 2023, section 5: the norm of the gradient, summed with its sign over the pixels. Absolute: Ye et al., "AbsGS",
ACM MM 2024: the pixels' magnitudes are summed, which do not cancel in a Gaussian that is too large for what it covers.

Both keep to our cap, our schedule of growth and our opacity of two that take the place of one (see `densify.py`);
published are what is ranked and its threshold, the learning rates, the opacity resets and the pruning by size.
"""

from __future__ import annotations

from splatpipe.pipeline.train.densify import DensitySchedule
from splatpipe.pipeline.train.density.strategy import Look, ScoredDensity, Seen


class PublishedDensity(ScoredDensity):
    """Ranks by the norm of the summed signed gradient."""

    look = Look(probe=True)

    def observe(self, seen: Seen, schedule: DensitySchedule) -> None:
        """Add the norms, in NDC."""
        if seen.gradient_px is not None:
            height, width = seen.rendered.alpha.shape
            self.statistics.observe(seen.gradient_px, seen.rendered.visible, width, height)
            self.observe_radii(seen, schedule)


class AbsoluteDensity(PublishedDensity):
    """Ranks by the norm of the summed magnitudes."""

    look = Look(probe=True, magnitudes=True)
