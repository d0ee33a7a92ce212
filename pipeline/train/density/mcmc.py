"""Density control as sampling: dead Gaussians are relocated onto live ones, and positions are disturbed by noise.

Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", NeurIPS 2024. Every step moves the Gaussians
below the pruning limit onto live ones, drawn in proportion to opacity, and adds copies of such draws; the N that share
a place get the opacity and the size that keep their sum as it was. Every iteration adds noise to the positions
(stochastic gradient Langevin dynamics), shaped by the covariance and large only for nearly transparent Gaussians. Two
decays, of opacity and of size, let those die that the photos do not need.

Otherwise than published, the number rises to the cap by our schedule instead of by 5 % a step, so that short runs reach
it, and it is one draw for the dead and the new.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.train.densify import DensitySchedule, Growth, rotate
from splatpipe.pipeline.train.density.strategy import Density, DensityStep, Seen
from splatpipe.pipeline.train.draws import POSITION_NOISE, RELOCATION, normal, uniform

OPACITY_DECAY, SCALE_DECAY = 0.01, 0.01  # weights of the means over all Gaussians in the loss: published
NOISE = 5e5  # of positions, times their learning rate and the covariance: published
NOISE_SHARPNESS = 100.0  # published: noise falls by e each 0.01 of opacity
NOISE_OPACITY = 0.005  # published: half of the noise is left there
LEAST_NOISE = 1e-6  # share of the noise below which it is left out: it moves no Gaussian by a thousandth of its size
PROFILE_STEP, PROFILE_NODES = 1.0 / 16.0, 97  # a Gaussian's profile up to 6·√2 σ: the trapezoid rule is exact to 1e-8
CHUNK_ROWS = 8192  # whose profiles are held at a time: 6 MB


class McmcDensity(Density):
    """Moves the dead and adds to the opaque; nothing is observed, nothing pruned."""

    def __init__(self, count: int) -> None: ...

    def observe(self, seen: Seen, schedule: DensitySchedule) -> None:
        """Nothing."""

    def add_gradients(self, gaussians: Gaussians, visible: Bool[Tensor, " n"], extent: float) -> None:
        """Those of the decays: the mean opacity, and the mean of the three axes' sum over the extent."""
        logits, scales = gaussians.opacity_logits, gaussians.log_scales
        assert logits.grad is not None and scales.grad is not None
        with torch.no_grad():
            opacity = torch.sigmoid(logits)
            logits.grad += (OPACITY_DECAY / len(gaussians)) * visible * opacity * (1.0 - opacity)
            scales.grad += (SCALE_DECAY / (len(gaussians) * extent)) * visible[:, None] * torch.exp(scales)

    def stepped(self, gaussians: Gaussians, schedule: DensitySchedule, means_rate: float, iteration: int) -> None:
        """Disturb the positions."""
        if schedule.on:
            disturb(gaussians, means_rate, schedule.seed, iteration)

    def control(self, gaussians: Gaussians, step: DensityStep) -> tuple[Growth, dict[str, int]]:
        """Relocate the dead and add up to the limit."""
        schedule = step.schedule
        opacity = torch.sigmoid(step.rendered.opacity_logits.double())
        dead = (opacity < schedule.prune_opacity) | ~gaussians.finite() | step.unwanted
        live, moved = torch.nonzero(~dead).flatten(), torch.nonzero(dead).flatten()
        added = max(0, step.limit - len(gaussians))
        if len(live) == 0:
            moved, added = moved[:0], 0
        parents = draw_parents(live, opacity[live], len(moved) + added, schedule.seed, step.iteration)
        source = torch.cat((torch.arange(len(gaussians)), parents[len(moved) :]))
        source[moved] = parents[: len(moved)]
        copies = 1 + torch.bincount(parents, minlength=len(gaussians))
        logits, log_scales = shared(gaussians, copies)
        growth = Growth(source, copies[source] > 1, gaussians.means[source], log_scales[source], logits[source])
        return growth, {"cloned": 0, "split": 0, "pruned": 0, "held_back": 0, "relocated": len(moved), "added": added}

    def restart(self, count: int) -> None:
        """Nothing was observed."""

    def to_arrays(self) -> dict[str, Tensor]:
        """Nothing."""
        return {}

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """Nothing."""


