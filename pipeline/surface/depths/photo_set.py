"""Photos with their depths, for clouds and meshes: which of them see a place, and at what resolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.depths.photo_gains import PhotoGains
from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource
from splatpipe.pipeline.surface.depths.point_visibility import (
    PhotoCoordinates,
    PointVisibility,
    classify_points,
    project_points,
)
from splatpipe.pipeline.surface.depths.sources import HeightRange, LruCache, PhotoWindow, PosedDepthMap, window_of
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile

SAMPLE_STEP = 4  # pixels, per axis, in the search for a tile's height range
LAYER_M = 1.0  # thickness of a layer of heights, and the margin of the range
MIN_PHOTOS = 2  # that have to see something in a layer
MIN_COSINE = 0.1  # lower limit for the cosine between a ray and the surface's normal, for flatter rays


@dataclass(frozen=True, eq=False)
class PhotoSet:
    """Inputs of clouds and meshes.

    Attributes:
        sources: Photos, always in the same order.
        levels: Exposure gains of the photos.
        depths: Cache of a few of their depth maps.
    """

    sources: Sequence[PhotoSource]
    levels: PhotoGains
    depths: LruCache[PosedDepthMap]

    def with_depths(self) -> list[int]:
        """Indices of the photos with depths; the others do not contribute to the surface."""
        return [number for number, source in enumerate(self.sources) if source.depths is not None]

    def depth_map(self, number: int) -> PosedDepthMap:
        """A photo's depths, loaded if they are not cached.

        Raises:
            ValueError: if they do not fit their camera.
        """
        source = self.sources[number].depths
        assert source is not None
        return self.depths.get(number, source.load_sized)

    def parts_in(self, lattice: Lattice, tile: Tile, relief: HeightRange) -> list[DepthPart]:
        """The parts of all photos' depths that may lie in a tile, within the tile's own height range.

        With the whole site's height range, a tile in the hills would cover most of each photo.
        """
        numbers = self._seeing(lattice, tile, relief)
        narrow = self._heights_in(numbers, lattice, tile, relief)
        found = []
        for number in reversed(numbers) if narrow is not None else ():  # the last ones are still cached
            whole = self.depth_map(number)
            window = window_of(whole.camera, lattice, tile, narrow or relief)
            if window is not None:
                found.append(_part(number, whole, window))
        return found[::-1]

    def _seeing(self, lattice: Lattice, tile: Tile, relief: HeightRange) -> list[int]:
        cameras = [(number, source.depths.camera) for number, source in enumerate(self.sources) if source.depths]
        return [number for number, camera in cameras if window_of(camera, lattice, tile, relief) is not None]

    def _heights_in(
        self, numbers: Sequence[int], lattice: Lattice, tile: Tile, relief: HeightRange
    ) -> HeightRange | None:
        """Range of heights at which at least two photos see something in a tile; None if there are none."""
        photos = np.zeros(int((relief.high_m - relief.low_m) / LAYER_M) + 1, np.int64)
        for number in numbers:
            found = self.depth_map(number)
            window = window_of(found.camera, lattice, tile, relief)
            assert window is not None
            east, north, up = _sample_positions(found, window)
            inside = (lattice.cells(tile, east, north) >= 0) & (up >= relief.low_m) & (up < relief.high_m)
            photos[np.unique(((up[inside] - relief.low_m) / LAYER_M).astype(np.int64))] += 1
        layers = np.flatnonzero(photos >= MIN_PHOTOS)
        if not layers.size:
            return None
        low, high = (relief.low_m + LAYER_M * float(edge) for edge in (layers[0] - 1, layers[-1] + 2))
        return HeightRange(max(low, relief.low_m), min(high, relief.high_m))


def _sample_positions(found: PosedDepthMap, window: PhotoWindow) -> Float64[np.ndarray, "3 n"]:
    """East, north, up of evenly sampled depths in a window."""
    row, column = (
        grid.ravel()
        for grid in np.mgrid[window.top : window.bottom : SAMPLE_STEP, window.left : window.right : SAMPLE_STEP]
    )
    depth = found.depth[row, column].astype(np.float64)
    row, column, depth = (each[depth > 0.0] for each in (row, column, depth))
    return unproject_pixels(found.camera, row, column, 1.0 / depth)


def unproject_pixels(
    camera: Camera, row: Int64[np.ndarray, " n"], column: Int64[np.ndarray, " n"], inverse: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "3 n"]:
    """East, north, up of pixel centres at inverse depths, each computed independently."""
    x, y = (column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy
    ray = rotate(camera.cam_from_world[:3, :3].T, x, y)
    centre = camera.centre()
    return np.stack([centre[axis] + ray[axis] / inverse for axis in range(3)])


def rotate(
    turn: Float64[np.ndarray, "3 3"],
    x: Float64[np.ndarray, " n"],
    y: Float64[np.ndarray, " n"],
    z: Float64[np.ndarray, " n"] | float = 1.0,
) -> list[Float64[np.ndarray, " n"]]:
    """A matrix times vectors, each computed independently: a library's product would depend on their number."""
    return [turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z for i in range(3)]


