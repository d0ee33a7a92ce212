"""Photos and their depths as the surface asks for them: loaded when a tile needs them, a few at a time."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.lattice import Lattice
from splatpipe.pipeline.surface.tiles import Tile

Loaded = TypeVar("Loaded")

LEAST_CONFIRMED = 2  # other photos that confirm a depth that clouds, meshes, walls and sections are made from
REACH_PX = 4  # pixels around a tile in a photo: more than slopes and filters look at


@runtime_checkable
class PosedDepthMap(Protocol):
    """Depths of a photo: what `mvs` makes.

    Attributes:
        camera: In the map's grid, local metres.
        depth: Along the view axis, metres; 0 where none is known.
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
    """A ``PosedDepthMap`` in local metres, or in those of a sheet that things are drawn on."""

    camera: Camera
    depth: Float32[np.ndarray, "h w"]
    confidence: UInt8[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class DepthSource:
    """Where a photo's depths come from.

    Attributes:
        camera: Of the map, so that it is loaded only where it can see something.
        load: Reads it; called from several threads.
    """

    camera: Camera
    load: Callable[[], PosedDepthMap]

    def loaded(self) -> tuple[PosedDepthMap, int]:
        """The map and its size in memory, as a shelf wants it.

        Raises:
            ValueError: if it is not of its camera's size.
        """
        found = self.load()
        shape = (found.camera.height, found.camera.width)
        if found.depth.shape != shape or found.confidence.shape != shape:
            raise ValueError(f"{found.camera.name}: depths of {found.depth.shape} for a camera of {shape}")
        return found, found.depth.nbytes + found.confidence.nbytes


class LruCache(Generic[Loaded]):
    """What was loaded last, up to so many bytes; the last one stays, however large it is.

    Args:
        limit_bytes: Of all that is held.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._held: OrderedDict[Hashable, tuple[Loaded, int]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def get(self, key: Hashable, load: Callable[[], tuple[Loaded, int]]) -> Loaded:
        """What was loaded under this key, or what ``load`` returns with its size in bytes.

        Args:
            key: Names it.
            load: May run twice at once where two threads ask; both get the same.
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
    """Between which heights the ground and all on it lie; what is outside counts as noise.

    Attributes:
        low_m: Local metres.
        high_m: Local metres.
    """

    low_m: float
    high_m: float

    def __post_init__(self) -> None:
        if not self.low_m < self.high_m:
            raise ValueError(f"heights from {self.low_m} to {self.high_m} m")


@dataclass(frozen=True)
class PhotoWindow:
    """The part of a photo that a tile can lie in.

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
    """Where in a photo the cells of a tile may lie, whatever their heights; None where it cannot see them."""
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
    """Of the box that the tile's cells lie in, and one more around."""
    columns = tile.column - 1, tile.column + tile.width + 1
    rows = tile.row - 1, tile.row + tile.height + 1
    easts = [lattice.east_m + column * lattice.cell_m for column in columns]
    norths = [lattice.north_m - row * lattice.cell_m for row in rows]
    return np.array([[e, n, up] for up in (relief.low_m, relief.high_m) for n in norths for e in easts])


def photos_seeing(
    cameras: Sequence[Camera], lattice: Lattice, tile: Tile, relief: HeightRange
) -> list[tuple[int, PhotoWindow]]:
    """Numbers of the photos that may see a tile, and where in them it lies."""
    windows = ((number, window_of(camera, lattice, tile, relief)) for number, camera in enumerate(cameras))
    return [(number, window) for number, window in windows if window is not None]
