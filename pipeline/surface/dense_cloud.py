"""The dense cloud of a capture, tile by tile of the plan: fused, thinned to a spacing, coloured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.surface.fusion import finest_of_cubes, fused
from splatpipe.pipeline.surface.lattice import Lattice
from splatpipe.pipeline.surface.photo_set import PhotoSet
from splatpipe.pipeline.surface.point_cloud import CloudChunk
from splatpipe.pipeline.surface.point_colours import point_colours
from splatpipe.pipeline.surface.sources import Relief
from splatpipe.pipeline.surface.tiles import Tile

TILE = 256  # cells a side
MARGIN = 3  # cells around a tile from which points may move into it


def cloud_chunks(
    photos: PhotoSet, lattice: Lattice, relief: Relief, tiles: Sequence[Tile], threads: int
) -> Iterator[CloudChunk]:
    """The clouds of tiles, in their order: the same bits for any number of threads.

    Args:
        photos: With their depths.
        lattice: Its cell is the cloud's spacing: a cube of that side holds one point at most.
        relief: Between which heights points are looked for.
        tiles: Of the lattice, ``TILE`` a side.
        threads: Tiles at a time.

    Raises:
        ValueError: if depths or pixels do not fit their camera.
    """
    return ordered_map(partial(tile_cloud, photos, lattice, relief), tiles, threads)


def tile_cloud(photos: PhotoSet, lattice: Lattice, relief: Relief, tile: Tile) -> CloudChunk:
    """The cloud of one tile, by cell and height."""
    wide = tile.grown(MARGIN)
    parts = photos.parts_in(lattice, wide, relief)
    points = fused(parts, lattice, wide, relief)
    points = points.select(finest_of_cubes(points.pieces.xyz, points.footprint, lattice, tile))
    colours, _ = point_colours(photos, [part.number for part in parts], points.pieces, lattice.cell_m)
    normals = points.pieces.normal.T.astype(np.float32)
    return CloudChunk(np.ascontiguousarray(points.pieces.xyz.T), colours, np.ascontiguousarray(normals), points.confidence)
