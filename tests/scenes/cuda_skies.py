"""A render composited over the sky, by CUDA kernels or the CPU's."""

import numpy as np
import skies
import torch
from torch import Tensor
from waiting import never_waiting

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.rasterizer import Render
from splatpipe.pipeline.splat.sky.panorama import COLUMNS, ROWS
from splatpipe.pipeline.train.appearance.photo_sky import PhotoSky
from splatpipe.pipeline.train.appearance.sky import SkyModel

CPU = torch.device("cpu")

BACKGROUND, ELSEWHERE = (0.2, 0.5, 0.1), (0.9, 0.3, 0.6)


def composed(camera: Camera, mask: Tensor | None, device: torch.device = CPU) -> list[Tensor]:
    """The composite, and the gradients by the render's colour and alpha and by the cells; brought to the CPU."""
    generator = torch.Generator().manual_seed(camera.width)
    sky = SkyModel(skies.UP, np.zeros((ROWS * COLUMNS, 3), np.float32), {})
    with torch.no_grad():
        sky.panorama.colours.copy_(torch.rand(ROWS * COLUMNS, 3, generator=generator))
    sky.move_to(device)
    shape = (camera.height, camera.width)
    colour = torch.rand(*shape, 3, generator=generator).to(device).requires_grad_()
    alpha = torch.rand(shape, generator=generator).to(device).requires_grad_()
    weight = torch.rand(*shape, 3, generator=generator).to(device)
    none, mask = torch.zeros(0, device=device), None if mask is None else mask.to(device)
    with never_waiting(device):
        rendered = Render(colour, alpha, alpha, alpha, alpha, none.bool(), none)
        seen = None if mask is None else PhotoSky(mask, mask | mask.roll(1, 0))
        picture = sky.composite(rendered, camera, seen, BACKGROUND, ELSEWHERE)
        (weight * picture).sum().backward()
    cells = sky.tensors["colours"].grad
    assert colour.grad is not None and alpha.grad is not None
    found = [picture.detach(), colour.grad, alpha.grad, torch.zeros(()) if cells is None else cells]
    return [tensor.cpu() for tensor in found]
