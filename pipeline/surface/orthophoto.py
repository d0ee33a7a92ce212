"""The true orthophoto: every cell coloured by the best photo that sees the topmost surface there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64, Int16, UInt8, UInt16

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.surface.height_field import HeightField
from splatpipe.pipeline.surface.lattice import Lattice
from splatpipe.pipeline.surface.mosaic import MARGIN, composed, spread
from splatpipe.pipeline.surface.photo_samples import PhotoSource, loader, rated, sampled, tone_curve
from splatpipe.pipeline.surface.sight import Points, contiguous, sight
from splatpipe.pipeline.surface.sources import DepthMap, DepthSource, Relief, Shelf, seen_by
from splatpipe.pipeline.surface.tiles import Tile

TILE = 384  # cells a side
SPREAD = 24  # cells that colours are spread to where no photo sees; further off there is none


@dataclass(frozen=True, eq=False)
class Orthophoto:
    """The orthophoto in a tile.

    Attributes:
        tile: Which.
        colour: RGB, 8 bits; black where there is none.
        photos: How many photos see each cell; 0 where colours were spread from around, or are none.
        label: Number of the photo that colours it; -1 where none sees it.
        known: Where there is a colour.
    """

    tile: Tile
    colour: UInt8[np.ndarray, "h w 3"]
    photos: UInt8[np.ndarray, "h w"]
    label: Int16[np.ndarray, "h w"]
    known: Bool[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class Album:
    """All that an orthophoto is made from.

    Attributes:
        sources: Photos, always in the same order.
        surface: Heights.
        lattice: Whose cells get colours; may be finer than the heights'.
        relief: Between which heights the surface lies.
        gains: By how much each photo's light is multiplied, a channel each.
        pixels: Holds a few photos.
        depths: Holds a few of their depths.
    """

    sources: Sequence[PhotoSource]
    surface: HeightField
    lattice: Lattice
    relief: Relief
    gains: Float64[np.ndarray, "n 3"]
    pixels: Shelf[UInt8[np.ndarray, "_ _ 3"]]
    depths: Shelf[DepthMap]


@dataclass(frozen=True, eq=False)
class _Offers:
    """What photos offer to a tile; room for so many.

    Attributes:
        seen: Where each sees the surface.
        cost: Of being coloured by it; told beside, too, for what lies around a cell counts.
        colour: Levelled; black where it does not see the surface.
    """

    seen: Bool[np.ndarray, "n h w"]
    cost: UInt16[np.ndarray, "n h w"]
    colour: UInt8[np.ndarray, "n h w 3"]

    @classmethod
    def room(cls, count: int, shape: tuple[int, ...]) -> _Offers:
        """For so many photos."""
        whole = (count, *shape)
        return cls(np.empty(whole, np.bool_), np.empty(whole, np.uint16), np.empty((*whole, 3), np.uint8))


def orthophotos(album: Album, tiles: Sequence[Tile], threads: int) -> Iterator[Orthophoto]:
    """Tiles of the orthophoto, in their order: the same bits for any number of threads, and however cells are tiled.

    Args:
        album: Photos, surface and cells.
        tiles: Which to make.
        threads: Tiles at a time.

    Raises:
        ValueError: if pixels do not fit their camera.
    """
    return ordered_map(partial(tile_orthophoto, album), tiles, threads)


def tile_orthophoto(album: Album, tile: Tile) -> Orthophoto:
    """One tile of the orthophoto."""
    wide = tile.grown(MARGIN + SPREAD)
    east, north = np.moveaxis(album.lattice.centres(wide), -1, 0)
    points = contiguous((east, north, album.surface.at(east, north)))
    windows = seen_by([source.camera for source in album.sources], album.lattice, wide, album.relief)
    offers = _Offers.room(len(windows), east.shape)
    numbers: list[int] = []
    for number, _ in windows:
        if _offer(album, number, points, offers, len(numbers)):
            numbers.append(number)
    given = slice(len(numbers))
    made = composed(offers.seen[given], offers.cost[given], offers.colour[given], (wide.row + wide.column) % 2)
    colour, known = spread(made.colour, made.label >= 0, np.isfinite(points[2]), SPREAD)
    inner = tuple(slice(MARGIN + SPREAD, MARGIN + SPREAD + size) for size in (tile.height, tile.width))
    label = np.array([*numbers, -1], np.int16)[made.label]
    return Orthophoto(tile, colour[inner], made.seen_by[inner], label[inner], known[inner])


def _offer(album: Album, number: int, points: Points, offers: _Offers, at: int) -> bool:
    """Write what a photo offers as one of the offers; False where it sees nothing."""
    source = album.sources[number]
    if source.depths is None:
        return False
    view = sight(album.depths.get(number, partial(_loaded, source.depths)), points, 0.0)
    cost, seen = rated(source.camera, points, album.lattice.cell_m, view.said)
    if not seen.any():
        return False
    pixels = album.pixels.get(number, loader(source))
    offers.seen[at], offers.cost[at] = seen, cost
    offers.colour[at] = sampled(source, pixels, points, seen, album.lattice.cell_m, tone_curve(album.gains[number]))
    return True


def _loaded(source: DepthSource) -> tuple[DepthMap, int]:
    found = source.load()
    return found, found.depth.nbytes + found.confidence.nbytes
