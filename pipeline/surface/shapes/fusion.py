"""Fusion of depth maps into one point cloud: each part of the surface once, from the photo that sees it best.

A pixel becomes a point unless a photo with a smaller footprint there has it, too. The point then moves along its normal
to the average over all photos that see it, and is dropped if as many photos see through it. (Merrell et al., "Real-Time
Visibility-Based Fusion of Depth Maps", ICCV 2007, also weigh these two against each other.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatpipe.pipeline.surface.depths.depth_points import REACHES, DepthPoints, depth_points, pixel_normals
from splatpipe.pipeline.surface.depths.photo_set import (
    DepthPart,
    SurfacePieces,
    SurfaceView,
    dot,
    unproject_pixels,
    view_pieces,
)
from splatpipe.pipeline.surface.depths.sources import HeightRange
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile

MAX_FOOTPRINT_SHARE = 0.9  # a photo with less of a point's footprint takes it over; else both may keep it
MIN_PHOTOS = 3  # photos that have to see a point, including its own
REACH = 2.5  # standard deviations from the mean within which a photo counts (Tukey's biweight; Beaton and Tukey 1974)
SIGMA_PX = 0.7  # standard deviation of a depth, in pixel footprints on the surface
ROUNDS = 3  # iterations of the robust mean
COMPACT_SHARE = 0.3  # share of discarded points at which the arrays are compacted
BATCH = 1 << 14  # points at a time: takes 16 bytes per point and photo
MAX_COUNT = np.iinfo(np.uint8).max


@dataclass(frozen=True, eq=False)
class FusedPoints:
    """A fused point cloud.

    Attributes:
        pieces: Positions and normals of the points.
        footprint: Size of the best photo's pixel on the surface at each point, metres.
        confidence: How many other photos see each point.
    """

    pieces: SurfacePieces
    footprint: Float64[np.ndarray, " n"]
    confidence: UInt8[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.footprint)

    def select(self, rows: np.ndarray) -> FusedPoints:
        """The points of these rows."""
        return FusedPoints(self.pieces.select(rows), self.footprint[rows], self.confidence[rows])


def fuse_depths(parts: Sequence[DepthPart], lattice: Lattice, tile: Tile, relief: HeightRange) -> FusedPoints:
    """Fuse the depths in a tile, photo by photo; points may lie slightly outside of the tile.

    Args:
        parts: The parts of all photos' depths that may show the tile.
        lattice: The lattice of the tile.
        tile: The tile.
        relief: Height range; points outside of it are noise.
    """
    if not parts:
        return concatenate_clouds([])
    nearest = _by_distance(parts, lattice, tile)
    finest = [_drop_coarser(depth_points(part, lattice, tile, relief), nearest) for part in parts]
    xyz = np.concatenate([each.pieces.xyz for each in finest], axis=1)
    footprint = np.concatenate([each.footprint for each in finest])
    kept = np.zeros(len(footprint), np.bool_)
    kept[finest_of_cubes(xyz, footprint, lattice, tile)] = True
    ends = np.cumsum([len(each.footprint) for each in finest])
    found = []
    for points, some in zip(finest, np.split(kept, ends[:-1]), strict=True):
        points = points.select(some)
        starts = range(0, len(points.footprint), BATCH)
        found += [_average_positions(points.select(np.s_[start : start + BATCH]), parts) for start in starts]
    return concatenate_clouds(found)


def finest_of_cubes(
    xyz: Float64[np.ndarray, "3 n"], footprint: Float64[np.ndarray, " n"], lattice: Lattice, tile: Tile
) -> Int64[np.ndarray, " k"]:
    """Rows of the finest point in each cube of cell size, by cell and height; those outside of the tile are dropped."""
    cell = lattice.cells(tile, xyz[0], xyz[1])
    kept = np.flatnonzero(cell >= 0)
    layer = np.floor(xyz[2, kept] / lattice.cell_m).astype(np.int64)
    layer -= layer.min(initial=0)
    cube = cell[kept] * (int(layer.max(initial=0)) + 1) + layer
    order = np.lexsort((kept, footprint[kept], cube))
    first = np.ones(len(order), np.bool_)
    first[1:] = cube[order][1:] != cube[order][:-1]
    return kept[order[first]]


def concatenate_clouds(found: Sequence[FusedPoints]) -> FusedPoints:
    """Concatenate clouds."""
    none = FusedPoints(SurfacePieces(np.zeros((3, 0)), np.zeros((3, 0))), np.zeros(0), np.zeros(0, np.uint8))
    every = [none, *found]
    xyz, normal = (np.concatenate([getattr(each.pieces, name) for each in every], axis=1) for name in ("xyz", "normal"))
    footprint = np.concatenate([each.footprint for each in every])
    return FusedPoints(SurfacePieces(xyz, normal), footprint, np.concatenate([each.confidence for each in every]))


def _by_distance(parts: Sequence[DepthPart], lattice: Lattice, tile: Tile) -> list[DepthPart]:
    """Parts sorted by distance: near photos are likely to be finer, so most points need no others."""
    middle = lattice.centres(tile)[tile.height // 2, tile.width // 2]
    away = [float(np.hypot(*(part.camera.centre()[:2] - middle))) for part in parts]
    return [parts[k] for k in np.argsort(away, kind="stable")]


def _drop_coarser(points: DepthPoints, others: Sequence[DepthPart]) -> DepthPoints:
    """Points that no other photo sees more finely."""
    lost = np.zeros(len(points.footprint), np.bool_)
    for other in others:
        if lost.all():
            break
        if other.number == points.number:
            continue
        if lost.mean() > COMPACT_SHARE:
            points, lost = points.select(~lost), np.zeros(int((~lost).sum()), np.bool_)
        view = view_pieces(other.camera, points.pieces)
        candidates = np.flatnonzero((view.footprint < MAX_FOOTPRINT_SHARE * points.footprint) & ~lost)
        visibility = view.classify(other, candidates)
        lost[candidates] = visibility.seen & ~visibility.mixed
    return points.select(~lost)


@dataclass(frozen=True, eq=False)
class _OtherPositions:
    """Positions of the points according to other photos; one row per photo that sees any.

    Attributes:
        offset: From a point to its position in the photo's depths, metres: (photos, 3, n).
        weight: Weight of the photo; 0 where it does not see the point.
    """

    offset: Float32[np.ndarray, "m 3 n"]
    weight: Float32[np.ndarray, "m n"]


def _average_positions(points: DepthPoints, parts: Sequence[DepthPart]) -> FusedPoints:
    """Points moved to the average of the photos that see them, without those that few see or many see through."""
    others, normal, balance = _other_positions(points, parts)
    count = 1 + (others.weight > 0.0).sum(axis=0)
    kept = np.flatnonzero((count >= MIN_PHOTOS) & (balance > 0))
    normal = normal[:, kept]
    normal = normal / np.maximum(np.sqrt(dot(normal, normal)), 1e-30)
    offset = others.offset[:, :, kept]
    along = offset[:, 0] * normal[0] + offset[:, 1] * normal[1] + offset[:, 2] * normal[2]
    footprint = points.footprint[kept]
    shift = _robust_mean(along, others.weight[:, kept].astype(np.float64), footprint)
    pieces = SurfacePieces(points.pieces.xyz[:, kept] + normal * shift, normal)
    return FusedPoints(pieces, footprint, np.minimum(count[kept] - 1, MAX_COUNT).astype(np.uint8))


def _other_positions(
    points: DepthPoints, parts: Sequence[DepthPart]
) -> tuple[_OtherPositions, Float64[np.ndarray, "3 n"], Int64[np.ndarray, " n"]]:
    """The other photos' positions; the sum of all normals; and how many more photos see a point than see through it."""
    size = len(points.footprint)
    normal, balance = points.pieces.normal.copy(), np.ones(size, np.int64)
    offsets, weights = [np.zeros((0, 3, size), np.float32)], [np.zeros((0, size), np.float32)]
    for part in parts:
        if part.number == points.number:
            continue
        view = view_pieces(part.camera, points.pieces)
        visibility = view.classify(part, np.s_[:])
        facing = np.isfinite(view.footprint)
        balance -= visibility.through
        seen = visibility.seen & facing
        if not seen.any():
            continue
        balance += seen
        offset, theirs = _place_and_normal(points.pieces, part, view, seen)
        normal[:, seen] += theirs
        whole, weight = np.zeros((1, 3, size), np.float32), np.zeros((1, size), np.float32)
        whole[0][:, seen] = offset
        weight[0, seen] = np.square(points.footprint[seen] / view.footprint[seen])
        offsets.append(whole)
        weights.append(weight)
    return _OtherPositions(np.concatenate(offsets), np.concatenate(weights)), normal, balance