@dataclass(frozen=True, eq=False)
class DepthPart:
    """A crop of a photo's depth map.

    Attributes:
        number: Index of the photo.
        camera: Camera of the crop.
        depth: As in the full map; a copy, so that the full one can be freed.
        confidence: As in the full map, likewise a copy.
    """

    number: int
    camera: Camera
    depth: Float32[np.ndarray, "h w"]
    confidence: UInt8[np.ndarray, "h w"]


def _part(number: int, found: PosedDepthMap, window: PhotoWindow) -> DepthPart:
    cut = np.s_[window.top : window.bottom, window.left : window.right]
    camera = found.camera.crop(window.left, window.top, window.right - window.left, window.bottom - window.top)
    return DepthPart(number, camera, found.depth[cut].copy(), found.confidence[cut].copy())


@dataclass(frozen=True, eq=False)
class SurfacePieces:
    """Small pieces of a surface.

    Attributes:
        xyz: East, north, up, metres: (3, n), one row per axis.
        normal: Unit normals, likewise.
    """

    xyz: Float64[np.ndarray, "3 n"]
    normal: Float64[np.ndarray, "3 n"]

    def select(self, rows: np.ndarray | slice) -> SurfacePieces:
        """The pieces of these rows."""
        return SurfacePieces(self.xyz[:, rows], self.normal[:, rows])


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """Surface pieces as seen by a camera.

    Attributes:
        pieces: The pieces.
        place: Their image coordinates; ``sine`` is of the ray's angle to the surface.
        footprint: Size of a pixel on the surface, metres; infinite where the camera sees them from behind or not at
            all.
    """

    pieces: SurfacePieces
    place: PhotoCoordinates
    footprint: Float64[np.ndarray, " n"]

    def classify(self, found: PosedDepthMap, rows: np.ndarray | slice) -> PointVisibility:
        """Visibility of some of the pieces according to the photo's depths, which must have this view's grid."""
        east, north, up = self.pieces.xyz[:, rows]
        return classify_points(found, (east, north, up), 0.0, np.ascontiguousarray(self.place.sine[rows]))


def view_pieces(camera: Camera, pieces: SurfacePieces) -> SurfaceView:
    """Project surface pieces into a camera, with their footprints; each computed independently."""
    place = project_points(camera, *pieces.xyz)
    towards = camera.centre()[:, None] - pieces.xyz
    away = np.sqrt(np.square(towards[0]) + np.square(towards[1]) + np.square(towards[2]))
    cosine = dot(towards, pieces.normal) / np.maximum(away, 1e-9)
    seen = place.inside & (cosine > 0.0)
    pixel = place.depth / max(camera.fx, camera.fy) / np.maximum(cosine, MIN_COSINE)
    return SurfaceView(pieces, replace(place, sine=cosine), np.where(seen, pixel, np.inf))


def dot(a: Float64[np.ndarray, "3 n"], b: Float64[np.ndarray, "3 n"]) -> Float64[np.ndarray, " n"]:
    """Dot products of vectors, each computed independently."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
