"""Keep a block's Gaussians in its cell and margin, each with no more of them than its share."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.blocks.cells.partition import Partition
from splatpipe.pipeline.train.densify import DensitySchedule
from splatpipe.pipeline.train.hooks import Technique


class Fence(Technique):
    """Keeps a block's Gaussians where they belong: everything elsewhere belongs to another block or is frozen.

    Args:
        partition: The cells.
        block: The block's number.
        share: Maximum number of Gaussians in its cell; the rest of the cap goes to the margin.
        density: The density-control schedule; checks follow its interval, and continue after its end.
    """

    name = "fence"

    def __init__(self, partition: Partition, block: int, share: int, density: DensitySchedule) -> None:
        self._partition, self._block, self._share, self._density = partition, block, share, density

    def adjust_scores(
        self, score: Float[Tensor, " n"], gaussians: Gaussians, schedule: DensitySchedule
    ) -> Float[Tensor, " n"]:
        """The same score, but 0 for Gaussians for which the cell or the margin has no room."""
        score = score.clone()
        for inside, most in self._shares(gaussians):
            room = max(0, most - int(inside.sum()))
            wanted = torch.nonzero(inside & (score > schedule.gradient)).flatten()
            best = torch.argsort(score[wanted], descending=True, stable=True)
            score[wanted[best[room:]]] = 0.0
        return score

    def prune_mask(self, gaussians: Gaussians, iteration: int) -> Bool[Tensor, " n"] | None:
        """Gaussians outside cell and margin, and the least opaque in excess of the shares; None between checks."""
        due = iteration >= self._density.first and iteration % self._density.every == 0
        return ~self.kept(gaussians) if due and self._density.on else None

    def kept(self, gaussians: Gaussians) -> Bool[Tensor, " n"]:
        """Which Gaussians of a model lie within the block's shares."""
        kept = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
        for inside, most in self._shares(gaussians):
            rows = torch.nonzero(inside).flatten()
            order = torch.argsort(gaussians.opacity_logits.detach()[rows], descending=True, stable=True)
            kept[rows[order[:most]]] = True
        return kept

    def _shares(self, gaussians: Gaussians) -> list[tuple[Bool[Tensor, " n"], int]]:
        """The Gaussians in the cell and in the margin, with the maximum number of each."""
        means = gaussians.means.detach()
        points = means.double().cpu().numpy()
        cell = self._partition.owners(points) == self._block
        margin = self._partition.trained_by(self._block, points) & ~cell
        masks = (torch.from_numpy(np.ascontiguousarray(mask)).to(means.device) for mask in (cell, margin))
        return list(zip(masks, (self._share, max(0, self._density.cap - self._share)), strict=True))
