"""Density control by the error of the photos that a Gaussian answers for.

The idea of Rota Bulò, Porzi, Kontschieder: "Revising Densification in Gaussian Splatting", ECCV 2024: a Gaussian's
share of a photo's error is the sum over the pixels of its blending weight times the pixel's error. Here the error is
|render - photo|, averaged over the channels, and the share is averaged over the photos that saw the Gaussian.

The weights are never written down: a colour's gradient is the sum of weight times the picture's gradient, so one more
backward pass with the error for a gradient gives the sums. It runs in the last iterations before a step of density
control: once a photo, in at most a quarter of them.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.raster import Render
from splatpipe.pipeline.scene.gaussians import Gaussians
from splatpipe.pipeline.scene.sh import C0
from splatpipe.stages.options import TrainConfig
from splatpipe.stages.train.density.strategy import BLIND, Look, ScoredDensity, Seen
from splatpipe.stages.train.stream import TrainingPhoto

LOOKS_A_STEP = 4  # one of so many iterations at most has the second backward pass, which takes about half of its time


class ErrorDensity(ScoredDensity):
    """Ranks by the error that a Gaussian answers for, pixels of error 1 a photo."""

    def look(self, options: TrainConfig, iteration: int, photos: int, /) -> Look:
        """A second backward pass in the last iterations before a step."""
        every = int(options.densify_every)
        until_step = -iteration % every
        return Look(again=True) if until_step < min(photos, max(1, every // LOOKS_A_STEP)) else BLIND

    def observe(self, seen: Seen, options: TrainConfig) -> None:
        """Add the shares where the graph was kept for them."""
        self.observe_radii(seen, options)
        if seen.look.again:
            error = photo_error(seen.shown.detach(), seen.photo)
            self.statistics.add(error_share(seen.gaussians, seen.rendered, error), seen.rendered.visible)


def photo_error(colour: Float[Tensor, "h w 3"], photo: TrainingPhoto) -> Float[Tensor, "h w"]:
    """|render - photo|, averaged over the channels; 0 where the photo is masked."""
    apart = (colour - photo.colour).abs_()
    error = (apart[..., 0] + apart[..., 1] + apart[..., 2]) / 3.0
    return error if photo.mask is None else torch.where(photo.mask, error, 0.0)


def error_share(gaussians: Gaussians, rendered: Render, error: Float[Tensor, "h w"]) -> Float[Tensor, " n"]:
    """Sum over the pixels of blending weight times error; the render's graph is used up.

    A channel whose colour is clamped at 0 has no gradient, so the largest of the three counts. A Gaussian that is
    black in all of them has a share of 0: it can be moved, not seen.

    Args:
        gaussians: That were rendered, leaves of autograd.
        rendered: With its graph.
        error: At least 0.
    """
    picture = error[..., None].expand(-1, -1, 3)
    (gradient,) = torch.autograd.grad(rendered.colour, gaussians.sh, picture)
    return gradient[:, 0].amax(dim=1) / C0
