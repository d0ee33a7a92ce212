"""Adaptive density control: how Gaussians are cloned, split, pruned and their opacity reset, and how many there may be.

Kerbl, Kopanas, Leimkühler, Drettakis: "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023,
section 5 and its published settings, changed in two ways whatever the score (see `density.py`).
The number of Gaussians rises to a hard cap by a schedule, those of the largest score first (the idea of Mallick et al.,
"Taming 3DGS", SIGGRAPH Asia 2024). And two that take the place of one have the opacity that lets as much light through
as the one did (Rota Bulò et al., "Revising Densification in Gaussian Splatting", ECCV 2024).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatpipe.pipeline.raster.cuda import kernels_of
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.morton import morton_keys
from splatpipe.pipeline.train.draws import SPLIT_POSITION, normal

MIN_AFTER_PRUNE = 1  # a model is never emptied: there would be nothing left to learn from

# All published.
SPLIT_EXTENT = 0.01  # share of the scene's extent: larger Gaussians are split, smaller ones cloned
SPLIT_SHRINK = 1.6  # the two halves of a split are so many times smaller
PRUNE_OPACITY = 0.005  # Gaussians below it are removed: no pixel shows them
PRUNE_EXTENT = 0.1  # share of the extent: larger ones are removed after the first opacity reset
PRUNE_SCREEN_PX = 20.0  # larger ones on screen, too; of the published method alone, for it eats aerial ground
RESET_OPACITY = 0.01  # an opacity reset leaves no Gaussian above it


@dataclass(frozen=True)
class DensitySchedule:
    """When and how density control acts.

    Attributes:
        on: Whether it does.
        seed: Names the random numbers.
        cap: The most Gaussians.
        first: First iteration that it may act after.
        last: Last one.
        every: Iterations between its steps.
        gradient: Score above which Gaussians are densified.
        reset_every: Iterations between opacity resets; 0 for none.
        reset_until: None after this iteration: windows of finer sizes come back too seldom; 0 for no such limit.
        prune_screen_px: Radius on screen above which Gaussians are removed; 0 for never.
        prune_free_space: Gaussians before the surface for so many photos are removed; 0 for never.
        prune_opacity: Opacity below which Gaussians are removed.
        prune_extent: Share of the scene's extent above which they are; 0 for never.
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
    """New rows for the model: which old Gaussian each is made from, and what differs.

    Attributes:
        source: (m,) old row of each new Gaussian.
        fresh: (m,) True where it is new, so that its optimiser state starts at zero.
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
        """The rows of a mask or an index."""
        return DensifiedGaussians(*(getattr(self, field.name)[rows] for field in fields(self)))


def unchanged(gaussians: Gaussians, rows: Bool[Tensor, " n"]) -> DensifiedGaussians:
    """The Gaussians of a mask, as they are."""
    source = torch.nonzero(rows).flatten()
    fresh = torch.zeros(len(source), dtype=torch.bool, device=source.device)
    kept = (gaussians.means, gaussians.log_scales, gaussians.opacity_logits)  # not the harmonics, most of the memory
    return DensifiedGaussians(source, fresh, *(tensor[source] for tensor in kept))


def along_curve(growth: DensifiedGaussians) -> DensifiedGaussians:
    """The same rows in the order of their places on a Morton curve: what is near in space is near in memory.

    Threads of a CUDA device then read neighbouring memory, and a CPU what a window shows, row after row.
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
    """What a step of density control did.

    Attributes:
        iteration: When.
        cloned: Gaussians copied.
        split: Gaussians replaced by two.
        pruned: Gaussians removed.
        held_back: Gaussians that the schedule kept from being densified.
        gaussians: How many there are now.
    """

    iteration: int
    cloned: int
    split: int
    pruned: int
    held_back: int
    gaussians: int

    def to_json(self) -> dict[str, int]:
        """For `history.json`."""
        return asdict(self)


