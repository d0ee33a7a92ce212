"""Adaptive density control: cloning, splitting, pruning, opacity resets and the cap on the number of Gaussians.

Kerbl, Kopanas, Leimkühler, Drettakis: "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023,
section 5 and its published settings, with two changes for either score (see `density.py`).
The number of Gaussians rises to a hard cap on a schedule, largest scores first (the idea of Mallick et al.,
"Taming 3DGS", SIGGRAPH Asia 2024). And two Gaussians that replace one get the opacity that lets through as much light
as the original did (Rota Bulò et al., "Revising Densification in Gaussian Splatting", ECCV 2024).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatpipe.pipeline.raster.cuda.cuda import kernels_of
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.morton import morton_keys
from splatpipe.pipeline.train.random_numbers import SPLIT_POSITION, normal

MIN_AFTER_PRUNE = 1  # a model is never emptied: there would be nothing left to learn from

# All published values.
SPLIT_EXTENT = 0.01  # share of the scene's extent: larger Gaussians are split, smaller ones cloned
SPLIT_SHRINK = 1.6  # both halves of a split are smaller by this factor
PRUNE_OPACITY = 0.005  # Gaussians below it are removed: no pixel shows them
PRUNE_EXTENT = 0.1  # share of the extent: larger ones are removed after the first opacity reset
PRUNE_SCREEN_PX = 20.0  # radius on screen; larger ones are removed too, in the published method only: it erodes ground
RESET_OPACITY = 0.01  # an opacity reset leaves no Gaussian above it


@dataclass(frozen=True)
class DensitySchedule:
    """When and how density control acts.

    Attributes:
        on: Whether density control acts at all.
        seed: Seed of the random numbers.
        cap: Maximum number of Gaussians.
        first: First iteration after which it may act.
        last: Last such iteration.
        every: Iterations between its steps.
        gradient: Score above which Gaussians are densified.
        reset_every: Iterations between opacity resets; 0 for none.
        reset_until: No resets after this iteration: windows of finer sizes recur too seldom; 0 for no such limit.
        prune_screen_px: Radius on screen above which Gaussians are removed; 0 for never.
        prune_free_space: Gaussians in front of the surface in this many photos are removed; 0 for never.
        prune_opacity: Opacity below which Gaussians are removed.
        prune_extent: Size, as a share of the scene's extent, above which Gaussians are removed; 0 for never.
    """

    on: bool
    seed: int
    cap: int
    first: int
    last: int
    every: int
    gradient: float
    reset_every: int = 0
    reset_until: int = 0
    prune_screen_px: float = 0.0
    prune_free_space: int = 0
    prune_opacity: float = PRUNE_OPACITY
    prune_extent: float = PRUNE_EXTENT

    def is_step(self, iteration: int) -> bool:
        """Whether density control acts after this iteration."""
        return self.on and self.first <= iteration <= self.last and iteration % self.every == 0

    def is_reset(self, iteration: int) -> bool:
        """Whether opacities are reset after this iteration: never in the last step of density control or later."""
        is_one = self.on and self.reset_every > 0 and iteration % self.reset_every == 0
        return is_one and iteration < min(self.last, self.reset_until or self.last)


@dataclass(frozen=True)
class DensifiedGaussians:
    """New rows for the model: the old Gaussian that each is made from, and the parameters that differ.

    Attributes:
        source: (m,) old row of each new Gaussian.
        fresh: (m,) True for new Gaussians, whose optimizer state starts at zero.
        means: (m, 3) world units.
        log_scales: (m, 3).
        opacity_logits: (m,).
    """

    source: Int64[Tensor, " m"]
    fresh: Bool[Tensor, " m"]
    means: Float[Tensor, "m 3"]
    log_scales: Float[Tensor, "m 3"]
    opacity_logits: Float[Tensor, " m"]

    def select(self, rows: Bool[Tensor, " m"] | Int64[Tensor, " k"]) -> DensifiedGaussians:
        """The rows selected by a mask or an index."""
        return DensifiedGaussians(*(getattr(self, field.name)[rows] for field in fields(self)))


def unchanged(gaussians: Gaussians, rows: Bool[Tensor, " n"]) -> DensifiedGaussians:
    """The Gaussians selected by a mask, unchanged."""
    source = torch.nonzero(rows).flatten()
    fresh = torch.zeros(len(source), dtype=torch.bool, device=source.device)
    kept = (gaussians.means, gaussians.log_scales, gaussians.opacity_logits)  # not SH, which is most of the memory
    return DensifiedGaussians(source, fresh, *(tensor[source] for tensor in kept))


def along_curve(growth: DensifiedGaussians) -> DensifiedGaussians:
    """The same rows in Morton order: what is near in space is near in memory.

    Threads of a CUDA device then read neighbouring memory, and a CPU reads what a window shows in consecutive rows.
    """
    if len(growth.means) == 0:
        return growth
    lowest = growth.means.amin(dim=0)
    size = growth.means.amax(dim=0) - lowest
    kernels = kernels_of(growth.means.device)
    if kernels is None:
        keys = morton_keys(growth.means, lowest, size)
    else:
        keys = kernels.morton(growth.means, tuple(lowest.tolist()), tuple(size.tolist()))
    return growth.select(torch.argsort(keys, stable=True))


@dataclass(frozen=True)
class DensityEvent:
    """The result of a step of density control.

    Attributes:
        iteration: The iteration it followed.
        cloned: Gaussians copied.
        split: Gaussians replaced by two.
        pruned: Gaussians removed.
        held_back: Gaussians that the schedule kept from being densified.
        gaussians: Number of Gaussians after the step.
    """

    iteration: int
    cloned: int
    split: int
    pruned: int
    held_back: int
    gaussians: int

    def to_json(self) -> dict[str, int]:
        """The event as stored in `history.json`."""
        return asdict(self)


def room_at(schedule: DensitySchedule, initial: int, iteration: int) -> int:
    """Number of Gaussians allowed at an iteration: rises to the cap, fast at first and slower towards the last step.

    Gaussians added early have time to be trained; those added late are chosen by better scores. With x the share of
    steps done, the share of growth done is x (2 - x).

    Args:
        schedule: The density-control schedule.
        initial: Number of Gaussians at the start.
        iteration: The current iteration.
    """
    first, last, every = schedule.first, schedule.last, schedule.every
    initial = min(initial, schedule.cap)
    if not schedule.on or iteration < first or last < first:
        return initial
    done = min(1.0, (iteration - first + every) / (last - first + every))
    return initial + int(done * (2.0 - done) * (schedule.cap - initial))


def grow(
    gaussians: Gaussians,
    score: Float[Tensor, " n"],
    room: int,
    schedule: DensitySchedule,
    extent: float,
    iteration: int,
) -> tuple[DensifiedGaussians, dict[str, int]]:
    """Clone small and split large Gaussians whose score exceeds the threshold.

    Those whose halved opacity would be below the pruning limit are left alone: the next step would prune both halves.

    Args:
        gaussians: The model.
        score: ``DensityStatistics.score`` of each Gaussian.
        room: How many Gaussians may be added.
        schedule: The density-control schedule.
        extent: Scene extent, world units.
        iteration: Current iteration; selects the random numbers.

    Returns:
        The new rows (kept ones in their order, then clones, then two children for each split), and the counts
        ``cloned``, ``split`` and ``held_back``.
    """
    resettable = gaussians.opacity_logits >= lowest_logit_to_halve(schedule.prune_opacity)
    wanted = torch.nonzero((score > schedule.gradient) & resettable).flatten()
    chosen = _largest(wanted, score, max(0, room))
    size = gaussians.log_scales.amax(dim=1)
    large = size[chosen] > math.log(SPLIT_EXTENT * extent)
    cloned, split = chosen[~large], chosen[large]

    kept = torch.ones(len(gaussians), dtype=torch.bool, device=size.device)
    kept[split] = False
    old = torch.nonzero(kept).flatten()
    source = torch.cat((old, cloned, split, split))
    fresh = torch.arange(len(source), device=source.device) >= len(old)
    means, log_scales = gaussians.means[source], gaussians.log_scales[source]
    children = len(old) + len(cloned)
    means[children:] += _split_offsets(gaussians, split, schedule.seed, iteration)
    log_scales[children:] -= math.log(SPLIT_SHRINK)
    logits = gaussians.opacity_logits.clone()
    logits[chosen] = half_opacity(logits[chosen])
    counts = {"cloned": len(cloned), "split": len(split), "held_back": len(wanted) - len(chosen)}
    return DensifiedGaussians(source, fresh, means, log_scales, logits[source]), counts


def half_opacity(logits: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    """The logit of the opacity 1 - √(1 - α): two such Gaussians let through as much light as one of opacity α.

    Rota Bulò et al., "Revising Densification in Gaussian Splatting", ECCV 2024.
    """
    log_through = 0.5 * torch.nn.functional.logsigmoid(-logits)  # ln √(1 - α), finite for any logit
    # 1 - √(1 - α) = α / (1 + √(1 - α)), which has no cancellation for small α.
    return torch.nn.functional.logsigmoid(logits) - torch.log1p(torch.exp(log_through)) - log_through


def lowest_logit_to_halve(limit: float) -> float:
    """The logit of the opacity that ``half_opacity`` reduces to the limit α: 1 - (1 - α)²."""
    opacity = limit * (2.0 - limit)
    return math.log(opacity / (1.0 - opacity)) if opacity > 0.0 else -math.inf


def _largest(candidates: Int64[Tensor, " c"], value: Float[Tensor, " n"], limit: int) -> Int64[Tensor, " k"]:
    """The up to ``limit`` candidates of largest value (ties: lowest row first), in row order."""
    if len(candidates) <= limit:
        return candidates
    order = torch.argsort(value[candidates], descending=True, stable=True)
    return candidates[order[:limit]].sort().values


def _split_offsets(gaussians: Gaussians, rows: Int64[Tensor, " s"], seed: int, iteration: int) -> Float[Tensor, "t 3"]:
    """Draw two positions within each parent, relative to its mean: all first ones, then all second ones."""
    if (kernels := kernels_of(rows.device)) is not None:
        return kernels.split_offsets((seed, iteration, SPLIT_POSITION), rows, gaussians.log_scales, gaussians.quats)
    parents = rows.numpy().astype(np.uint64)
    children = np.concatenate((2 * parents, 2 * parents + np.uint64(1)))
    index = (3 * children)[:, None] + np.arange(3, dtype=np.uint64)
    unit = torch.from_numpy(normal(seed, iteration, SPLIT_POSITION, index).astype(np.float32))  # (2s, 3)
    both = torch.cat((rows, rows))
    local = unit * torch.exp(gaussians.log_scales[both])
    return rotate(gaussians.quats[both], local)


def rotate(quats: Float[Tensor, "k 4"], vectors: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"]:
    """Rotate each vector by its quaternion, which need not be normalized."""
    w, axis = quats[:, :1], quats[:, 1:]  # q v q⁻¹ = v + 2 u×(u×v + w v) for |q| = 1
    norm = quats.norm(dim=1, keepdim=True).clamp(min=1e-12)
    w, axis = w / norm, axis / norm
    return vectors + 2.0 * torch.cross(axis, torch.cross(axis, vectors, dim=1) + w * vectors, dim=1)


def prune_mask(
    gaussians: Gaussians,
    schedule: DensitySchedule,
    extent: float,
    iteration: int,
    radius_px: Float[Tensor, " n"],
) -> Bool[Tensor, " n"]:
    """Gaussians to prune: nearly transparent, too large (after the first reset), or not finite.

    Args:
        gaussians: The model.
        schedule: The density-control schedule.
        extent: Scene extent, world units.
        iteration: The current iteration.
        radius_px: Largest radius on screen since the last step, pixels; 0 for new Gaussians.
    """
    gone = torch.sigmoid(gaussians.opacity_logits) < schedule.prune_opacity
    size = gaussians.log_scales.amax(dim=1)
    after_reset = 0 < schedule.reset_every < iteration
    if schedule.prune_extent > 0.0 and after_reset:
        gone |= size > math.log(schedule.prune_extent * extent)
    if schedule.prune_screen_px > 0.0 and after_reset:
        gone |= radius_px > schedule.prune_screen_px
    gone |= ~torch.isfinite(gaussians.means).all(dim=1) | ~torch.isfinite(size)
    if len(gaussians) - int(gone.sum()) < MIN_AFTER_PRUNE:
        gone[torch.argmax(torch.nan_to_num(gaussians.opacity_logits, nan=-math.inf))] = False
    return gone


def reset_opacity(opacity_logits: Float[Tensor, " n"], limit: float) -> None:
    """Clamp all opacities to at most ``limit``, in place."""
    opacity_logits.clamp_(max=math.log(limit / (1.0 - limit)))
