"""Depths as small planes in the world: where they are, how they slope, which cells they cover."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatpipe.pipeline.surface.lattice import Lattice
from splatpipe.pipeline.surface.sources import DepthMap, PhotoWindow, Relief
from splatpipe.pipeline.surface.tiles import Tile

SAME_PX = 10.0  # depths that differ by more than so many pixels' widths are not one surface
STEEPEST = 3.0  # rise over run; steeper is a façade, whose height at a place says nothing
COVERED = 0.75  # of a cell: pixels further apart than that are divided
REACH = 2  # pixels around one that its slope is taken from
WIDEST = 4  # cells from a pixel's centre to its edge; a larger one says too little
MOST_PARTS = 4  # of a pixel a side; larger ones leave gaps, which other photos fill


@dataclass(frozen=True)
class Surfels:
    """Small planes, one a depth.

    Attributes:
        xyz: Where their pixels' centres lie, local metres.
        slope: Rise of the plane towards east and north, metres a metre.
        across: East and north that a pixel to the right is further.
        down: Likewise of the pixel below.
        confidence: How many other photos confirm each.
    """

    xyz: Float64[np.ndarray, "n 3"]
    slope: Float64[np.ndarray, "n 2"]
    across: Float64[np.ndarray, "n 2"]
    down: Float64[np.ndarray, "n 2"]
    confidence: UInt8[np.ndarray, " n"]

    def select(self, rows: Bool[np.ndarray, " n"] | Int64[np.ndarray, " k"]) -> Surfels:
        """Those of it."""
        return Surfels(self.xyz[rows], self.slope[rows], self.across[rows], self.down[rows], self.confidence[rows])


def surfels(found: DepthMap, window: PhotoWindow, lattice: Lattice, tile: Tile, relief: Relief) -> Surfels:
    """Planes of a photo's depths that may cover a tile, without façades and lone pixels: the same bits in any window.

    Inverse depth is linear in a plane's pixels, w = n · (x, y, 1) for the plane n · X = 1; so its gradient in the
    picture is the plane's normal in the camera.

    Args:
        found: The photo's depths.
        window: Where the tile may lie in the photo.
        lattice: Whose cells are covered.
        tile: Which of them.
        relief: Outside of these heights nothing is returned.
    """
    camera = found.camera
    columns, rows = np.arange(window.left, window.right), np.arange(window.top, window.bottom)
    inverse, gradient = inverse_and_gradient(found.depth, window, SAME_PX / max(camera.fx, camera.fy))
    known = np.flatnonzero(np.isfinite(gradient).all(axis=0).ravel() & (inverse.ravel() > 0.0))
    row, column = np.divmod(known, len(columns))
    turn, centre = camera.cam_from_world[:3, :3].T, camera.centre()
    w = inverse.ravel()[known].astype(np.float64)
    x = ((columns + 0.5 - camera.cx) / camera.fx)[column]
    y = ((rows + 0.5 - camera.cy) / camera.fy)[row]
    ray = turned(turn, x, y)
    place = [centre[axis] + ray[axis] / w for axis in range(3)]
    there = (place[2] >= relief.low_m) & (place[2] < relief.high_m) & _near(lattice, tile, place[0], place[1])
    some = np.flatnonzero(there)
    known, row, column = known[some], row[some], column[some]
    w, x, y = w[some], x[some], y[some]
    ray, place = [part[some] for part in ray], [part[some] for part in place]
    per_x, per_y = (g.ravel()[known].astype(np.float64) for g in gradient)
    across, down = per_x * camera.fx, per_y * camera.fy
    normal = turned(turn, across, down, w - across * x - down * y)
    step = [
        np.stack([(turn[axis, side] / f - ray[axis] * g / w) / w for axis in (0, 1)], axis=1)
        for side, f, g in ((0, camera.fx, per_x), (1, camera.fy, per_y))
    ]
    # n · X = 1 looks away from the camera: down, where it is seen from above.
    usable = (normal[2] < 0.0) & (normal[0] ** 2 + normal[1] ** 2 <= (STEEPEST * normal[2]) ** 2)
    for part in step:
        usable &= np.abs(part).max(axis=1) <= 2 * WIDEST * lattice.cell_m
    kept = np.flatnonzero(usable)
    slope = np.stack([-normal[axis][kept] / normal[2][kept] for axis in (0, 1)], axis=1)
    confidence = found.confidence[rows[row[kept]], columns[column[kept]]]
    return Surfels(np.stack([part[kept] for part in place], axis=1), slope, step[0][kept], step[1][kept], confidence)


def _near(
    lattice: Lattice, tile: Tile, east: Float64[np.ndarray, " n"], north: Float64[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Whether points lie in a tile, or so near that a part of their pixels may."""
    across, down = lattice.places(east, north)
    inside = (across >= tile.column - 2 * WIDEST) & (across < tile.column + tile.width + 2 * WIDEST)
    return inside & (down >= tile.row - 2 * WIDEST) & (down < tile.row + tile.height + 2 * WIDEST)


def turned(
    turn: Float64[np.ndarray, "3 3"],
    x: Float64[np.ndarray, " n"],
    y: Float64[np.ndarray, " n"],
    z: Float64[np.ndarray, " n"] | float = 1.0,
) -> list[Float64[np.ndarray, " n"]]:
    """A matrix times vectors, each by itself: a library's product would depend on how many there are."""
    return [turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z for i in range(3)]


