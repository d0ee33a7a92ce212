"""Elevations of walls: orthographic views, with the distance of each point in front of or behind the wall's plane.

A wall is a vertical plane. The surface model over it, with the surface nearest to the viewer as the topmost, gives the
depths, and the orthophoto the colours. Objects in front of the wall beyond the height range are left out, and not
projected onto it: areas that they hide are coloured from photos that see past them, or not at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.surface.depths.photo_gains import PhotoGains
from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource
from splatpipe.pipeline.surface.depths.sources import HeightRange, LruCache, PosedDepthMap
from splatpipe.pipeline.surface.facades.walls import Wall
from splatpipe.pipeline.surface.heights.height_field import HeightField
from splatpipe.pipeline.surface.heights.heights import TILE as HEIGHTS_TILE
from splatpipe.pipeline.surface.heights.heights import HeightInput, surface_heights
from splatpipe.pipeline.surface.ortho.orthophoto import TILE, OrthoInput, orthophotos
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.sheets.raster_plane import RasterPlane

BEHIND_M, BEFORE_M = 0.6, 0.6  # extent of a wall's details: reveals and doors, sills and cornices, but not balconies
MAX_CELLS = 100_000_000  # largest elevation: 300 m by 20 m at 8 mm; it takes 2 GB
STRIP = 256  # rows that are filtered at a time
CACHE_BYTES = 256 << 20  # memory for photos, and as much for depths

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Elevation:
    """A wall seen from the front; its rasters lie on the plane's lattice.

    Attributes:
        wall: The wall.
        plane: Its frame: x from the wall's left end, y up as in the local frame, z towards the viewer, metres.
        depth: Metres in front of the plane, NaN where unknown.
        sigma: Expected deviation of each depth, metres.
        colour: Red, green, blue, alpha: 0 where there is no colour.
    """

    wall: Wall
    plane: RasterPlane
    depth: Float32[np.ndarray, "h w"]
    sigma: Float32[np.ndarray, "h w"]
    colour: UInt8[np.ndarray, "h w 4"]

    def corners(self) -> Float64[np.ndarray, "4 3"]:
        """Upper left, upper right, lower right, lower left of the raster, in the plane; local metres."""
        lattice = self.plane.lattice
        left, top = lattice.east_m, lattice.north_m
        right, bottom = left + lattice.width * lattice.cell_m, top - lattice.height * lattice.cell_m
        return self.plane.local_from_plane(
            np.array([[left, top, 0], [right, top, 0], [right, bottom, 0], [left, bottom, 0]])
        )


def wall_plane(wall: Wall, cell_m: float) -> RasterPlane:
    """The plane of a wall: whole cells from end to end and from top to foot, with any excess split between both sides.

    Args:
        wall: The wall.
        cell_m: Cell size, metres.

    Raises:
        SplatpipeError: if there would be too many cells.
    """
    width = max(1, math.ceil(wall.length_m / cell_m))
    height = max(1, math.ceil((wall.high_m - wall.low_m) / cell_m))
    if width * height > MAX_CELLS:
        raise SplatpipeError(
            f"The façade {wall.name} of {width:,} × {height:,} pixels of {cell_m:g} m is too large.",
            "Choose larger pixels with --gsd.",
        )
    from_local = np.eye(4)
    from_local[:3, :3] = [[*wall.along, 0.0], [0.0, 0.0, 1.0], [*wall.facing, 0.0]]
    from_local[:3, 3] = [-wall.along @ wall.left, 0.0, -wall.facing @ wall.left]
    over = width * cell_m - wall.length_m, height * cell_m - (wall.high_m - wall.low_m)
    lattice = Lattice(-over[0] / 2.0, wall.high_m + over[1] / 2.0, cell_m, width, height)
    return RasterPlane(from_local, lattice, HeightRange(-BEHIND_M, BEFORE_M))


@dataclass(frozen=True, eq=False)
class ElevationPhotos:
    """Inputs of elevations.

    Attributes:
        sources: The photos with their depths, local metres, always in the same order.
        levels: Exposure gains of the photos.
        threads: Tiles in parallel.
    """

    sources: Sequence[PhotoSource]
    levels: PhotoGains
    threads: int


def draw_elevation(wall: Wall, cell_m: float, photos: ElevationPhotos, progress: Progress) -> Elevation:
    """Compute the elevation of a wall; bit-identical for any number of threads.

    Args:
        wall: The wall.
        cell_m: Pixel size, metres.
        photos: All photos; those behind the wall are not used.
        progress: Called with the number of finished tiles and of all tiles.

    Raises:
        SplatpipeError: as ``wall_plane``.
    """
    plane = wall_plane(wall, cell_m)
    depths_tiles, colour_tiles = (list(plane.lattice.tiles(side)) for side in (HEIGHTS_TILE, TILE))
    total = len(depths_tiles) + len(colour_tiles)
    sources, levels = _photos_in_front(plane, photos)
    shape = plane.lattice.height, plane.lattice.width
    depth, sigma = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    colour = np.zeros((*shape, 4), np.uint8)
    cache: LruCache[PosedDepthMap] = LruCache(CACHE_BYTES)
    known = [source.depths for source in sources if source.depths is not None]
    capture = HeightInput(known, plane.lattice, plane.relief, cache, upright=True)
    for done, part in enumerate(surface_heights(capture, depths_tiles, photos.threads), 1):
        cut = part.tile.slices
        depth[cut], sigma[cut] = part.height, part.sigma
        progress(done, total)
    depth = remove_specks(depth)
    surface = HeightField(plane.lattice, depth)
    album = OrthoInput(
        sources, surface, plane.lattice, plane.relief, levels, LruCache(CACHE_BYTES), LruCache(CACHE_BYTES)
    )
    for done, drawn in enumerate(orthophotos(album, colour_tiles, photos.threads), len(depths_tiles) + 1):
        cut = drawn.tile.slices
        colour[(*cut, slice(0, 3))] = drawn.colour
        colour[(*cut, 3)] = np.where(drawn.known, np.uint8(255), np.uint8(0))
        progress(done, total)
    return Elevation(wall, plane, depth, sigma, colour)


def remove_specks(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Median filter over known neighbours, which keeps edges and removes errors of single cells."""
    result = np.empty_like(depth)
    wide = np.pad(depth, 1, constant_values=np.nan)
    for top in range(0, len(depth), STRIP):
        rows = min(STRIP, len(depth) - top)
        around = np.stack([wide[top + i : top + i + rows, j : j + depth.shape[1]] for i in range(3) for j in range(3)])
        around.sort(axis=0)  # nan last
        count = np.maximum(np.isfinite(around).sum(axis=0), 1)
        low, high = (np.take_along_axis(around, at[None], 0)[0] for at in ((count - 1) // 2, count // 2))
        result[top : top + rows] = np.where(np.isfinite(depth[top : top + rows]), (low + high) / 2, np.nan)
    return result


def _photos_in_front(plane: RasterPlane, photos: ElevationPhotos) -> tuple[list[PhotoSource], PhotoGains]:
    """Photos in front of a wall, in its plane's frame, with their exposure gains."""
    rows = [
        row
        for row, source in enumerate(photos.sources)
        if plane.plane_from_local(source.camera.centre())[2] > plane.relief.high_m
    ]
    return [plane.transform_photo(photos.sources[row]) for row in rows], photos.levels.of(rows)
