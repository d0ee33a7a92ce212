"""Sparse voxel blocks: only those near the surface are allocated, with voxels large enough to fit into memory."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from jaxtyping import Float32, Float64, Int64

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.surface.depths.photo_set import PhotoSet, unproject_pixels
from splatpipe.pipeline.surface.depths.sources import MIN_CONFIRMED, PosedDepthMap

SIDE = 8  # voxels per side of a block: a surface fills smaller blocks better than open3d's default of 16
BAND = 3.0  # truncation distance on either side of the surface, in voxels
MIN_PHOTOS = 2  # photos that have to see a surface in a block: each of their depths is already confirmed by others
PIXEL_STEP = 3  # one pixel in this many is used per axis: blocks are wider
MIN_GROWTH = 1.05  # factor by which voxels that were too small grow
BITS = 21  # size of a block's number along an axis: two million blocks

Keys = Int64[np.ndarray, " n"]
Box = Float64[np.ndarray, "2 3"]  # least and largest east, north, up, metres: the part of the world that counts


def depths_in(box: Box, found: PosedDepthMap) -> Float32[np.ndarray, "h w"]:
    """A photo's confirmed depths inside a box; 0 elsewhere."""
    sure = (found.confidence >= MIN_CONFIRMED) & (found.depth > 0.0)
    row, column = np.nonzero(sure)
    xyz = _positions(found, row, column)
    inside = ((xyz >= box[0][:, None]) & (xyz < box[1][:, None])).all(axis=0)
    depth = np.zeros_like(found.depth)
    depth[row[inside], column[inside]] = found.depth[row[inside], column[inside]]
    return depth


def _positions(found: PosedDepthMap, row: np.ndarray, column: np.ndarray) -> Float64[np.ndarray, "3 n"]:
    return unproject_pixels(found.camera, row, column, 1.0 / found.depth[row, column].astype(np.float64))


@dataclass(frozen=True, eq=False)
class Blocks:
    """Cubes of voxels near a surface.

    Attributes:
        low: East, north, up of the origin of the block indices, metres.
        voxel_m: Voxel size, metres.
        places: Block indices from there: (3, n).
    """

    low: Float64[np.ndarray, " 3"]
    voxel_m: float
    places: Int64[np.ndarray, "3 n"]

    def centres(self) -> Float64[np.ndarray, "3 n"]:
        """East, north, up of the blocks' centres, metres."""
        return np.asarray(self.low[:, None] + (self.places + 0.5) * (SIDE * self.voxel_m))


def surface_blocks(photos: PhotoSet, box: Box, voxel_m: float, most: int, threads: int) -> Blocks:
    """Blocks in which enough photos see a surface; identical for any number of threads.

    Args:
        photos: Photos with their depths.
        box: The part of the world to use.
        voxel_m: Voxel size, metres; increased if there would be too many blocks.
        most: Maximum number of blocks.
        threads: Photos in parallel.
    """
    while True:
        keys, seen = np.zeros(0, np.int64), np.zeros(0, np.int64)
        find_keys = partial(_keys_of_photo, photos, box, voxel_m)
        for found in ordered_map(find_keys, photos.with_depths(), threads):
            every = np.concatenate([keys, found])
            count = np.concatenate([seen, np.ones(len(found), np.int64)])
            keys, place = np.unique(every, return_inverse=True)
            seen = np.bincount(place, count, len(keys)).astype(np.int64)
        kept = keys[seen >= MIN_PHOTOS]
        if len(kept) <= most:
            return Blocks(box[0], voxel_m, blocks_of(kept))
        voxel_m *= max(MIN_GROWTH, float(np.sqrt(len(kept) / most)))  # the number of blocks is proportional to the area


def _keys_of_photo(photos: PhotoSet, box: Box, voxel_m: float, number: int) -> Keys:
    return visible_blocks(box, voxel_m, photos.depth_map(number))


def visible_blocks(box: Box, voxel_m: float, found: PosedDepthMap) -> Keys:
    """Keys of the blocks in which a photo sees a surface, or the band around it, in order."""
    depth = depths_in(box, found)
    row, column = np.nonzero(depth[::PIXEL_STEP, ::PIXEL_STEP])
    xyz = (_positions(found, row * PIXEL_STEP, column * PIXEL_STEP) - box[0][:, None]) / voxel_m
    corners = [
        keys_of(np.floor((xyz + BAND * np.array(signs)[:, None]) / SIDE).astype(np.int64))
        for signs in product((-1.0, 1.0), repeat=3)
    ]
    return np.asarray(np.unique(np.concatenate(corners)))


def keys_of(blocks: Int64[np.ndarray, "3 n"]) -> Keys:
    """An integer key for each block."""
    x, y, z = blocks + (1 << (BITS - 1))
    return np.asarray((x << (2 * BITS)) | (y << BITS) | z)


def blocks_of(keys: Keys) -> Int64[np.ndarray, "3 n"]:
    """The inverse of ``keys_of``."""
    mask = (1 << BITS) - 1
    return np.stack([keys >> (2 * BITS), (keys >> BITS) & mask, keys & mask]) - (1 << (BITS - 1))
