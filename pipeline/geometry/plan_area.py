"""An area drawn in plan: which points lie inside, whatever their heights; and its file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.geometry.similarity import Similarity

Ring = Float64[np.ndarray, "_ 2"]
Polygon = tuple[Ring, ...]  # outline and holes; the first vertex is not repeated at the end
DIGITS = 9  # decimals of coordinates in the file: a nanometre in a metric frame


@dataclass(frozen=True, eq=False)
class PlanArea:
    """Polygons in plan.

    Attributes:
        axes: Unit vectors of the plan's two axes in the points' frame.
        polygons: In the points' units along these axes. A point in any of them is inside.
    """

    axes: Float64[np.ndarray, "2 3"]
    polygons: tuple[Polygon, ...]

    @staticmethod
    def seen_from_above(polygons: Sequence[Polygon]) -> PlanArea:
        """The area of polygons in a frame whose third axis is up."""
        return PlanArea(np.eye(3)[:2], tuple(polygons))

    def contains(self, points: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points lie inside; non-finite points do not."""
        inside = np.zeros(len(points), np.bool_)
        usable = np.flatnonzero(np.isfinite(points).all(axis=1))
        plan = points[usable] @ self.axes.T
        order = np.argsort(plan[:, 1], kind="stable")
        plan, rows = plan[order], usable[order]
        for outline, *holes in self.polygons:
            within = _within(plan, outline)
            for hole in holes:
                within &= ~_within(plan, hole)
            inside[rows] |= within
        return inside

    def in_source(self, target_from_source: Similarity) -> PlanArea:
        """The same area for points of another frame.

        Args:
            target_from_source: Transform from that frame to this area's.
        """
        offset = self.axes @ target_from_source.translation
        rings = [tuple((ring - offset) / target_from_source.scale for ring in polygon) for polygon in self.polygons]
        return PlanArea(self.axes @ target_from_source.rotation, tuple(rings))

    def size(self) -> float:
        """Sum of the polygons' areas without their holes, square units."""
        sizes = [[abs(signed_area(ring)) for ring in polygon] for polygon in self.polygons]
        return float(sum(outline - sum(holes) for outline, *holes in sizes))

    def facts(self) -> dict[str, Any]:
        """The area as JSON values."""
        rings = [[np.round(ring, DIGITS).tolist() for ring in polygon] for polygon in self.polygons]
        return {"axes": np.round(self.axes, DIGITS + 6).tolist(), "polygons": rings}

    @staticmethod
    def of_facts(facts: Any) -> PlanArea:
        """The inverse of ``facts``.

        Raises:
            KeyError, TypeError, ValueError: if the value has another structure.
        """
        rings = [tuple(np.array(r, np.float64).reshape(-1, 2) for r in polygon) for polygon in facts["polygons"]]
        return PlanArea(np.array(facts["axes"], np.float64).reshape(2, 3), tuple(rings))


def read_model_area(path: Path | None) -> PlanArea | None:
    """Read the area that georef wrote, in the model's frame; None if no boundary was drawn.

    Args:
        path: The part `georef.boundary`; None when there is only a dataset.

    Raises:
        StageError: if the file is broken.
    """
    return _read(path, "model")


def read_world_area(path: Path | None) -> PlanArea | None:
    """Read the same area in the world frame."""
    return _read(path, "world")


def _read(path: Path | None, frame: str) -> PlanArea | None:
    if path is None:
        return None
    try:
        facts = read_json(path)[frame]
        return None if facts is None else PlanArea.of_facts(facts)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StageError(f"The boundary {path.name} cannot be read: {error}", "Run with --rerun georef.") from error


def signed_area(ring: Ring) -> float:
    """Area by the shoelace formula: positive for an anticlockwise ring."""
    x, y = (ring - ring[:1]).T
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


def _within(plan: Float64[np.ndarray, "n 2"], ring: Ring) -> Bool[np.ndarray, " n"]:
    """Which points lie in a ring, by the even-odd rule: the number of edges right of a point.

    The points are sorted by their second coordinate. An edge is only compared with the points within its extent there,
    so time grows with the points and not with the product of points and vertices.
    """
    inside = np.zeros(len(plan), np.bool_)
    following = np.roll(ring, -1, axis=0)
    low, high = np.minimum(ring[:, 1], following[:, 1]), np.maximum(ring[:, 1], following[:, 1])
    first = np.searchsorted(plan[:, 1], low, side="left")  # an edge includes its lower end, not its upper one
    past = np.searchsorted(plan[:, 1], high, side="left")
    for k in np.flatnonzero(past > first).tolist():
        rows = slice(first[k], past[k])
        (x, y), (next_x, next_y) = ring[k], following[k]
        crossing = x + (plan[rows, 1] - y) * ((next_x - x) / (next_y - y))
        inside[rows] ^= plan[rows, 0] < crossing
    return inside
