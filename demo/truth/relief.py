"""The first surface along parallel rays: the true DSM from above, or a façade's true relief from the front."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32

from splatpipe.demo.photography.parallel_view import ParallelView
from splatpipe.demo.truth.truth import Triangles

Places = Float64[np.ndarray, "*n 3"]


@dataclass(frozen=True, eq=False)
class Relief:
    """The first hits of parallel rays through the centres of a grid's cells.

    Attributes:
        height: Height towards the viewer, metres; minus infinity where there is nothing.
        triangle: Row of the triangle hit; -1 where there is none.
        cosine: Between that triangle's normal and the rays, 0 to 1: converts a height difference to a distance normal
        to the surface; 0 where there is none.
    """

    height: Float64[np.ndarray, "h w"]
    triangle: Int32[np.ndarray, "h w"]
    cosine: Float64[np.ndarray, "h w"]


def relief(corners: Triangles, width: int, height: int, cell_m: float, highest_m: float = np.inf) -> Relief:
    """Rasterise triangles given in grid coordinates; exact at the cells' centres.

    Args:
        corners: Column, row (cells; the first cell's centre is (0.5, 0.5)) and height (metres) of their corners.
        width: Cells.
        height: Cells.
        cell_m: A cell's side.
        highest_m: The viewer's height; anything higher lies behind the viewer.
    """
    highest = np.full((height, width), -np.inf)
    hit = np.full((height, width), -1, np.int32)
    limit = np.array([width, height])
    low = np.clip(np.ceil(corners[..., :2].min(axis=1) - 0.5), 0, limit).astype(int)
    high = np.clip(np.floor(corners[..., :2].max(axis=1) + 0.5), 0, limit).astype(int)
    a, b, c = (corners[:, k, :2] for k in range(3))
    area = _cross(b - a, c - a)  # twice, signed
    x, y = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
    for k in np.flatnonzero((area != 0.0) & (high > low).all(axis=1)).tolist():
        (left, top), (right, bottom) = low[k], high[k]
        across, down = x[left:right], y[top:bottom]
        weights = []
        for start, end in ((b[k], c[k]), (c[k], a[k]), (a[k], b[k])):
            (u, v), (sx, sy) = (end - start) / area[k], start
            weights.append(u * (down - sy) - v * (across - sx))
        inside = (weights[0] >= 0.0) & (weights[1] >= 0.0) & (weights[2] >= 0.0)
        z = sum(weight * corner for weight, corner in zip(weights, corners[k, :, 2], strict=True))
        inside &= (z > highest[top:bottom, left:right]) & (z <= highest_m)
        highest[top:bottom, left:right][inside] = z[inside]
        hit[top:bottom, left:right][inside] = k
    return Relief(highest, hit, np.where(hit >= 0, _cosines(corners, cell_m)[hit], 0.0))


def _cross(a: Float64[np.ndarray, "m 2"], b: Float64[np.ndarray, "m 2"]) -> Float64[np.ndarray, " m"]:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _cosines(corners: Triangles, cell_m: float) -> Float64[np.ndarray, " m"]:
    metres = corners * [cell_m, cell_m, 1.0]
    normals = np.cross(metres[:, 1] - metres[:, 0], metres[:, 2] - metres[:, 0])
    return np.asarray(np.abs(normals[:, 2]) / np.maximum(np.linalg.norm(normals, axis=1), 1e-30))


def surface_model(
    triangles: Triangles, to_grid: Callable[[Places], Places], width: int, height: int, cell_m: float
) -> Relief:
    """The true DSM on any north-up grid, including that of a CRS.

    Args:
        triangles: East, north, up in metres.
        to_grid: Converts these to column, row (cells) and height (metres) of the grid.
        width: Cells.
        height: Cells.
        cell_m: A cell's side.
    """
    return relief(to_grid(triangles.reshape(-1, 3)).reshape(-1, 3, 3), width, height, cell_m)


def relief_in(view: ParallelView, triangles: Triangles) -> Relief:
    """The relief in an orthographic view; heights are metres towards the viewer from the plane where rays start."""
    places = view.to_grid(triangles) * [1.0, 1.0, -1.0]
    ahead = (places[..., 2] <= 0.0).any(axis=1)  # anything behind the viewer is not seen
    found = relief(places[ahead], view.width, view.height, view.pixel_m, highest_m=0.0)
    rows = np.append(np.flatnonzero(ahead), -1).astype(np.int32)
    return Relief(found.height, rows[found.triangle], found.cosine)