def _place_and_normal(
    pieces: SurfacePieces, part: DepthPart, view: SurfaceView, seen: Bool[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, "3 k"], Float64[np.ndarray, "3 k"]]:
    """Offsets from points to the surface at their pixels in another photo, and the normals there; zero where unknown.

    A pixel's centre lies beside the point, but on the surface's plane, so along the normal the offset is the plane's.
    """
    row, column = view.place.row[seen].astype(np.int64), view.place.column[seen].astype(np.int64)
    offset = (
        unproject_pixels(part.camera, row, column, 1.0 / part.depth[row, column].astype(np.float64))
        - pieces.xyz[:, seen]
    )
    normal, flat = pixel_normals(part, row, column, REACHES[0])
    return offset, np.where(flat, normal, 0.0)


def _robust_mean(
    along: Float64[np.ndarray, "m n"], weight: Float64[np.ndarray, "m n"], footprint: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Shifts of points along their normals: the biweight mean, which includes the point's own position."""
    mean = np.zeros(len(footprint))
    reach = REACH * SIGMA_PX * footprint
    for _ in range(ROUNDS):
        own = np.square(np.maximum(1.0 - np.square(mean / reach), 0.0))
        near = weight * np.square(np.maximum(1.0 - np.square((along - mean) / reach), 0.0))
        total, moved = own.copy(), np.zeros(len(footprint))
        for row, there in zip(near, along, strict=True):  # in order: sums of the same bits for any number of points
            total += row
            moved += row * there
        mean = np.divide(moved, total, out=mean.copy(), where=total > 0.0)
    return mean
