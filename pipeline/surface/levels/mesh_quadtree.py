"""A textured mesh in levels of detail: a quadtree in plan, whose tiles are simplified from the four below.

All leaves have the same size, and triangles are cut along their borders, everywhere. What is on a border between tiles
is never simplified, so that neighbours of any two levels meet in the same vertices: no cracks, and no skirts over them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.surface.levels.charted_mesh import ChartedMesh, cut_along
from splatpipe.pipeline.surface.levels.mesh_simplification import simplified

LEAF_TRIANGLES = 24_000  # a leaf has about this many, and a tile above it as many
LEAF_PIXELS = 1_500_000  # of a leaf's texture, about: 0.5 MB
MIN_DEPTH, MAX_DEPTH = 2, 8  # levels below the root
FEWER = 4  # a tile has this share of the triangles of the four below it


@dataclass(frozen=True)
class TileKey:
    """A tile of the quadtree.

    Attributes:
        level: 0 for the root.
        x: From the west.
        y: From the south.
    """

    level: int
    x: int
    y: int

    def children(self) -> Iterator[TileKey]:
        """Its quarters."""
        for y in (2 * self.y, 2 * self.y + 1):
            for x in (2 * self.x, 2 * self.x + 1):
                yield TileKey(self.level + 1, x, y)

    @property
    def name(self) -> str:
        """A name for files."""
        return f"{self.level}-{self.x}-{self.y}"


@dataclass(frozen=True, eq=False)
class MeshTile:
    """A tile with what it shows.

    Attributes:
        key: Its place.
        mesh: What it shows.
        error_m: Largest distance that its simplification missed, metres; 0 for leaves.
        children: The tiles below; their ``mesh`` is empty, as it has been used.
    """

    key: TileKey
    mesh: ChartedMesh
    error_m: float
    children: tuple[MeshTile, ...]


class MeshQuadtree:
    """The quadtree of a mesh.

    Args:
        mesh: The whole mesh.
        pixels: Texture pixels of the whole mesh, full size.
    """

    def __init__(self, mesh: ChartedMesh, pixels: float) -> None:
        used = mesh.vertices[np.unique(mesh.triangles)]
        low, high = used[:, :2].min(axis=0), used[:, :2].max(axis=0)
        self.depth = depth_of(len(mesh), pixels)
        count = 1 << self.depth
        self._side = float((high - low).max()) or 1.0
        self._low = low
        self.lines = [low[axis] + self._side * np.arange(1, count) / count for axis in (0, 1)]
        for axis in (0, 1):
            mesh = cut_along(mesh, axis, self.lines[axis])
        self.mesh = _without_slivers(mesh)
        self._leaves = self._leaf_rows()

    def _leaf_rows(self) -> dict[TileKey, Int64[np.ndarray, " k"]]:
        middle = self.mesh.vertices[self.mesh.triangles, :2].mean(axis=1)
        x, y = (np.searchsorted(self.lines[axis], middle[:, axis]) for axis in (0, 1))
        cell = y * (1 << self.depth) + x
        order = np.argsort(cell, kind="stable")
        cells, starts = np.unique(cell[order], return_index=True)
        rows = np.split(order, starts[1:])
        side = 1 << self.depth
        return {TileKey(self.depth, int(k) % side, int(k) // side): part for k, part in zip(cells, rows, strict=True)}

    @property
    def tile_count(self) -> int:
        """Number of tiles that show anything."""
        return len({(level, key.x >> up, key.y >> up) for key in self._leaves for level, up in self._levels()})

    def _levels(self) -> list[tuple[int, int]]:
        return [(level, self.depth - level) for level in range(self.depth + 1)]

    def build(self, visit: Callable[[MeshTile], None], key: TileKey = TileKey(0, 0, 0)) -> MeshTile | None:
        """Make the tiles of a part, children before their parent; None if it is empty.

        Args:
            visit: Called with each tile while it has its mesh.
            key: The part.
        """
        if key.level == self.depth:
            rows = self._leaves.get(key)
            if rows is None:
                return None
            tile = MeshTile(key, self.mesh.select(rows), 0.0, ())
        else:
            below = tuple(filter(None, (self.build(visit, child) for child in key.children())))
            if not below:
                return None
            whole = below[0].mesh.joined(*(each.mesh for each in below[1:]))
            mesh, missed = simplified(whole, self._on_border(key), len(whole) // FEWER)
            empty = self.mesh.select(np.zeros(0, np.int64))
            children = tuple(replace(each, mesh=empty) for each in below)
            tile = MeshTile(key, mesh, missed + max(each.error_m for each in below), children)
        visit(tile)
        return tile

    def _on_border(self, key: TileKey) -> Bool[np.ndarray, " n"]:
        """Vertices on a tile's borders, without those of the whole mesh."""
        up = self.depth - key.level
        found = np.zeros(len(self.mesh.vertices), np.bool_)
        for axis, at in ((0, key.x), (1, key.y)):
            for line in (at << up, (at + 1) << up):
                if 0 < line <= len(self.lines[axis]):
                    found |= self.mesh.vertices[:, axis] == self.lines[axis][line - 1]
        return found


def depth_of(triangles: int, pixels: float) -> int:
    """Levels below the root, so that leaves have about the intended size."""
    leaves = max(triangles / LEAF_TRIANGLES, pixels / LEAF_PIXELS, 1.0)
    return min(MAX_DEPTH, max(MIN_DEPTH, math.ceil(math.log(leaves, 4))))


def _without_slivers(mesh: ChartedMesh) -> ChartedMesh:
    """Without triangles that two corners share, which cuts next to a corner leave."""
    a, b, c = mesh.triangles.T
    return mesh.select((a != b) & (b != c) & (c != a))


def pixels_per_metre(mesh: ChartedMesh) -> tuple[float, float]:
    """Texture pixels of a mesh, and the median of pixels per metre."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    p, q = mesh.corners[:, 1] - mesh.corners[:, 0], mesh.corners[:, 2] - mesh.corners[:, 0]
    pixels = np.abs(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    known = (area > 0.0) & (pixels > 0.0)
    density = np.sqrt(pixels[known] / area[known])
    return float(pixels.sum() / 2.0), float(np.median(density)) if known.any() else 1.0


Lines = Float64[np.ndarray, " k"]
