"""Depths of many photos as one cloud: each place of the surface once, by the photo that sees it best.

A pixel becomes a point unless a photo that sees the place more finely has it, too. It then moves along its normal to
where all photos that see it have it, on average, and is dropped where as many look through it. (Merrell et al.,
"Real-Time Visibility-Based Fusion of Depth Maps", ICCV 2007, weigh these two against each other, too.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatpipe.pipeline.surface.depth_points import REACHES, DepthPoints, depth_points, picture_normals
from splatpipe.pipeline.surface.lattice import Lattice
from splatpipe.pipeline.surface.photo_set import DepthPart, SurfacePieces, SurfaceView, dot, look_at, place_of
from splatpipe.pipeline.surface.sources import HeightRange
from splatpipe.pipeline.surface.tiles import Tile

FINER = 0.9  # of a point's footprint: a photo with less than that has the place instead; beyond it both may
LEAST_PHOTOS = 3  # that have to see a point, its own among them
REACH = 2.5  # deviations of the mean within which a photo counts (Tukey's biweight; Beaton and Tukey 1974)
SIGMA_PX = 0.7  # of a depth, in pixels' lengths on the surface
ROUNDS = 3  # of the robust mean
STALE = 0.3  # of points that are lost, which it is time to leave behind
BATCH = 1 << 14  # points at a time: what each photo says of them is held, 16 bytes a point and photo
MOST = np.iinfo(np.uint8).max


@dataclass(frozen=True, eq=False)
class FusedPoints:
    """A cloud.

    Attributes:
        pieces: Where its points are, and which way they face.
        footprint: How long a pixel of the best photo is on each, metres.
        confidence: How many photos besides that one see it.
    """

    pieces: SurfacePieces
    footprint: Float64[np.ndarray, " n"]
    confidence: UInt8[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.footprint)

    def select(self, rows: np.ndarray) -> FusedPoints:
        """Those of them."""
        return FusedPoints(self.pieces.select(rows), self.footprint[rows], self.confidence[rows])


def fused(parts: Sequence[DepthPart], lattice: Lattice, tile: Tile, relief: HeightRange) -> FusedPoints:
    """The cloud of a tile, photo by photo; its points may have left the tile by a little.

    Args:
        parts: Of all photos' depths, wherever the tile may lie in them.
        lattice: Whose cells are meant.
        tile: Which of them.
        relief: Points outside of these heights are noise.
    """
    if not parts:
        return joined([])
    nearest = _by_distance(parts, lattice, tile)
    finest = [_finest(depth_points(part, lattice, tile, relief), nearest) for part in parts]
    xyz = np.concatenate([each.pieces.xyz for each in finest], axis=1)
    footprint = np.concatenate([each.footprint for each in finest])
    kept = np.zeros(len(footprint), np.bool_)
    kept[finest_of_cubes(xyz, footprint, lattice, tile)] = True
    ends = np.cumsum([len(each.footprint) for each in finest])
    found = []
    for points, some in zip(finest, np.split(kept, ends[:-1]), strict=True):
        points = points.select(some)
        starts = range(0, len(points.footprint), BATCH)
        found += [_agreed(points.select(np.s_[start : start + BATCH]), parts) for start in starts]
    return joined(found)


def finest_of_cubes(
    xyz: Float64[np.ndarray, "3 n"], footprint: Float64[np.ndarray, " n"], lattice: Lattice, tile: Tile
) -> Int64[np.ndarray, " k"]:
    """Rows of the finest point in each cube of a cell's side, by cell and height; none of what is outside of a tile."""
    cell = lattice.cells(tile, xyz[0], xyz[1])
    kept = np.flatnonzero(cell >= 0)
    layer = np.floor(xyz[2, kept] / lattice.cell_m).astype(np.int64)
    layer -= layer.min(initial=0)
    cube = cell[kept] * (int(layer.max(initial=0)) + 1) + layer
    order = np.lexsort((kept, footprint[kept], cube))
    first = np.ones(len(order), np.bool_)
    first[1:] = cube[order][1:] != cube[order][:-1]
    return kept[order[first]]


def joined(found: Sequence[FusedPoints]) -> FusedPoints:
    """Several clouds one after the other."""
    none = FusedPoints(SurfacePieces(np.zeros((3, 0)), np.zeros((3, 0))), np.zeros(0), np.zeros(0, np.uint8))
    every = [none, *found]
    xyz, normal = (np.concatenate([getattr(each.pieces, name) for each in every], axis=1) for name in ("xyz", "normal"))
    footprint = np.concatenate([each.footprint for each in every])
    return FusedPoints(SurfacePieces(xyz, normal), footprint, np.concatenate([each.confidence for each in every]))


