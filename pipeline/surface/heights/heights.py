"""The surface model: the height of the topmost surface in every cell, from the depths of all photos that see it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.surface.depths.point_visibility import PointVisibility, classify_points
from splatpipe.pipeline.surface.depths.sources import DepthSource, HeightRange, LruCache, PosedDepthMap, photos_seeing
from splatpipe.pipeline.surface.heights.holes import fill_holes
from splatpipe.pipeline.surface.heights.votes import MIN_COVER_SHARE, HeightVotes, Layer, needs_check
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile

TILE = 256  # cells per side
MIN_PHOTOS = 3  # photos that have to see a cell
FILL_CELLS = 4  # cells: holes up to this size are filled from their surroundings,
SEEN_FILL_CELLS = 16  # larger ones up to this if photos may see the filled surface,
FAR_ON_WALLS = 28  # and still larger ones on walls, which are flat and textureless where depths are missing
# One photo that sees through a surface outweighs this many that see it: depths widen foreground objects.
OUTWEIGHED_PHOTOS = 8
MIN_AGREEING_PHOTOS = 2  # photos that agree on a height are enough where a third one may see it
FILLED_SIGMA_CELLS = 1.0  # expected deviation of a filled cell, in cells
MAX_VOTES = 5_000_000  # cells times photos at once: 250 MB while they are sorted
MIN_CELLS = 1 << 12  # smaller tiles are not split: they would be mostly margin
MAX_COUNT = np.iinfo(np.uint8).max


@dataclass(frozen=True, eq=False)
class Heights:
    """A tile of the surface model.

    Attributes:
        tile: The tile.
        height: Height of the topmost surface at the cells' centres, local metres; NaN where fewer than three photos see
            it.
        sigma: Expected deviation of each height, metres; NaN where there is none.
        photos: How many photos agree on each height; 2 where a third one may see it, 1 where it was filled from its
            surroundings, 0 where there is none.
    """

    tile: Tile
    height: Float32[np.ndarray, "h w"]
    sigma: Float32[np.ndarray, "h w"]
    photos: UInt8[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class HeightInput:
    """Inputs of the surface model.

    Attributes:
        sources: Depths of the photos, always in the same order.
        lattice: Cells that get heights.
        relief: Lowest and highest height to consider.
        cache: Cache of a few depth maps.
        upright: Whether the lattice is a wall's instead of the ground's.
    """

    sources: Sequence[DepthSource]
    lattice: Lattice
    relief: HeightRange
    cache: LruCache[PosedDepthMap]
    upright: bool = False

    @property
    def far(self) -> int:
        """Size limit of the larger holes to fill, cells."""
        return FAR_ON_WALLS if self.upright else SEEN_FILL_CELLS

    @property
    def margin(self) -> int:
        """Margin around a tile that filling its holes needs, cells."""
        return FILL_CELLS + self.far + 1

    def depths(self, number: int) -> PosedDepthMap:
        """A photo's depths, loaded if they are not cached."""
        return self.cache.get(number, self.sources[number].load_sized)


def surface_heights(capture: HeightInput, tiles: Sequence[Tile], threads: int) -> Iterator[Heights]:
    """Compute heights of tiles in order; bit-identical for any number of threads and any tiling.

    Args:
        capture: Photos and cells.
        tiles: Tiles to compute.
        threads: Tiles in parallel.

    Raises:
        ValueError: if depths do not fit their camera.
    """
    return ordered_map(partial(tile_heights, capture), tiles, threads)


def tile_heights(capture: HeightInput, tile: Tile, most: int = MAX_VOTES) -> Heights:
    """Compute the heights of one tile.

    Args:
        capture: Photos and cells.
        tile: The tile.
        most: Limit on cells times photos; tiles above it are computed in parts.
    """
    wide = tile.grown(capture.margin)
    seen = photos_seeing([source.camera for source in capture.sources], capture.lattice, wide, capture.relief)
    if len(seen) * wide.cells > most and tile.cells > MIN_CELLS:
        return _join_halves(tile, [tile_heights(capture, half, most) for half in tile.halves()])
    votes = HeightVotes(capture.lattice, wide, capture.relief)
    for number, window in seen:
        votes.add(capture.depths(number), window)
    found = votes.layers()
    if not found:
        return _empty(tile)
    numbers = [number for number, _ in seen]
    fit = votes.fit(_choose_surface(capture, wide, found, numbers))
    agreed = np.where(fit.photos >= MIN_PHOTOS, fit.height, np.nan)
    few = np.flatnonzero((fit.photos == MIN_AGREEING_PHOTOS) & np.isfinite(fit.height))
    may = _count_possible_views(capture, wide, few, fit.height[few], numbers) >= MIN_PHOTOS
    agreed[few[may]] = fit.height[few[may]]
    height, new = _fill_holes(capture, wide, agreed, numbers)
    shape = (wide.height, wide.width)
    sigma = np.where(new, FILLED_SIGMA_CELLS * capture.lattice.cell_m, fit.sigma).reshape(shape)
    photo_counts = np.where(np.isfinite(agreed), np.minimum(fit.photos, MAX_COUNT), 0)
    photos, height = np.where(new, 1, photo_counts).reshape(shape), height.reshape(shape)
    inner = tuple(slice(capture.margin, capture.margin + side) for side in (tile.height, tile.width))
    known = np.isfinite(height)
    return Heights(
        tile,
        height[inner].astype(np.float32),
        np.where(known, sigma, np.nan)[inner].astype(np.float32),
        photos[inner].astype(np.uint8),
    )


