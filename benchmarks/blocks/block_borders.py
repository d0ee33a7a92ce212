"""Lines of the ground plan where two blocks meet."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.geometry.ground_plan import PlanPoints
from splatpipe.pipeline.train.blocks.cells.partition import Partition


@dataclass(frozen=True)
class PlanLine:
    """A line segment in plan, which stands for the vertical plane through it.

    Attributes:
        start: Plan coordinates.
        end: Plan coordinates, different from the start.
    """

    start: tuple[float, float]
    end: tuple[float, float]

    @property
    def length(self) -> float:
        """Length in plan units."""
        return math.dist(self.start, self.end)

    @property
    def direction(self) -> Float64[np.ndarray, " 2"]:
        """Unit vector from start to end."""
        return (np.array(self.end) - self.start) / self.length

    def along(self, places: PlanPoints) -> Float64[np.ndarray, " n"]:
        """Distance of each place along the line: 0 at the start, its length at the end."""
        return np.asarray((places - self.start) @ self.direction)

    def beside(self, places: PlanPoints) -> Float64[np.ndarray, " n"]:
        """Perpendicular distance of each place from the line, positive on its left."""
        x, y = self.direction
        return np.asarray((places - self.start) @ np.array([-y, x]))

    def place(self, along: float, beside: float = 0.0) -> Float64[np.ndarray, " 2"]:
        """The inverse of ``along`` and ``beside``."""
        x, y = self.direction
        return np.asarray(self.start + along * np.array([x, y]) + beside * np.array([-y, x]))


@dataclass(frozen=True)
class Border:
    """Where two blocks meet.

    Attributes:
        blocks: Their numbers, the smaller first.
        line: The line between them.
    """

    blocks: tuple[int, int]
    line: PlanLine


def borders(partition: Partition) -> list[Border]:
    """All lines where two blocks meet, within the site; lines that reach its edge continue outside."""
    found = []
    for number, cell in enumerate(partition.cells):
        for axis in (0, 1):
            for at, others in ((cell.low[axis], "high"), (cell.high[axis], "low")):
                found += list(_edge(partition, number, axis, at, others))
    return found


def _edge(partition: Partition, number: int, axis: int, at: float, side: str) -> Iterator[Border]:
    """The borders along one edge of a cell, with each neighbour of a greater number."""
    cell = partition.cells[number]
    for other, neighbour in enumerate(partition.cells):
        if other == number or getattr(neighbour, side)[axis] != at:
            continue
        low = max(cell.low[1 - axis], neighbour.low[1 - axis])
        high = min(cell.high[1 - axis], neighbour.high[1 - axis])
        if low < high and other > number:
            yield Border((number, other), _line(axis, at, low, high))


def _line(axis: int, at: float, low: float, high: float) -> PlanLine:
    return PlanLine((at, low), (at, high)) if axis == 0 else PlanLine((low, at), (high, at))
