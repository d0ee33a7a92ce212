"""Depths as surface pieces: positions, normals and pixel footprints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.surface.depths.photo_set import (
    DepthPart,
    SurfacePieces,
    dot,
    rotate,
    unproject_pixels,
    view_pieces,
)
from splatpipe.pipeline.surface.depths.sources import HeightRange
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile

MAX_BEND_PX = 10.0  # depths that bend by more than this many pixel widths are not one surface
REACHES = (3, 1)  # distances in pixels at which the slope for a normal is measured: at the shorter one, noise dominates


@dataclass(frozen=True, eq=False)
class DepthPoints:
    """Surface pieces from one photo.

    Attributes:
        number: Index of the photo.
        pieces: Positions, and normals that face the photo.
        footprint: Size of a pixel on each, metres.
    """

    number: int
    pieces: SurfacePieces
    footprint: Float64[np.ndarray, " n"]

    def select(self, rows: np.ndarray | slice) -> DepthPoints:
        """The points of these rows."""
        return DepthPoints(self.number, self.pieces.select(rows), self.footprint[rows])


def depth_points(part: DepthPart, lattice: Lattice, tile: Tile, relief: HeightRange) -> DepthPoints:
    """Points of a photo's depths in a tile, one per pixel, including walls; without isolated pixels.

    Args:
        part: Part of the photo's depths that shows the tile.
        lattice: The lattice of the tile.
        tile: The tile.
        relief: Height range; points outside of it are dropped.
    """
    row, column = np.nonzero(part.depth > 0.0)
    xyz = unproject_pixels(part.camera, row, column, 1.0 / part.depth[row, column].astype(np.float64))
    inside = (lattice.cells(tile, xyz[0], xyz[1]) >= 0) & (xyz[2] >= relief.low_m) & (xyz[2] < relief.high_m)
    row, column, xyz = row[inside], column[inside], xyz[:, inside]
    normal, known = pixel_normals(part, row, column, REACHES[0])
    for reach in REACHES[1:]:
        rest = np.flatnonzero(~known)
        normal[:, rest], known[rest] = pixel_normals(part, row[rest], column[rest], reach)
    pieces = SurfacePieces(xyz, normal)
    footprint = view_pieces(part.camera, pieces).footprint
    seen = np.flatnonzero(known & np.isfinite(footprint))
    return DepthPoints(part.number, pieces.select(seen), footprint[seen])


def pixel_normals(
    part: DepthPart, row: Int64[np.ndarray, " n"], column: Int64[np.ndarray, " n"], reach: int
) -> tuple[Float64[np.ndarray, "3 n"], Bool[np.ndarray, " n"]]:
    """Normals of pixels from the depths on all four sides, and whether these lie on one surface.

    Inverse depth is linear in a plane's pixels, w = n · (x, y, 1) for the plane n · X = 1, so its gradient in the image
    gives the plane's normal in the camera frame.

    Args:
        part: Part of a photo's depths.
        row: Rows of the pixels.
        column: Columns of the pixels.
        reach: Distance to the pixels used on either side.
    """
    height, width = part.depth.shape
    here = part.depth[row, column].astype(np.float64)
    w = 1.0 / np.where(here > 0.0, here, np.inf)
    near = w * (MAX_BEND_PX / max(part.camera.fx, part.camera.fy))
    flat, slopes = here > 0.0, []
    for down, right in ((0, reach), (reach, 0)):
        inside = (row >= down) & (row + down < height) & (column >= right) & (column + right < width)
        behind, ahead = (
            part.depth[np.where(inside, row + s * down, 0), np.where(inside, column + s * right, 0)].astype(np.float64)
            for s in (-1, 1)
        )
        there = inside & (behind > 0.0) & (ahead > 0.0)
        behind, ahead = (1.0 / np.where(there, side, 1.0) for side in (behind, ahead))
        flat &= there & (np.abs(ahead + behind - 2.0 * w) < near)
        slopes.append((ahead - behind) / (2.0 * reach))
    return _normal(part, row, column, w, np.stack(slopes)), flat


def _normal(
    part: DepthPart,
    row: Int64[np.ndarray, " n"],
    column: Int64[np.ndarray, " n"],
    inverse: Float64[np.ndarray, " n"],
    slopes: Float64[np.ndarray, "2 n"],
) -> Float64[np.ndarray, "3 n"]:
    """Unit normals towards the camera, from inverse depths and their increase per pixel right and down."""
    camera = part.camera
    x, y = (column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy
    across, down = slopes[0] * camera.fx, slopes[1] * camera.fy
    away = np.stack(rotate(camera.cam_from_world[:3, :3].T, across, down, inverse - across * x - down * y))
    return np.asarray(-away / np.maximum(np.sqrt(dot(away, away)), 1e-30))
