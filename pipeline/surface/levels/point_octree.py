"""Orders a point cloud as an octree in which every point belongs to one node: coarse above, the rest below.

A node shows its cube with a point in each cell of a grid of 128 cells a side, the one nearest to the cell's centre;
the points that its parent shows are not repeated. So nodes down to any level, drawn together, are the cloud at that
level's spacing. (Levels of this kind: Schütz, "Potree: Rendering Large Point Clouds in Web Browsers", TU Wien 2016;
here they are filled from below, so that only a part of the plan is in memory.)

Cubes and cells have whole numbers of the file's steps as borders, so that no rounding moves a point to a neighbour.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Int64

CELLS = 128  # cells of a node's grid, per side
MAX_LEVEL = 16  # of a node: in a cloud that is 1 km across with steps of a millimetre it has a side of 15 mm
MAX_LEAF_POINTS = 65_536  # a node with more is divided: some 400 kB in a file, a good size for a request
COUNTED_LEVEL = 7  # of the cubes in which points are counted before they are distributed
MAX_PILE_POINTS = 1 << 20  # points that are in memory at a time, 40 bytes each and as much for sorting them
Records = np.ndarray
"""Points as LAS stores them: a structured array with the fields X, Y and Z in steps."""


@dataclass(frozen=True, order=True)
class NodeKey:
    """A cube of the octree.

    Attributes:
        level: 0 for the root.
        x: Its place among the cubes of its level, from the west.
        y: From the south.
        z: From below.
    """

    level: int
    x: int
    y: int
    z: int

    def child(self, octant: int) -> NodeKey:
        """One of its eighths, 0 to 7; the lowest bit is x."""
        return NodeKey(
            self.level + 1, 2 * self.x + (octant & 1), 2 * self.y + (octant >> 1 & 1), 2 * self.z + (octant >> 2)
        )


ROOT = NodeKey(0, 0, 0, 0)


@dataclass(frozen=True, eq=False)
class Cube:
    """The root's cube.

    Attributes:
        lowest: Its lowest corner, steps.
        side: Its side, steps: a multiple of 2 to the power of ``deepest``.
        deepest: The level at which cubes still have whole sides.
    """

    lowest: Int64[np.ndarray, " 3"]
    side: int
    deepest: int

    @staticmethod
    def around(lowest: Int64[np.ndarray, " 3"], highest: Int64[np.ndarray, " 3"]) -> Cube:
        """The cube of points between two corners, steps."""
        extent = int((highest - lowest).max()) + 1
        deepest = min(MAX_LEVEL, max(0, extent.bit_length() - CELLS.bit_length()))
        return Cube(lowest, -(-extent // (1 << deepest)) << deepest, deepest)

    def cubes(self, records: Records, level: int) -> Int64[np.ndarray, "n 3"]:
        """The cube of a level that each point lies in."""
        return self._divided(records, 1 << level)

    def cells(self, records: Records, level: int) -> Int64[np.ndarray, "n 3"]:
        """The cell of the grid of a level's nodes that each point lies in, counted through all nodes."""
        return self._divided(records, CELLS << level)

    def from_centre(self, records: Records, level: int) -> Int64[np.ndarray, " n"]:
        """Squared distance of each point from the centre of its cell, in small whole units."""
        doubled = 2 * (self._from_corner(records) * (CELLS << level) % self.side) - self.side
        scaled = doubled // max(1, self.side >> 20)  # squares of 21 bits, three of which fit
        return np.asarray((scaled**2).sum(axis=1))

    def _divided(self, records: Records, parts: int) -> Int64[np.ndarray, "n 3"]:
        return np.asarray(self._from_corner(records) * parts // self.side)

    def _from_corner(self, records: Records) -> Int64[np.ndarray, "n 3"]:
        return np.asarray(np.stack([records[name].astype(np.int64) for name in "XYZ"], axis=1) - self.lowest)


class Piles:
    """Points distributed to cubes of limited content, each in a file.

    Args:
        cube: The root's cube.
        counts: Of all points.
        folder: For the files.
    """

    def __init__(self, cube: Cube, counts: PointCounts, folder: Path) -> None:
        self._cube, self._counts, self._folder = cube, counts, folder
        self._keys = tuple(counts.piles())
        self._pile_of = np.full(counts.counts.shape, -1, np.int32)
        for number, key in enumerate(self._keys):
            self._pile_of[counts.part(key)] = number

    def add(self, records: Records) -> None:
        """Append points to their piles."""
        pile = self._pile_of[tuple(self._cube.cubes(records, self._counts.level).T)]
        order = np.argsort(pile, kind="stable")
        numbers, starts = np.unique(pile[order], return_index=True)
        for number, rows in zip(numbers, np.split(order, starts[1:]), strict=True):
            with (self._folder / f"{number}.points").open("ab") as file:
                file.write(records[rows].tobytes())

    def take(self, key: NodeKey, kind: np.dtype) -> Records | None:
        """The points of a cube that is a pile, in the order in which they came; None if it is none. Its file goes.

        Args:
            key: The cube.
            kind: Type of the records.
        """
        if key not in self._numbers:
            return None
        path = self._folder / f"{self._numbers[key]}.points"
        records = np.fromfile(path, kind)
        path.unlink()
        return records

    @cached_property
    def _numbers(self) -> dict[NodeKey, int]:
        return {key: number for number, key in enumerate(self._keys)}


class PointCounts:
    """Number of points in each cube of a level.

    Args:
        cube: The root's cube.
    """

    def __init__(self, cube: Cube) -> None:
        self.level = min(COUNTED_LEVEL, cube.deepest)
        self.counts = np.zeros((1 << self.level,) * 3, np.int64)
        self._cube = cube

    def add(self, records: Records) -> None:
        """Count points."""
        np.add.at(self.counts, tuple(self._cube.cubes(records, self.level).T), 1)

    def part(self, key: NodeKey) -> tuple[slice, slice, slice]:
        """The part of the counts that a cube covers."""
        side = 1 << self.level - key.level
        x, y, z = (slice(at * side, (at + 1) * side) for at in (key.x, key.y, key.z))
        return x, y, z

    def has(self, key: NodeKey) -> bool:
        """Whether there are points in a cube of this level or above."""
        return bool(self.counts[self.part(key)].any())

    def piles(self, key: NodeKey = ROOT) -> Iterator[NodeKey]:
        """The largest cubes with at most ``MAX_PILE_POINTS`` points, depth first."""
        count = int(self.counts[self.part(key)].sum())
        if count and (count <= MAX_PILE_POINTS or key.level == self.level):
            yield key
        elif count:
            for octant in range(8):
                yield from self.piles(key.child(octant))


class PointOctree:
    """The nodes of a cloud, from the leaves to the root.

    Args:
        cube: The root's cube.
        counts: Of all points.
        piles: The points.
        kind: Type of their records.
    """

    def __init__(self, cube: Cube, counts: PointCounts, piles: Piles, kind: np.dtype) -> None:
        self._cube, self._counts, self._piles, self._kind = cube, counts, piles, kind

    def nodes(self) -> Iterator[tuple[NodeKey, Records]]:
        """Yield every node with its points; children before their parent, which is empty if they are few."""
        if self._counts.counts.any():
            yield from self._upper(ROOT, [])

    def _upper(self, key: NodeKey, shown: list[Records]) -> Iterator[tuple[NodeKey, Records]]:
        """The nodes of a cube; what its parent shows of it is appended to ``shown``."""
        pile = self._piles.take(key, self._kind)
        if pile is not None:
            yield from self._lower(key, pile, shown)
            return
        mine: list[Records] = []
        for octant in range(8):
            child = key.child(octant)
            if self._counts.has(child):
                yield from self._upper(child, mine)
        yield self._without_shown(key, np.concatenate(mine), shown)

    def _lower(self, key: NodeKey, records: Records, shown: list[Records]) -> Iterator[tuple[NodeKey, Records]]:
        """The same for a cube whose points are in memory."""
        if len(records) > MAX_LEAF_POINTS and key.level < self._cube.deepest:
            mine: list[Records] = []
            below = self._cube.cubes(records, key.level + 1) & 1
            octants = below @ np.array([1, 2, 4])
            for octant in np.unique(octants).tolist():
                yield from self._lower(key.child(octant), records[octants == octant], mine)
            records = np.concatenate(mine)
        yield self._without_shown(key, records, shown)

    def _without_shown(self, key: NodeKey, records: Records, shown: list[Records]) -> tuple[NodeKey, Records]:
        if key.level == 0:
            return key, records
        chosen = nearest_to_centres(self._cube, records, key.level - 1)
        shown.append(records[chosen])
        rest = np.ones(len(records), np.bool_)
        rest[chosen] = False
        return key, records[rest]


def nearest_to_centres(cube: Cube, records: Records, level: int) -> Int64[np.ndarray, " k"]:
    """Rows of the points nearest to the centres of the cells of a level's nodes, in order; the first of equal ones.

    Args:
        cube: The root's cube.
        records: Points of one node.
        level: Level of the nodes whose cells they are.
    """
    cells = cube.cells(records, level)
    cells -= cells.min(axis=0)
    x, y, _ = (int(size) + 1 for size in cells.max(axis=0))
    number = (cells[:, 2] * y + cells[:, 1]) * x + cells[:, 0]
    order = np.lexsort((np.arange(len(records)), cube.from_centre(records, level), number))
    first = np.ones(len(order), np.bool_)
    first[1:] = number[order][1:] != number[order][:-1]
    return np.sort(order[first])


def lowest_and_highest(chunks: Iterator[Records]) -> tuple[Int64[np.ndarray, " 3"], Int64[np.ndarray, " 3"]]:
    """The corners of the box of all points, steps; the lowest above the highest if there are none."""
    lowest, highest = np.full(3, np.iinfo(np.int64).max), np.full(3, np.iinfo(np.int64).min)
    for records in chunks:
        for axis, name in enumerate("XYZ"):
            lowest[axis] = min(lowest[axis], int(records[name].min()))
            highest[axis] = max(highest[axis], int(records[name].max()))
    return lowest, highest


def keys_above(keys: Sequence[NodeKey]) -> list[NodeKey]:
    """All cubes on the ways from the root to some, sorted."""
    found = set(keys)
    for key in keys:
        for level in range(key.level):
            up = key.level - level
            found.add(NodeKey(level, key.x >> up, key.y >> up, key.z >> up))
    return sorted(found)