def inverse_and_gradient(
    depth: Float32[np.ndarray, "h w"], window: PhotoWindow, same: float
) -> tuple[Float32[np.ndarray, "wh ww"], Float32[np.ndarray, "2 wh ww"]]:
    """Inverse depths of a window, 0 where there are none, and how they grow a pixel to the right and down.

    From pairs of pixels on both sides, up to two away, that lie in one plane with the pixel; from one side alone at a
    surface's rim; nan for a pixel without neighbours.
    """
    wide = _cut(depth, window, REACH)
    inverse = np.divide(np.float32(1.0), wide, out=np.full_like(wide, np.nan), where=wide > 0.0)  # nan is near nothing
    height, width = window.bottom - window.top, window.right - window.left
    centre = inverse[REACH:-REACH, REACH:-REACH]
    near = centre * np.float32(same)
    gradients = []
    for axis in (0, 1):

        def beside(along: int, aside: int, axis: int = axis) -> Float32[np.ndarray, "wh ww"]:
            down, right = (aside, along) if axis == 0 else (along, aside)
            rows, columns = (slice(REACH + by, REACH + by + size) for by, size in ((down, height), (right, width)))
            return np.asarray(inverse[rows, columns])

        gradients.append(_gradient(centre, near, beside))
    return np.nan_to_num(centre, nan=0.0), np.stack(gradients)


def _gradient(
    centre: Float32[np.ndarray, "h w"],
    near: Float32[np.ndarray, "h w"],
    beside: Callable[[int, int], Float32[np.ndarray, "h w"]],
) -> Float32[np.ndarray, "h w"]:
    """How inverse depths grow from a pixel to the next one in a direction, by least squares over pairs of pixels."""
    total, weight = np.zeros_like(centre), np.zeros_like(centre)
    twice = centre + centre
    for along in (1, 2):
        for aside in (-1, 0, 1):
            ahead, behind = beside(along, aside), beside(-along, aside)
            difference, bend = ahead - behind, ahead + behind
            bend -= twice
            flat = np.abs(bend, out=bend) < near
            flat &= np.abs(difference) < near * np.float32(2 * along)
            np.add(total, np.float32(along) * difference, out=total, where=flat)
            weight += flat * np.float32(2 * along * along)
    lone = np.flatnonzero(weight == 0.0)
    here = centre.ravel()[lone]
    result = np.divide(total, weight, out=total, where=weight > 0.0)
    ahead, behind = (beside(along, 0).ravel()[lone] - here for along in (1, -1))
    limit = near.ravel()[lone]
    single = np.where(np.abs(ahead) < limit, ahead, np.where(np.abs(behind) < limit, -behind, np.float32(np.nan)))
    result.ravel()[lone] = single
    return np.asarray(result)


def _cut(depth: Float32[np.ndarray, "h w"], window: PhotoWindow, reach: int) -> Float32[np.ndarray, "a b"]:
    """A window and some pixels around it; 0 outside of the picture."""
    height, width = depth.shape
    top, bottom = max(0, window.top - reach), min(height, window.bottom + reach)
    left, right = max(0, window.left - reach), min(width, window.right + reach)
    edges = (
        (top - window.top + reach, window.bottom + reach - bottom),
        (left - window.left + reach, window.right + reach - right),
    )
    return np.pad(depth[top:bottom, left:right], edges)


@dataclass(frozen=True)
class Splats:
    """Parts of planes by the cells that they lie in.

    Attributes:
        cell: Number of the tile's cell.
        height: Of the plane at the cell's centre, local metres.
        cover: What share of a cell the part covers, seen from above.
        confidence: The plane's.
    """

    cell: Int64[np.ndarray, " k"]
    height: Float64[np.ndarray, " k"]
    cover: Float64[np.ndarray, " k"]
    confidence: UInt8[np.ndarray, " k"]


def splats(planes: Surfels, lattice: Lattice, tile: Tile) -> Iterator[Splats]:
    """Where planes cover cells, and at which heights.

    A pixel that is larger than a cell is divided, so that it covers all its cells; heights are the plane's at a cell's
    centre, so that slopes have no steps.
    """
    parts = [
        np.clip(np.ceil(np.hypot(step[:, 0], step[:, 1]) / (COVERED * lattice.cell_m)), 1, MOST_PARTS).astype(np.int64)
        for step in (planes.across, planes.down)
    ]
    centres = lattice.centres(tile).reshape(-1, 2)
    kinds = parts[0] * (MOST_PARTS + 1) + parts[1]
    for kind in np.unique(kinds):
        some = planes.select(kinds == kind)
        wide, high = divmod(int(kind), MOST_PARTS + 1)
        for i in range(wide):
            for j in range(high):
                off = some.across * ((i + 0.5) / wide - 0.5) + some.down * ((j + 0.5) / high - 0.5)
                cell = lattice.cells(tile, some.xyz[:, 0] + off[:, 0], some.xyz[:, 1] + off[:, 1])
                yield _in_cells(some, cell, centres, wide * high * lattice.cell_m**2)


def _in_cells(
    planes: Surfels, cell: Int64[np.ndarray, " n"], centres: Float64[np.ndarray, "c 2"], whole_m2: float
) -> Splats:
    kept = np.flatnonzero(cell >= 0)
    cell, some = cell[kept], planes.select(kept)
    east, north = centres[cell, 0] - some.xyz[:, 0], centres[cell, 1] - some.xyz[:, 1]
    height = some.xyz[:, 2] + some.slope[:, 0] * east + some.slope[:, 1] * north
    area = np.abs(some.across[:, 0] * some.down[:, 1] - some.across[:, 1] * some.down[:, 0])
    return Splats(cell, height, area / whole_m2, some.confidence)