def _by_distance(parts: Sequence[DepthPart], lattice: Lattice, tile: Tile) -> list[DepthPart]:
    """The nearest photos first: they are likely to have a place more finely, and most points need no others."""
    middle = lattice.centres(tile)[tile.height // 2, tile.width // 2]
    away = [float(np.hypot(*(part.camera.centre()[:2] - middle))) for part in parts]
    return [parts[k] for k in np.argsort(away, kind="stable")]


def _finest(points: DepthPoints, others: Sequence[DepthPart]) -> DepthPoints:
    """Points that no other photo sees more finely."""
    lost = np.zeros(len(points.footprint), np.bool_)
    for other in others:
        if lost.all():
            break
        if other.number == points.number:
            continue
        if lost.mean() > STALE:
            points, lost = points.select(~lost), np.zeros(int((~lost).sum()), np.bool_)
        look = look_at(other.camera, points.pieces)
        asked = np.flatnonzero((look.footprint < FINER * points.footprint) & ~lost)
        sight = look.sight(other, asked)
        lost[asked] = sight.seen & ~sight.mixed
    return points.select(~lost)


@dataclass(frozen=True, eq=False)
class _Opinion:
    """What the photos say about points, a row a photo that sees some.

    Attributes:
        offset: From a point to the photo's place of it, metres: (photos, 3, n).
        weight: How much it counts; 0 where it does not see it.
    """

    offset: Float32[np.ndarray, "m 3 n"]
    weight: Float32[np.ndarray, "m n"]


def _agreed(points: DepthPoints, parts: Sequence[DepthPart]) -> FusedPoints:
    """Points where the photos that see them have them, without those that few see or many look through."""
    opinion, normal, balance = _heard(points, parts)
    count = 1 + (opinion.weight > 0.0).sum(axis=0)
    kept = np.flatnonzero((count >= LEAST_PHOTOS) & (balance > 0))
    normal = normal[:, kept]
    normal = normal / np.maximum(np.sqrt(dot(normal, normal)), 1e-30)
    offset = opinion.offset[:, :, kept]
    along = offset[:, 0] * normal[0] + offset[:, 1] * normal[1] + offset[:, 2] * normal[2]
    footprint = points.footprint[kept]
    shift = _robust_mean(along, opinion.weight[:, kept].astype(np.float64), footprint)
    pieces = SurfacePieces(points.pieces.xyz[:, kept] + normal * shift, normal)
    return FusedPoints(pieces, footprint, np.minimum(count[kept] - 1, MOST).astype(np.uint8))


def _heard(
    points: DepthPoints, parts: Sequence[DepthPart]
) -> tuple[_Opinion, Float64[np.ndarray, "3 n"], Int64[np.ndarray, " n"]]:
    """What the other photos say; the sum of all normals; and how many more see a point than look through it."""
    size = len(points.footprint)
    normal, balance = points.pieces.normal.copy(), np.ones(size, np.int64)
    offsets, weights = [np.zeros((0, 3, size), np.float32)], [np.zeros((0, size), np.float32)]
    for part in parts:
        if part.number == points.number:
            continue
        look = look_at(part.camera, points.pieces)
        sight = look.sight(part, np.s_[:])
        facing = np.isfinite(look.footprint)
        balance -= sight.through
        seen = sight.seen & facing
        if not seen.any():
            continue
        balance += seen
        offset, theirs = _place_and_normal(points.pieces, part, look, seen)
        normal[:, seen] += theirs
        whole, weight = np.zeros((1, 3, size), np.float32), np.zeros((1, size), np.float32)
        whole[0][:, seen] = offset
        weight[0, seen] = np.square(points.footprint[seen] / look.footprint[seen])
        offsets.append(whole)
        weights.append(weight)
    return _Opinion(np.concatenate(offsets), np.concatenate(weights)), normal, balance


def _place_and_normal(
    pieces: SurfacePieces, part: DepthPart, look: SurfaceView, seen: Bool[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, "3 k"], Float64[np.ndarray, "3 k"]]:
    """From points to the pixels that show them in another photo, and these pixels' normals; zero where unknown.

    A pixel's centre lies beside the point, but on its plane: along the normal it is as far off as the plane.
    """
    row, column = look.place.row[seen].astype(np.int64), look.place.column[seen].astype(np.int64)
    offset = place_of(part.camera, row, column, 1.0 / part.depth[row, column].astype(np.float64)) - pieces.xyz[:, seen]
    normal, flat = picture_normals(part, row, column, REACHES[0])
    return offset, np.where(flat, normal, 0.0)


def _robust_mean(
    along: Float64[np.ndarray, "m n"], weight: Float64[np.ndarray, "m n"], footprint: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """How far points move along their normals: the biweight mean, the own place among what is averaged."""
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
