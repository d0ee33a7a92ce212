"""The device part of ``free_space``: tests Gaussians where they are stored and copies only a few to the host."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

if TYPE_CHECKING:
    from splatpipe.pipeline.splat.free_space import PhotoBounds


@dataclass(frozen=True, eq=False)
class GaussiansInFront:
    """Gaussians whose centres lie in front of a photo's bounds.

    Attributes:
        rows: Their rows.
        depths: Depths of their centres, world units.
        limits: Depths nearer than which they are in front of the surface, world units.
        close: Rows of the Gaussians right in front of the camera.
    """

    rows: Int64[np.ndarray, " k"]
    depths: Float64[np.ndarray, " k"]
    limits: Float64[np.ndarray, " k"]
    close: Int64[np.ndarray, " c"]


def centres_before(
    means: Float64[Tensor, "n 3"], usable: Bool[Tensor, " n"], photo: PhotoBounds, share: float, cells_a_side: int
) -> GaussiansInFront:
    """Find centres in front of a photo's bounds, as ``free_space._judge`` does on the CPU.

    Args:
        means: Centres on the device.
        usable: Mask of the finite Gaussians.
        photo: The photo's bounds.
        share: Share of a bound's depth up to which a point is certainly in front.
        cells_a_side: Number of cells along the photo's longer side.
    """
    camera = photo.camera
    x, y, z = (_along(means, camera.cam_from_world[axis]) for axis in range(3))
    u, v = x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy
    inside = usable & (z > 0.0) & (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)
    rows = torch.nonzero(inside).flatten()  # synchronizes: the count comes from the device
    u, v, z = u[rows], v[rows], z[rows]
    side = cells_a_side / max(camera.width, camera.height)
    grid_rows, grid_columns = photo.depth.shape
    cell = (v * side).long().clamp(max=grid_rows - 1) * grid_columns + (u * side).long().clamp(max=grid_columns - 1)
    limits = share * _on(photo.depth, means.device)[cell]
    left, top, right, bottom = (_on(edge, means.device)[cell] for edge in photo.box)
    front = (z < limits) & (u >= left) & (u <= right) & (v >= top) & (v <= bottom)
    away = (means[rows] - torch.from_numpy(camera.centre()).to(means.device)).square().sum(dim=1).sqrt()
    close = (z < photo.near) & (away < photo.near)
    found = (rows[front], z[front], limits[front], rows[close])
    return GaussiansInFront(*(part.cpu().numpy() for part in found))


def _along(means: Float64[Tensor, "n 3"], row: Float64[np.ndarray, " 4"]) -> Float64[Tensor, " n"]:
    """A row of a pose times each point, one product after another, with scalars from the host."""
    a, b, c, d = (float(value) for value in row)
    return means[:, 0] * a + means[:, 1] * b + means[:, 2] * c + d


def _on(values: np.ndarray, device: torch.device) -> Float64[Tensor, " cells"]:
    return torch.from_numpy(np.ascontiguousarray(values).ravel()).to(device)