class DensityStatistics:
    """Running sums over the photos since the last step.

    Attributes:
        score_sum: (n,) sum of the photos' scores.
        seen: (n,) photos that saw the Gaussian.
        max_radius_px: (n,) largest radius on screen.
    """

    def __init__(self, count: int, device: torch.device | None = None) -> None:
        self.score_sum = torch.zeros(count, device=device)
        self.seen = torch.zeros(count, device=device)
        self.max_radius_px = torch.zeros(count, device=device)

    def observe(
        self, gradient_px: Float[Tensor, "n 2"], visible: Bool[Tensor, " n"], width: float, height: float
    ) -> None:
        """Add an iteration's image-plane gradients, by their norm in NDC.

        Args:
            gradient_px: dL/d(mean2D) summed over the pixels, or its magnitudes, x and y apart.
            visible: Which Gaussians the photo saw.
            width: Of the whole picture, pixels, times the part in its loss that the render has.
            height: The same.
        """
        self.add(_in_ndc(gradient_px, width, height), visible)

    def observe_rows(
        self, rows: Int64[Tensor, " k"], gradient_px: Float[Tensor, "k 2"], width: float, height: float
    ) -> None:
        """The same of the Gaussians that the photo saw alone.

        Args:
            rows: Which these are, each once.
            gradient_px: As of ``observe``, theirs.
            width: As of ``observe``.
            height: The same.
        """
        score = _in_ndc(gradient_px, width, height).nan_to_num_(0.0, 0.0, 0.0)
        self.score_sum.index_add_(0, rows, score)
        self.seen.index_add_(0, rows, torch.ones_like(score))

    def add(self, score: Float[Tensor, " n"], visible: Bool[Tensor, " n"]) -> None:
        """Add an iteration's scores, which are overwritten; those that are not finite count as 0."""
        self.score_sum += score.nan_to_num_(0.0, 0.0, 0.0).mul_(visible)
        self.seen += visible

    def observe_radii(self, radii_px: Float[Tensor, " n"]) -> None:
        """Add an iteration's sizes on screen, pixels (0 where unseen)."""
        torch.maximum(self.max_radius_px, radii_px, out=self.max_radius_px)

    def score(self) -> Float[Tensor, " n"]:
        """The statistic: averaged over the photos that saw the Gaussian."""
        return self.score_sum / self.seen.clamp(min=1.0)

    def to_arrays(self) -> dict[str, Tensor]:
        """Its tensors by name, for a checkpoint."""
        return {"score_sum": self.score_sum, "seen": self.seen, "max_radius_px": self.max_radius_px}


def _in_ndc(gradient_px: Float[Tensor, "k 2"], width: float, height: float) -> Float[Tensor, " k"]:
    return torch.hypot(gradient_px[:, 0] * (0.5 * width), gradient_px[:, 1] * (0.5 * height))


def room_at(schedule: DensitySchedule, initial: int, iteration: int) -> int:
    """The most Gaussians that density control leaves: up to the cap, fast at first and slower towards its last step.

    What comes early has time to be trained; what comes late has the better score. With x the share of the steps done,
    the share of the growth is x (2 - x).

    Args:
        schedule: Of density control.
        initial: Gaussians at the start.
        iteration: Now.
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
    """Clone the small and split the large Gaussians whose score asks for it.

    Those whose halved opacity would be under the pruning limit are left: both halves would go in the next step.

    Args:
        gaussians: The model.
        score: ``DensityStatistics.score`` of each.
        room: How many Gaussians may be added.
        schedule: Of density control.
        extent: Of the scene, world units.
        iteration: Names the random numbers.

    Returns:
        The new rows (kept ones in their order, then clones, then two children for each split), and the counts
        ``cloned``, ``split`` and ``held_back``.
    """
    lasting = gaussians.opacity_logits >= lowest_logit_to_halve(schedule.prune_opacity)
    wanted = torch.nonzero((score > schedule.gradient) & lasting).flatten()
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
    """The logit of the opacity of which two let as much light through as one of the given: 1 - √(1 - α).

    Rota Bulò et al., "Revising Densification in Gaussian Splatting", ECCV 2024.
    """
    log_through = 0.5 * torch.nn.functional.logsigmoid(-logits)  # ln √(1 - α), finite for any logit
    # 1 - √(1 - α) = α / (1 + √(1 - α)), which does not cancel for small α.
    return torch.nn.functional.logsigmoid(logits) - torch.log1p(torch.exp(log_through)) - log_through


def lowest_logit_to_halve(limit: float) -> float:
    """The logit of the opacity whose half, by ``half_opacity``, is the limit: 1 - (1 - α)²."""
    opacity = limit * (2.0 - limit)
    return math.log(opacity / (1.0 - opacity)) if opacity > 0.0 else -math.inf


def _largest(candidates: Int64[Tensor, " c"], value: Float[Tensor, " n"], limit: int) -> Int64[Tensor, " k"]:
    """Up to ``limit`` candidates of the largest value (ties: the first row), in row order."""
    if len(candidates) <= limit:
        return candidates
    ranked = torch.argsort(value[candidates], descending=True, stable=True)
    return candidates[ranked[:limit]].sort().values


def _split_offsets(gaussians: Gaussians, rows: Int64[Tensor, " s"], seed: int, iteration: int) -> Float[Tensor, "t 3"]:
    """Draw two positions within each parent, relative to its mean: the first of all, then the second of all."""
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
    """Turn each vector by its quaternion, which need not be a unit one."""
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
    """Which Gaussians go: nearly transparent, too large in the world (after the first reset), or broken.

    Args:
        gaussians: The model.
        schedule: Of density control.
        extent: Of the scene, world units.
        iteration: Now.
        radius_px: Largest radius on screen since the last step, pixels; 0 for new ones.
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
    """Leave no opacity above ``limit``, in place."""
    opacity_logits.clamp_(max=math.log(limit / (1.0 - limit)))
