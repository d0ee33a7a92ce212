"""Splats without a scene: any Gaussians, for files and edits."""

import torch

from splatpipe.pipeline.splat.model.gaussians import Gaussians


def some_gaussians(count: int = 50, degree: int = 3, seed: int = 1, spread: float = 20.0) -> Gaussians:
    """Return Gaussians around the origin, with sizes, opacities and colours that files must be able to store."""
    generator = torch.Generator().manual_seed(seed)
    made = Gaussians.empty(count, degree)
    made.means = spread * torch.randn(count, 3, generator=generator)
    made.log_scales = -3.0 + torch.randn(count, 3, generator=generator)
    made.quats = torch.randn(count, 4, generator=generator)
    made.opacity_logits = 2.0 * torch.randn(count, generator=generator)
    made.sh = 0.3 * torch.randn(made.sh.shape, generator=generator)
    return made
