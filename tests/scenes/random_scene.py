"""Random Gaussians and a camera that sees most of them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.splat.model.gaussians import Gaussians


def random_scene(seed: int, n: int = 60, sh_degree: int = 3, size: float = -1.5) -> Gaussians:
    """Return overlapping Gaussians in front of a camera at the origin, some outside its view, some behind it."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    means = normal(n, 3) * torch.tensor([1.5, 1.2, 1.5]) + torch.tensor([0, 0, 4.0])
    sh = normal(n, (sh_degree + 1) ** 2, 3) * 0.3
    return Gaussians(means, normal(n, 3) * 0.6 + size, normal(n, 4), normal(n) * 2.0, sh)


def random_camera(seed: int, width: int = 70, height: int = 53) -> Camera:
    """Return a slightly turned and shifted camera, with different focal lengths and an off-centre principal point."""
    generator = torch.Generator().manual_seed(seed)
    a, b, c = (0.1 * torch.randn(3, generator=generator, dtype=torch.float64)).tolist()
    pose = np.eye(4)
    pose[:3, :3] = torch.matrix_exp(torch.tensor([[0, -c, b], [c, 0, -a], [-b, a, 0]], dtype=torch.float64)).numpy()
    pose[:3, 3] = 0.1 * torch.randn(3, generator=generator, dtype=torch.float64).numpy()
    cx, cy = (torch.rand(2, generator=generator, dtype=torch.float64) * 0.4 + 0.3).tolist()
    return Camera("view", width, height, 60.0, 64.0, width * cx, height * cy, pose)
