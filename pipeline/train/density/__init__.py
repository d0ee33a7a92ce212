"""Strategies of density control: three ways to choose where Gaussians are added, behind one interface.

| `train.density` | adds Gaussians where | source |
|---|---|---|
| `published` | the summed screen gradient is long | Kerbl et al., "3D Gaussian Splatting", SIGGRAPH 2023 |
| `absolute` | its pixels' magnitudes sum to much | Ye et al., "AbsGS", ACM MM 2024 |
| `mcmc` | opacity is high, and moves dead Gaussians there | Kheradmand et al., "3DGS as MCMC", NeurIPS 2024 |
"""

from __future__ import annotations

from splatpipe.pipeline.train.density.gradient import AbsoluteDensity, PublishedDensity
from splatpipe.pipeline.train.density.mcmc import McmcDensity
from splatpipe.pipeline.train.density.strategy import BLIND, Density, DensityStep, Look, Seen
from splatpipe.pipeline.train.options import TrainConfig

__all__ = ["BLIND", "Density", "DensityStep", "Look", "Seen", "make_density"]


def make_density(options: TrainConfig, count: int) -> Density:
    """The strategy of `train.density`, with nothing observed yet.

    Args:
        options: Resolved.
        count: Gaussians in the model.
    """
    strategies: dict[str, type[Density]] = {
        "published": PublishedDensity,
        "absolute": AbsoluteDensity,
        "mcmc": McmcDensity,
    }
    return strategies[options.density](count)