def draw_parents(
    live: Int64[Tensor, " k"], opacity: Float[Tensor, " k"], count: int, seed: int, iteration: int
) -> Int64[Tensor, " c"]:
    """Draw rows of the live in proportion to their opacity, with replacement.

    Args:
        live: Their rows.
        opacity: Of each.
        count: How many are drawn.
        seed: The run's.
        iteration: Names the random numbers.
    """
    if count == 0:
        return live[:0]
    below = np.cumsum(opacity.numpy())
    at = below[-1] * uniform(seed, iteration, RELOCATION, np.arange(count))
    return live[torch.from_numpy(np.searchsorted(below, at, side="right").clip(max=len(below) - 1))]


def shared(gaussians: Gaussians, copies: Int64[Tensor, " n"]) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Opacity logits and log-scales of Gaussians that are there N times, so that they look as the one did.

    After Kheradmand et al.: the opacity 1 - (1 - α)^(1/N), and a size by which the composite of the N has the
    integral of the one along any line through the centre. The paper's double sum of binomials is the same integral,
    ∫ 1 - (1 - α_N e^(-u²))^N du, written out; as an integral it does not cancel for any N.

    Args:
        gaussians: The model.
        copies: N of each; rows with 1 stay as they are.
    """
    logits, log_scales = gaussians.opacity_logits.clone(), gaussians.log_scales.clone()
    for rows in torch.split(torch.nonzero(copies > 1).flatten(), CHUNK_ROWS):
        number, old = copies[rows].double(), gaussians.opacity_logits[rows].double()
        log_through = torch.nn.functional.logsigmoid(-old) / number  # ln (1 - α)^(1/N)
        new = -torch.expm1(log_through)
        logits[rows] = (torch.log(new) - log_through).float()
        ratio = torch.sigmoid(old) / composite_integral(new, number)
        log_scales[rows] += torch.log(ratio).float()[:, None]
    return logits, log_scales


def composite_integral(opacity: Float[Tensor, " k"], copies: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    """2/√π · ∫ 1 - (1 - α e^(-u²))^N du from 0 on: what N coinciding Gaussians hide along a line; α for N = 1."""
    u = PROFILE_STEP * torch.arange(PROFILE_NODES, dtype=torch.float64)
    weight = torch.full_like(u, PROFILE_STEP * 2.0 / math.sqrt(math.pi))
    weight[0] *= 0.5
    log_through = torch.log1p(-opacity[:, None] * torch.exp(-u * u))  # (k, nodes)
    return -(torch.expm1(copies[:, None] * log_through) * weight).sum(dim=1)


def disturb(gaussians: Gaussians, means_rate: float, seed: int, iteration: int) -> None:
    """Add noise to the positions, in place: rate · 5e5 · σ(-100 (α - 0.005)) · Σ η, with η standard normal.

    Args:
        gaussians: Detached.
        means_rate: Learning rate of positions, world units; the frame is normalised, as the published one.
        seed: The run's.
        iteration: Names the random numbers.
    """
    opacity = torch.sigmoid(gaussians.opacity_logits)
    share = torch.sigmoid(-NOISE_SHARPNESS * (opacity - NOISE_OPACITY))
    rows = torch.nonzero(share > LEAST_NOISE).flatten()
    index = 3 * rows.numpy().astype(np.uint64)[:, None] + np.arange(3, dtype=np.uint64)
    unit = torch.from_numpy(normal(seed, iteration, POSITION_NOISE, index).astype(np.float32))  # (k, 3)
    quats = gaussians.quats[rows]
    local = rotate(quats * torch.tensor([1.0, -1.0, -1.0, -1.0]), unit)
    offset = rotate(quats, torch.exp(2.0 * gaussians.log_scales[rows]) * local)
    gaussians.means[rows] += NOISE * means_rate * share[rows, None] * offset
