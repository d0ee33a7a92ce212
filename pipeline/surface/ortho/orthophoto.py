"""The true orthophoto: every cell is coloured from the best photo that sees the topmost surface there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Int16, Int64, UInt8, UInt16

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.surface.depths.photo_gains import PhotoGains
from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource, pixel_loader, rate_points
from splatpipe.pipeline.surface.depths.point_visibility import Points, classify_points, contiguous
from splatpipe.pipeline.surface.depths.sources import HeightRange, LruCache, PosedDepthMap, photos_seeing
from splatpipe.pipeline.surface.heights.height_field import HeightField
from splatpipe.pipeline.surface.ortho.mosaic import MARGIN, compose_mosaic, extend_colours, keep_best
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile

TILE = 384  # cells per side
EXTENDED_CELLS = 24  # cells over which colours are extended into areas that no photo sees; farther away there is none
MAX_COSTS = 24_000_000  # cells times photos at once: 70 MB of costs, and colours of a few photos
MIN_CELLS = 1 << 14  # smaller tiles are not split: they would be mostly margin


@dataclass(frozen=True, eq=False)
class Orthophoto:
    """A tile of the orthophoto.

    Attributes:
        tile: The tile.
        colour: RGB, 8 bits; black where there is none.
        photos: How many photos see each cell; 0 where colours were extended from nearby or are missing.
        label: Index of the photo that colours each cell; -1 where none sees it.
        known: Where there is a colour.
    """

    tile: Tile
    colour: UInt8[np.ndarray, "h w 3"]
    photos: UInt8[np.ndarray, "h w"]
    label: Int16[np.ndarray, "h w"]
    known: Bool[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class OrthoInput:
    """Inputs of the orthophoto's tiles.

    Attributes:
        sources: Photos, always in the same order.
        surface: Heights of the surface.
        lattice: Cells to colour; may be finer than those of the heights.
        relief: Lowest and highest height of the surface.
        levels: Exposure gains of the photos.
        pixels: Cache of a few photos' pixels.
        depths: Cache of a few photos' depths.
    """

    sources: Sequence[PhotoSource]
    surface: HeightField
    lattice: Lattice
    relief: HeightRange
    levels: PhotoGains
    pixels: LruCache[UInt8[np.ndarray, "_ _ 3"]]
    depths: LruCache[PosedDepthMap]


def orthophotos(album: OrthoInput, tiles: Sequence[Tile], threads: int) -> Iterator[Orthophoto]:
    """Compute tiles of the orthophoto in order; bit-identical for any number of threads and any tiling.

    Args:
        album: Photos, surface and cells.
        tiles: Tiles to compute.
        threads: Tiles in parallel.

    Raises:
        ValueError: if pixels or depths do not fit their camera.
    """
    return ordered_map(partial(tile_orthophoto, album), tiles, threads)


def tile_orthophoto(album: OrthoInput, tile: Tile, most: int = MAX_COSTS) -> Orthophoto:
    """Compute one tile of the orthophoto.

    Args:
        album: Photos, surface and cells.
        tile: The tile.
        most: Limit on cells times photos; tiles above it are computed in parts.
    """
    wide = tile.grown(MARGIN + EXTENDED_CELLS)
    windows = photos_seeing([source.camera for source in album.sources], album.lattice, wide, album.relief)
    if len(windows) * wide.cells > most and tile.cells > MIN_CELLS:
        return _join_halves(tile, [tile_orthophoto(album, half, most) for half in tile.halves()])
    east, north = np.moveaxis(album.lattice.centres(wide), -1, 0)
    points = contiguous((east, north, album.surface.at(east, north)))
    numbers, seen, cost = _rate_photos(album, [number for number, _ in windows], points)
    photos = keep_best(seen, cost)
    best = np.flatnonzero(seen.any(axis=(1, 2)))
    numbers, seen, cost = numbers[best], seen[best], cost[best]
    colour = np.empty((*seen.shape, 3), np.uint8)
    for number, there, out in zip(numbers, seen, colour, strict=True):
        source = album.sources[number]
        pixels = album.pixels.get(number, pixel_loader(source))
        out[:] = album.levels.sample(int(number), (source, pixels), points, there, album.lattice.cell_m)
    made = compose_mosaic(seen, cost, colour, (wide.row + wide.column) % 2)
    filled, known = extend_colours(made.colour, made.label >= 0, np.isfinite(points[2]), EXTENDED_CELLS)
    inner = tuple(slice(MARGIN + EXTENDED_CELLS, MARGIN + EXTENDED_CELLS + size) for size in (tile.height, tile.width))
    label = np.append(numbers, -1).astype(np.int16)[made.label]
    return Orthophoto(tile, filled[inner], photos[inner], label[inner], known[inner])


def _rate_photos(
    album: OrthoInput, numbers: Sequence[int], points: Points
) -> tuple[Int64[np.ndarray, " n"], Bool[np.ndarray, "n h w"], UInt16[np.ndarray, "n h w"]]:
    """Indices of the photos that see any of the points, where they see them, and the cost of colouring from each.

    Costs are also given where a photo does not see a point, because a cell's surroundings count.
    """
    shape = (len(numbers), *points[2].shape)
    seen, cost = np.empty(shape, np.bool_), np.empty(shape, np.uint16)
    found: list[int] = []
    for number in numbers:
        source = album.sources[number]
        if source.depths is None:
            continue
        view = classify_points(album.depths.get(number, source.depths.load_sized), points, 0.0)
        each, there = rate_points(source.camera, points, album.lattice.cell_m, view.flags)
        if there.any():
            cost[len(found)], seen[len(found)] = each, there
            found.append(number)
    return np.array(found, np.int64), seen[: len(found)], cost[: len(found)]


def _join_halves(tile: Tile, halves: Sequence[Orthophoto]) -> Orthophoto:
    """Join the halves of a tile."""
    axis = 0 if halves[0].tile.width == tile.width else 1
    columns = zip(*((half.colour, half.photos, half.label, half.known) for half in halves), strict=True)
    return Orthophoto(tile, *(np.concatenate(column, axis=axis) for column in columns))
