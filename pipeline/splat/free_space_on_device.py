"""``free_space``'s look at many Gaussians where they lie on a device: few of them come to the host."""

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
    """Gaussians whose centres hang before what a photo sees.

    Attributes:
        rows: Theirs.
        depths: Of their centres, world units.
        limits: What lies nearer is before the surface, world units.
        close: Rows of those right before the camera.
    """

    rows: Int64[np.ndarray, " k"]
    depths: Float64[np.ndarray, " k"]
    limits: Float64[np.ndarray, " k"]
    close: Int64[np.ndarray, " c"]


def centres_before(
    means: Float64[Tensor, "n 3"], usable: Bool[Tensor, " n"], photo: PhotoBounds, share: float, cells_a_side: int
) -> GaussiansInFront:
    """Which centres hang before a photo's bounds, as ``free_space._judge`` asks on the CPU.

    Args:
        means: On the device.
        usable: Those that are finite.
        photo: With its bounds.
        share: Of a bound's depth that is before it for sure.
        cells_a_side: Of the photo's longer side.
    """
    camera = photo.camera
    x, y, z = (_along(means, camera.cam_from_world[axis]) for axis in range(3))
    u, v = x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy
    inside = usable & (z > 0.0) & (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)
    rows = torch.nonzero(inside).flatten()  # how many they are is asked of the device
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
    """A row of a pose times each point: by the host's numbers, one product after the other."""
    a, b, c, d = (float(value) for value in row)
    return means[:, 0] * a + means[:, 1] * b + means[:, 2] * c + d


def _on(values: np.ndarray, device: torch.device) -> Float64[Tensor, " cells"]:
    return torch.from_numpy(np.ascontiguousarray(values).ravel()).to(device)
