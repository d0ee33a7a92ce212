"""Backdrop: outside a boundary the splat stays coarse, because density control limits Gaussians there to a share.

Within that share they are ranked by the same score as elsewhere. Gaussians that move out of the area count as outside.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.sky.backdrop import backdrop_limit
from splatpipe.pipeline.train.densify import DensitySchedule
from splatpipe.pipeline.train.hooks import Technique


class Backdrop(Technique):
    """Keeps the model coarse outside an area.

    Args:
        area: The area of interest, in the model's frame.
        density: The training's density-control schedule.
    """

    name = "backdrop"

    def __init__(self, area: PlanArea, density: DensitySchedule) -> None:
        self._area, self._density = area, density

    def adjust_scores(
        self, score: Float[Tensor, " n"], gaussians: Gaussians, schedule: DensitySchedule
    ) -> Float[Tensor, " n"]:
        """The same score, but 0 for Gaussians outside for which the backdrop has no room."""
        outside = self._outside_of(gaussians)
        room = max(0, self._limit(outside) - int(outside.sum()))
        wanted = torch.nonzero(outside & (score > schedule.gradient)).flatten()
        best = torch.argsort(score[wanted], descending=True, stable=True)
        score = score.clone()
        score[wanted[best[room:]]] = 0.0
        return score

    def prune_mask(self, gaussians: Gaussians, iteration: int) -> Bool[Tensor, " n"] | None:
        """The least opaque Gaussians outside in excess of the backdrop's share; None between density-control steps."""
        if not self._density.is_step(iteration):
            return None
        outside = self._outside_of(gaussians)
        surplus = int(outside.sum()) - self._limit(outside)
        gone = torch.zeros_like(outside)
        if surplus > 0:
            rows = torch.nonzero(outside).flatten()
            order = torch.argsort(gaussians.opacity_logits[rows], stable=True)
            gone[rows[order[:surplus]]] = True
        return gone

    def _outside_of(self, gaussians: Gaussians) -> Bool[Tensor, " n"]:
        means = gaussians.means.detach()
        inside = self._area.contains(means.double().cpu().numpy())
        return torch.from_numpy(~inside).to(means.device)

    def _limit(self, outside: Bool[Tensor, " n"]) -> int:
        return backdrop_limit(len(outside) - int(outside.sum()), self._density.cap)