def _fill_holes(
    capture: HeightInput, tile: Tile, height: Float64[np.ndarray, " c"], numbers: Sequence[int]
) -> tuple[Float64[np.ndarray, " c"], Bool[np.ndarray, " c"]]:
    """Fill a tile's small holes, and larger ones where enough photos may see the result; also returns which are new."""
    shape, cell_m = (tile.height, tile.width), capture.lattice.cell_m
    near, _ = fill_holes(height.reshape(shape), cell_m, FILL_CELLS, capture.upright)
    far, new = fill_holes(near, cell_m, capture.far, capture.upright)
    result, candidates = far.ravel(), np.flatnonzero(new)
    seen = _count_possible_views(capture, tile, candidates, result[candidates], numbers) >= MIN_PHOTOS
    result[candidates[~seen]] = np.nan
    return result, np.isfinite(result) & np.isnan(height)


def _count_possible_views(
    capture: HeightInput,
    tile: Tile,
    candidates: Int64[np.ndarray, " a"],
    height: Float64[np.ndarray, " a"],
    numbers: Sequence[int],
) -> Int64[np.ndarray, " a"]:
    """How many photos see each place, or have it in view without a depth there."""
    count = np.zeros(len(candidates), np.int64)
    for _, view in _views(capture, tile, candidates, height[None], numbers):
        count += view.seen | view.unknown
    return count


def _views(
    capture: HeightInput,
    tile: Tile,
    candidates: Int64[np.ndarray, " a"],
    heights: Float64[np.ndarray, "l a"],
    numbers: Sequence[int],
) -> Iterator[tuple[int, PointVisibility]]:
    """Visibility of places in some of a tile's cells in each photo, layer by layer, with the layer's index."""
    east, north = np.ascontiguousarray(capture.lattice.centres(tile).reshape(-1, 2)[candidates].T)
    for number in reversed(numbers) if candidates.size else ():  # the last ones are still cached
        found = capture.depths(number)
        for layer, height in enumerate(heights):
            yield layer, classify_points(found, (east, north, height), capture.lattice.cell_m)


def _join_halves(tile: Tile, halves: Sequence[Heights]) -> Heights:
    """Join the halves of a tile."""
    axis = 0 if halves[0].tile.width == tile.width else 1
    columns = zip(*((half.height, half.sigma, half.photos) for half in halves), strict=True)
    return Heights(tile, *(np.concatenate(column, axis=axis) for column in columns))


def _empty(tile: Tile) -> Heights:
    nothing = np.full((tile.height, tile.width), np.nan, np.float32)
    return Heights(tile, nothing, nothing.copy(), np.zeros((tile.height, tile.width), np.uint8))


def _choose_surface(
    capture: HeightInput, tile: Tile, found: Sequence[Layer], numbers: Sequence[int]
) -> Float64[np.ndarray, " c"]:
    """The highest surface in each cell that not too many photos see through; NaN where there is none.

    Surfaces that cover at least half of the cell take precedence.
    """
    candidates = np.flatnonzero(needs_check(found, MIN_PHOTOS))
    heights = np.stack([layer.height[candidates] for layer in found])
    balance = _balance(capture, tile, candidates, heights, numbers)
    good = np.isfinite(heights) & (balance >= 0)
    covering = good & (np.stack([layer.cover[candidates] for layer in found]) >= MIN_COVER_SHARE)
    good = np.where(covering.any(axis=0), covering, good)
    highest = np.where(good.any(axis=0), np.argmax(good, axis=0), -1)
    start = found[0].height.copy()
    start[candidates] = np.where(highest >= 0, heights[highest, np.arange(len(candidates))], np.nan)
    return start


def _balance(
    capture: HeightInput,
    tile: Tile,
    candidates: Int64[np.ndarray, " a"],
    heights: Float64[np.ndarray, "l a"],
    numbers: Sequence[int],
) -> Int64[np.ndarray, "l a"]:
    """Number of photos that see a surface, minus ``OUTWEIGHED_PHOTOS`` times those that see through it."""
    balance = np.zeros(heights.shape, np.int64)
    for layer, view in _views(capture, tile, candidates, heights, numbers):  # whole numbers add up in any order
        balance[layer] += view.seen.astype(np.int64) - OUTWEIGHED_PHOTOS * view.through.astype(np.int64)
    return balance
