"""Access to photos and their depths for surface products: loaded when a tile needs them, a few at a time."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile

Loaded = TypeVar("Loaded")

MIN_CONFIRMED = 2  # other photos that have to confirm a depth used for clouds, meshes, walls and sections
REACH_PX = 4  # pixels around a tile in a photo: more than slopes and filters need


@runtime_checkable
class PosedDepthMap(Protocol):
    """Depth map of a photo, as produced by `mvs`.

    Attributes:
        camera: The camera at the map's resolution, local metres.
        depth: Depth along the optical axis, metres; 0 where unknown.
        confidence: How many other photos confirm it.
    """

    @property
    def camera(self) -> Camera: ...
    @property
    def depth(self) -> Float32[np.ndarray, "h w"]: ...
    @property
    def confidence(self) -> UInt8[np.ndarray, "h w"]: ...


@dataclass(frozen=True, eq=False)
class MetricMap:
    """A ``PosedDepthMap`` in local metres or in a plane's frame."""

    camera: Camera
    depth: Float32[np.ndarray, "h w"]
    confidence: UInt8[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class DepthSource:
    """Source of a photo's depths.

    Attributes:
        camera: The map's camera, so that the map is only loaded where it can see something.
        load: Reads the map; called from several threads.
    """

    camera: Camera
    load: Callable[[], PosedDepthMap]

    def load_sized(self) -> tuple[PosedDepthMap, int]:
        """Load the map; returns it with its size in bytes, as ``LruCache`` needs.

        Raises:
            ValueError: if its size differs from its camera's.
        """
        found = self.load()
        shape = (found.camera.height, found.camera.width)
        if found.depth.shape != shape or found.confidence.shape != shape:
            raise ValueError(f"{found.camera.name}: depths of {found.depth.shape} for a camera of {shape}")
        return found, found.depth.nbytes + found.confidence.nbytes


class LruCache(Generic[Loaded]):
    """Least-recently-used cache limited in bytes; the last item stays, however large it is.

    Args:
        limit_bytes: Limit on the size of all items.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._held: OrderedDict[Hashable, tuple[Loaded, int]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def get(self, key: Hashable, load: Callable[[], tuple[Loaded, int]]) -> Loaded:
        """Return the cached item, or load it.

        Args:
            key: Key of the item.
            load: Returns the item and its size in bytes; may run twice at once if two threads request it, and both get
                the same item.
        """
        with self._lock:
            if key in self._held:
                self._held.move_to_end(key)
                return self._held[key][0]
        loaded, size = load()
        with self._lock:
            if key not in self._held:
                self._held[key] = (loaded, size)
                self._bytes += size
            while self._bytes > self._limit and len(self._held) > 1:
                self._bytes -= self._held.popitem(last=False)[1][1]
        return loaded


@dataclass(frozen=True)
class HeightRange:
    """Height range of the ground and everything on it; anything outside counts as noise.

    Attributes:
        low_m: Lowest height, local metres.
        high_m: Highest height, local metres.
    """

    low_m: float
    high_m: float

    def __post_init__(self) -> None:
        if not self.low_m < self.high_m:
            raise ValueError(f"heights from {self.low_m} to {self.high_m} m")


@dataclass(frozen=True)
class PhotoWindow:
    """The part of a photo that may show a tile, pixels.

    Attributes:
        left: First column.
        top: First row.
        right: Column after the last.
        bottom: Row after the last.
    """

    left: int
    top: int
    right: int
    bottom: int


def window_of(camera: Camera, lattice: Lattice, tile: Tile, relief: HeightRange) -> PhotoWindow | None:
    """The window of a photo that may show a tile's cells at any height in range; None if it cannot see them."""
    corners = _corners(lattice, tile, relief)
    rays = corners @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    if (rays[:, 2] <= 0.0).all():
        return None
    x = rays[:, 0] * camera.fx + rays[:, 2] * camera.cx
    y = rays[:, 1] * camera.fy + rays[:, 2] * camera.cy
    sides = (x, rays[:, 2] * camera.width - x, y, rays[:, 2] * camera.height - y)
    if any((side < 0.0).all() for side in sides):
        return None
    if (rays[:, 2] <= 0.0).any():
        return PhotoWindow(0, 0, camera.width, camera.height)
    x, y = x / rays[:, 2], y / rays[:, 2]
    low = np.floor([x.min(), y.min()]).astype(int) - REACH_PX
    high = np.ceil([x.max(), y.max()]).astype(int) + REACH_PX
    left, top = np.maximum(low, 0)
    right, bottom = np.minimum(high, [camera.width, camera.height])
    return PhotoWindow(int(left), int(top), int(right), int(bottom)) if left < right and top < bottom else None


def _corners(lattice: Lattice, tile: Tile, relief: HeightRange) -> Float64[np.ndarray, "8 3"]:
    """Corners of the box around a tile's cells and a margin of one cell."""
    columns = tile.column - 1, tile.column + tile.width + 1
    rows = tile.row - 1, tile.row + tile.height + 1
    easts = [lattice.east_m + column * lattice.cell_m for column in columns]
    norths = [lattice.north_m - row * lattice.cell_m for row in rows]
    return np.array([[e, n, up] for up in (relief.low_m, relief.high_m) for n in norths for e in easts])


def photos_seeing(
    cameras: Sequence[Camera], lattice: Lattice, tile: Tile, relief: HeightRange
) -> list[tuple[int, PhotoWindow]]:
    """Indices of the photos that may see a tile, and the tile's windows in them."""
    windows = ((number, window_of(camera, lattice, tile, relief)) for number, camera in enumerate(cameras))
    return [(number, window) for number, window in windows if window is not None]
