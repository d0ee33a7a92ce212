"""The ground plan cut into cells, one per block: which block owns a place, and which blocks train it.

Cells are rectangles of the plan that include their lower and exclude their upper edges, so that each place has one
owner and neighbours share no Gaussian. Cells at the site's edge extend outward without limit: a place outside belongs
to the nearest cell, so that the horizon is trained like everything else. Heights do not count: a wall and the ground in
front of it belong together, and the photos of a flight see all heights of a place from similar distances.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.ground_plan import GroundPlan, PlanPoints

NO_OWNER = -1  # owner of a non-finite point


@dataclass(frozen=True)
class Cell:
    """A rectangle of the plan, plan units.

    Attributes:
        low: Lower edges, inclusive.
        high: Upper edges, exclusive.
    """

    low: tuple[float, float]
    high: tuple[float, float]

    @property
    def area(self) -> float:
        """Area, square plan units."""
        return (self.high[0] - self.low[0]) * (self.high[1] - self.low[1])

    def grown(self, margin: float) -> Cell:
        """The cell with a margin around it."""
        return Cell(
            (self.low[0] - margin, self.low[1] - margin),
            (self.high[0] + margin, self.high[1] + margin),
        )

    def contains(self, places: PlanPoints) -> Bool[np.ndarray, " n"]:
        """Which places lie inside; a non-finite one does not."""
        return np.asarray(((places >= self.low) & (places < self.high)).all(axis=1))

    def distance(self, places: PlanPoints) -> Float64[np.ndarray, " n"]:
        """Distance of each place from the cell, plan units; 0 inside."""
        outside = np.maximum(np.maximum(np.array(self.low) - places, places - np.array(self.high)), 0.0)
        return np.asarray(np.hypot(outside[:, 0], outside[:, 1]))


@dataclass(frozen=True, eq=False)
class Partition:
    """The cells, numbered from 0 in an order that depends only on the cuts.

    Attributes:
        plan: The ground plan, in the model's frame.
        cells: The cells; they touch but do not overlap.
        margin: Width of the margin that a block trains around its cell, plan units.
    """

    plan: GroundPlan
    cells: tuple[Cell, ...]
    margin: float

    def places(self, points: Float64[np.ndarray, "n 3"]) -> PlanPoints:
        """Plan coordinates of the points, clamped to the site (the rectangle around all cells).

        Args:
            points: In the model's frame; a non-finite point gives NaN.
        """
        there = np.isfinite(points).all(axis=1)
        places = self.plan.places(np.where(there[:, None], points, math.nan))
        low = np.min([cell.low for cell in self.cells], axis=0)
        high = np.nextafter(np.max([cell.high for cell in self.cells], axis=0), low)  # upper edges are exclusive
        return np.asarray(np.clip(places, low, high))

    def owners(self, points: Float64[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
        """Index of the cell that owns each point, `NO_OWNER` for a non-finite one.

        Args:
            points: In the model's frame.
        """
        places = self.places(points)
        owners = np.full(len(points), NO_OWNER, np.int64)
        for number, cell in enumerate(self.cells):
            owners[cell.contains(places)] = number
        return owners

    def trained_by(self, block: int, points: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points lie in a block's cell or its margin."""
        return self.near(block, self.margin, points)

    def near(self, block: int, distance: float, points: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points lie in a block's cell or within a distance of it, plan units."""
        return self.cells[block].grown(distance).contains(self.places(points))

    def facts(self) -> dict[str, Any]:
        """The partition as JSON values; the numbers round-trip as float64."""
        return {
            "axes": self.plan.axes.tolist(),
            "up": self.plan.up.tolist(),
            "cells": [[*cell.low, *cell.high] for cell in self.cells],
            "margin": self.margin,
        }

    @staticmethod
    def of_facts(facts: Any) -> Partition:
        """The inverse of ``facts``.

        Raises:
            KeyError, TypeError, ValueError: if it is not a partition.
        """
        plan = GroundPlan(np.array(facts["axes"], np.float64).reshape(2, 3), np.array(facts["up"], np.float64))
        rows = np.array(facts["cells"], np.float64).reshape(-1, 4).tolist()
        margin = float(facts["margin"])
        if plan.up.shape != (3,) or not rows or not math.isfinite(margin) or margin < 0.0:
            raise ValueError("no partition")
        return Partition(plan, tuple(Cell((a, b), (c, d)) for a, b, c, d in rows), margin)
