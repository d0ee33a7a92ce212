"""Photos with their depths, as clouds and meshes ask them: which of them see a place, and how finely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.lattice import Lattice
from splatpipe.pipeline.surface.photo_samples import PhotoSource
from splatpipe.pipeline.surface.sight import Place, Sight, place_in, sight
from splatpipe.pipeline.surface.sources import DepthMap, DepthSource, PhotoWindow, Relief, Shelf, window_of
from splatpipe.pipeline.surface.tiles import Tile

LEAST_COSINE = 0.1  # of a ray and a surface's normal: flatter rays count as this one


@dataclass(frozen=True, eq=False)
class PhotoSet:
    """All that clouds and meshes are made from.

    Attributes:
        sources: Photos, always in the same order.
        gains: By how much each photo's light is multiplied, a channel each.
        depths: Holds a few of their depths.
    """

    sources: Sequence[PhotoSource]
    gains: Float64[np.ndarray, "n 3"]
    depths: Shelf[DepthMap]

    def with_depths(self) -> list[int]:
        """Numbers of the photos that have depths: the others say nothing of the surface."""
        return [number for number, source in enumerate(self.sources) if source.depths is not None]

    def depth_map(self, number: int) -> DepthMap:
        """A photo's depths, loaded if they are not at hand.

        Raises:
            ValueError: if they do not fit their camera.
        """
        source = self.sources[number].depths
        assert source is not None
        return self.depths.get(number, partial(_loaded, source))

    def parts_in(self, lattice: Lattice, tile: Tile, relief: Relief) -> list[DepthPart]:
        """The parts of all photos' depths that may lie in a tile, each photo loaded once."""
        found = []
        for number in self.with_depths():
            source = self.sources[number].depths
            assert source is not None
            window = window_of(source.camera, lattice, tile, relief)
            if window is not None:
                found.append(_part(number, self.depth_map(number), window))
        return found


def _loaded(source: DepthSource) -> tuple[DepthMap, int]:
    found = source.load()
    shape = (found.camera.height, found.camera.width)
    if found.depth.shape != shape or found.confidence.shape != shape:
        raise ValueError(f"{found.camera.name}: depths of {found.depth.shape} for a camera of {shape}")
    return found, found.depth.nbytes + found.confidence.nbytes


@dataclass(frozen=True, eq=False)
class DepthPart:
    """A rectangle of a photo's depths, a map of its own.

    Attributes:
        number: The photo's.
        camera: Of the part.
        depth: As in the whole map; a copy, so that the whole one need not stay.
        confidence: Likewise.
    """

    number: int
    camera: Camera
    depth: Float32[np.ndarray, "h w"]
    confidence: UInt8[np.ndarray, "h w"]


def _part(number: int, found: DepthMap, window: PhotoWindow) -> DepthPart:
    cut = np.s_[window.top : window.bottom, window.left : window.right]
    camera = found.camera.cut(window.left, window.top, window.right - window.left, window.bottom - window.top)
    return DepthPart(number, camera, found.depth[cut].copy(), found.confidence[cut].copy())


@dataclass(frozen=True, eq=False)
class Facing:
    """Small pieces of a surface.

    Attributes:
        xyz: East, north, up, metres: (3, n), a row an axis.
        normal: Of unit length, likewise.
    """

    xyz: Float64[np.ndarray, "3 n"]
    normal: Float64[np.ndarray, "3 n"]

    def select(self, rows: np.ndarray | slice) -> Facing:
        """Those of them."""
        return Facing(self.xyz[:, rows], self.normal[:, rows])


@dataclass(frozen=True, eq=False)
class Look:
    """How a camera looks at pieces of a surface.

    Attributes:
        pieces: They.
        place: Where they lie in it; ``sine`` is of the ray's angle against the surface.
        footprint: How long a pixel is on the surface, metres; infinite where it sees them from behind or not at all.
    """

    pieces: Facing
    place: Place
    footprint: Float64[np.ndarray, " n"]

    def select(self, rows: Bool[np.ndarray, " n"]) -> Look:
        """Those of them."""
        place = self.place
        parts = (place.column[rows], place.row[rows], place.depth[rows], place.sine[rows], place.inside[rows])
        return Look(self.pieces.select(rows), Place(*parts), self.footprint[rows])

    def sight(self, found: DepthMap) -> Sight:
        """What the photo's depths say, in whose grid the look is."""
        east, north, up = self.pieces.xyz
        return sight(found, (east, north, up), 0.0, np.ascontiguousarray(self.place.sine))


def look_at(camera: Camera, pieces: Facing) -> Look:
    """Where pieces of a surface lie in a camera's picture, and how finely it sees them, each by itself."""
    place = place_in(camera, *pieces.xyz)
    towards = camera.centre()[:, None] - pieces.xyz
    away = np.sqrt(np.square(towards[0]) + np.square(towards[1]) + np.square(towards[2]))
    cosine = dot(towards, pieces.normal) / np.maximum(away, 1e-9)
    seen = place.inside & (cosine > 0.0)
    pixel = place.depth / max(camera.fx, camera.fy) / np.maximum(cosine, LEAST_COSINE)
    return Look(pieces, replace(place, sine=cosine), np.where(seen, pixel, np.inf))


def dot(a: Float64[np.ndarray, "3 n"], b: Float64[np.ndarray, "3 n"]) -> Float64[np.ndarray, " n"]:
    """Of vectors, each by itself."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
