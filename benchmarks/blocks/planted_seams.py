"""Plant seams, as left by bad merges, into a seamless splat, to test the seam detector."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from block_borders import PlanLine
from jaxtyping import Bool

from splatpipe.pipeline.geometry.ground_plan import GroundPlan
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import C0

STRIP = 20.0  # width of a doubled wall, pixels: the overlap of two blocks whose margins are kept


def gap(gaussians: Gaussians, plan: GroundPlan, line: PlanLine, width: float) -> Gaussians:
    """Remove the Gaussians whose centres lie near a border.

    Args:
        gaussians: The splat.
        plan: The ground plan.
        line: The border.
        width: Width of the gap, world units.
    """
    return gaussians.select(torch.from_numpy(~_near(gaussians, plan, line, width / 2.0)))


def doubled(gaussians: Gaussians, plan: GroundPlan, line: PlanLine, rise: float, strip: float) -> Gaussians:
    """Duplicate the Gaussians near a border, the copies higher.

    Args:
        gaussians: The splat.
        plan: The ground plan.
        line: The border.
        rise: Height of the second surface above the first, world units.
        strip: Width of the strip, world units.
    """
    again = gaussians.select(torch.from_numpy(_near(gaussians, plan, line, strip / 2.0)))
    up = torch.from_numpy(rise * plan.up).to(again.means)
    return Gaussians.concat([gaussians, replace(again, means=again.means + up)])


def colour_step(gaussians: Gaussians, plan: GroundPlan, line: PlanLine, step: float) -> Gaussians:
    """Brighten all Gaussians to the left of a border, along its length.

    Args:
        gaussians: The splat.
        plan: The ground plan.
        line: The border.
        step: Change of the colour, 0 to 1.
    """
    places = plan.places(gaussians.means.double().numpy())
    along = line.along(places)
    left = (line.beside(places) > 0.0) & (along >= 0.0) & (along <= line.length)
    sh = gaussians.sh.clone()
    sh[torch.from_numpy(left), 0] += step / C0
    return replace(gaussians, sh=sh)


def _near(gaussians: Gaussians, plan: GroundPlan, line: PlanLine, most: float) -> Bool[np.ndarray, " n"]:
    places = plan.places(gaussians.means.double().numpy())
    along = line.along(places)
    return np.asarray((np.abs(line.beside(places)) < most) & (along >= 0.0) & (along <= line.length))
