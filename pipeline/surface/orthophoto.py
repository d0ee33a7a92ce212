"""The true orthophoto: every cell coloured by the best photo that sees the topmost surface there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int16, Int32, UInt8

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.height_field import HeightField
from splatpipe.pipeline.surface.lattice import Lattice
from splatpipe.pipeline.surface.mosaic import (
    HIDDEN,
    MARGIN,
    blended,
    labels,
    likeness_cost,
    parity_of,
    scaled_cost,
    spread,
)
from splatpipe.pipeline.surface.photo_samples import PhotoSource, halvings, loader, sampled, tone_curve
from splatpipe.pipeline.surface.sight import LEAST_SINE, Place, Sight, place_in, sight
from splatpipe.pipeline.surface.sources import DepthMap, DepthSource, Relief, Shelf, seen_by
from splatpipe.pipeline.surface.tiles import Tile

TILE = 384  # cells a side
SPREAD = 24  # cells that colours are spread to where no photo sees; further off there is none
LEANING = 1.0  # cost of a ray along the ground, against one straight down
COARSE = 0.5  # cost of a photo half as fine as the cells
RIM = 0.06  # of a photo's width: nearer to its edge it costs more, for lenses are worst there,
RIM_COST = 0.5  # up to so much
MIXED = 0.6  # cost where a nearer surface lies in the next pixel of the depths: colours may be mixed
UNKNOWN = 0.3  # cost around a cell where the photo has no depth: it colours others beside it none the less


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
class _Offer:
    """What one photo offers to a tile.

    Attributes:
        number: The photo's.
        seen: Where it sees the surface.
        cost: Of being coloured by it; told beside, too, for what lies around a cell counts.
        colour: Levelled; black where it does not see the surface.
    """

    number: int
    seen: Bool[np.ndarray, "h w"]
    cost: Int32[np.ndarray, "h w"]
    colour: UInt8[np.ndarray, "h w 3"]


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
    up = album.surface.at(east, north)
    windows = seen_by([source.camera for source in album.sources], album.lattice, wide, album.relief)
    offers = [_offer(album, number, (east, north, up)) for number, _ in windows]
    given = [offer for offer in offers if offer is not None]
    label, colour, photos = _composed(given, parity_of(wide.row, wide.column), up.shape)
    colour, known = spread(colour, label >= 0, np.isfinite(up), SPREAD)
    inner = tuple(slice(MARGIN + SPREAD, MARGIN + SPREAD + size) for size in (tile.height, tile.width))
    numbers = np.array([offer.number for offer in given] + [-1], np.int16)
    return Orthophoto(tile, colour[inner], photos[inner], numbers[label][inner], known[inner])


def _composed(
    given: Sequence[_Offer], parity: int, shape: tuple[int, ...]
) -> tuple[np.ndarray, UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    if not given:
        return np.full(shape, -1), np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.uint8)
    seen = np.stack([offer.seen for offer in given])
    cost = np.stack([offer.cost for offer in given])
    colour = np.stack([offer.colour for offer in given])
    grey = np.stack([np.asarray(cv2.cvtColor(part, cv2.COLOR_RGB2GRAY), np.uint8) for part in colour])
    cost += likeness_cost(grey, cost, seen)
    label = labels(cost, seen, grey, parity)
    photos = np.minimum(seen.sum(axis=0), np.iinfo(np.uint8).max).astype(np.uint8)
    return label, blended(label, colour, seen), photos


def view_of(
    source: DepthSource, shelf: Shelf[DepthMap], number: int, points: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> Sight:
    """What a photo says about places by its own depths.

    Args:
        source: The photo's depths.
        shelf: Where they may be held.
        number: The photo's.
        points: East, north, up.
    """
    found = shelf.get(number, partial(_loaded, source))
    return sight(found, place_in(found.camera, *points), 0.0)


def _loaded(source: DepthSource) -> tuple[DepthMap, int]:
    found = source.load()
    return found, found.depth.nbytes + found.confidence.nbytes


def _offer(album: Album, number: int, points: tuple[np.ndarray, np.ndarray, np.ndarray]) -> _Offer | None:
    source = album.sources[number]
    if source.depths is None:
        return None
    place = place_in(source.camera, *points)
    view = view_of(source.depths, album.depths, number, points)
    seen = view.seen & place.inside
    if not seen.any():
        return None
    cost = _cost(source.camera, place, album.lattice.cell_m) + scaled_cost(MIXED * view.mixed + UNKNOWN * view.unknown)
    cost = np.where(seen | (view.unknown & place.inside), cost, np.int32(HIDDEN))
    pixels = album.pixels.get(number, loader(source))
    place = replace(place, inside=seen)
    level = halvings(source.camera, place, album.lattice.cell_m)
    return _Offer(number, seen, cost, sampled(pixels, source.in_photo(place), level, tone_curve(album.gains[number])))


def _cost(camera: Camera, place: Place, cell_m: float) -> Int32[np.ndarray, "h w"]:
    """What it costs to colour cells by a photo: it leans, is coarse, or they lie near its edge."""
    sine = np.maximum(place.sine, LEAST_SINE)
    pixel = np.where(place.inside, place.depth, 0.0) / max(camera.fx, camera.fy) / sine
    edge = np.minimum(
        np.minimum(place.column, camera.width - place.column), np.minimum(place.row, camera.height - place.row)
    )
    rim = np.clip(1.0 - edge / (RIM * camera.width), 0.0, 1.0)
    total = (
        LEANING * np.sqrt(1.0 - np.square(np.minimum(sine, 1.0)))
        + COARSE * np.clip(pixel / cell_m - 1.0, 0.0, 4.0)
        + RIM_COST * rim
    )
    return scaled_cost(np.where(place.inside, total, 0.0))
