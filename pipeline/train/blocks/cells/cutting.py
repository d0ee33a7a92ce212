"""Cutting the plan into cells of equal work, measured by sparse points and by the pixels of all photos that see a cell.

Both measures cost time: points grow Gaussians, and pixels need iterations. The plan is bisected recursively across its
longer side, where the worse of the two measures is balanced best; of an odd number of cells the second part gets one
more. Everything is first counted in integers on one grid, so memory depends on the grid, not on the photos.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatpipe.pipeline.geometry.ground_plan import GroundPlan, PlanPoints
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.train.blocks.cells.partition import Cell, Partition
from splatpipe.pipeline.train.blocks.cells.photo_coverage import PhotoCoverage

BINS = 1024  # along the longer side of the site: 256 blocks are still cut to a few percent of a cell
NEAR = 4.0  # times the median GSD: anything seen more coarsely is background
SITE_PERCENTILES = (0.5, 99.5)  # percentiles of visible places, by axis, that bound the site: without wrong depths
MAX_SAMPLES = 1_000_000  # used to locate the site: 24 MB
MARGIN_SHARE = 0.1  # margin over a cell's side (of a square of equal area)


@dataclass(frozen=True, eq=False)
class WorkMap:
    """The work, counted on square bins of the plan.

    Attributes:
        plan: The ground plan.
        low: Lower corner of the first bin, plan units.
        bin_size: Side of a bin, plan units.
        measures: Number of sparse points in each bin, and of pixels that see it.
    """

    plan: GroundPlan
    low: tuple[float, float]
    bin_size: float
    measures: Int64[np.ndarray, "2 nx ny"]

    def bins(self, places: PlanPoints) -> tuple[Int64[np.ndarray, "k 2"], Bool[np.ndarray, " n"]]:
        """The bins of the places inside the map, and which places those are."""
        scaled = (places - np.array(self.low)) / self.bin_size
        inside = np.asarray((scaled >= 0.0).all(axis=1) & (scaled < self.measures.shape[1:]).all(axis=1))
        return scaled[inside].astype(np.int64), inside


def site(
    plan: GroundPlan, seen: Sequence[PhotoCoverage], xyz: Float64[np.ndarray, "p 3"], area: PlanArea | None = None
) -> Cell:
    """The rectangle to cut: what photos see from not too far away; the outer cells extend beyond it.

    Args:
        plan: The ground plan.
        seen: The photos' coverages.
        xyz: All sparse points.
        area: Area of interest, if the user drew one, in the model's frame.

    Raises:
        ValueError: if no photo sees anything.
    """
    every = [_evenly(coverage, xyz, max(1, MAX_SAMPLES // len(seen))) for coverage in seen]
    places = np.concatenate([found for found, _ in every] or [np.zeros((0, 3))])
    sizes = np.concatenate([found for _, found in every] or [np.zeros(0)])
    if area is not None and (inside := area.contains(places)).any():
        places, sizes = places[inside], sizes[inside]
    if len(places) == 0:
        raise ValueError("no photo sees anything")
    middle = float(np.median(sizes))
    low, high = np.percentile(plan.places(places[sizes <= NEAR * middle]), SITE_PERCENTILES, axis=0)
    high = np.maximum(high, low + max(float((high - low).max()), middle) / BINS)  # a strip is at least one bin wide
    return Cell((float(low[0]), float(low[1])), (float(high[0]), float(high[1])))


def _evenly(
    coverage: PhotoCoverage, xyz: Float64[np.ndarray, "p 3"], most: int
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
    """About ``most`` of the places that a photo sees, and the size of a pixel (GSD) there."""
    samples = coverage.samples(xyz)
    rows = np.flatnonzero(np.isfinite(samples.places).all(axis=1))
    rows = rows[:: max(1, -(-len(rows) // most))]
    return samples.places[rows], samples.distances[rows] / math.sqrt(coverage.camera.fx * coverage.camera.fy)


def work_map(plan: GroundPlan, extent: Cell, seen: Sequence[PhotoCoverage], xyz: Float64[np.ndarray, "p 3"]) -> WorkMap:
    """Count points and pixels.

    Args:
        plan: The ground plan.
        extent: The rectangle to cut.
        seen: The photos' coverages.
        xyz: All sparse points.
    """
    sides = np.array(extent.high) - np.array(extent.low)
    size = float(sides.max()) / BINS
    shape = np.maximum(np.ceil(sides / size - 1e-9).astype(int), 1)
    found = WorkMap(plan, extent.low, size, np.zeros((2, *shape), np.int64))
    bins, _ = found.bins(plan.places(xyz[np.isfinite(xyz).all(axis=1)]))
    np.add.at(found.measures[0], tuple(bins.T), 1)
    for coverage in seen:
        samples = coverage.samples(xyz)
        bins, inside = found.bins(plan.places(samples.places))
        np.add.at(found.measures[1], tuple(bins.T), np.rint(samples.weights[inside]).astype(np.int64))
    return found


def cut(work: WorkMap, cells: int) -> Partition:
    """Cut the plan into the given number of cells.

    Args:
        work: From ``work_map``.
        cells: Number of cells, at least 1.

    Raises:
        ValueError: if the plan has fewer bins.
    """
    boxes = _boxes((0, 0, *work.measures.shape[1:]), cells, work.measures)
    found = []
    for x0, y0, x1, y1 in boxes:
        low = (work.low[0] + x0 * work.bin_size, work.low[1] + y0 * work.bin_size)
        found.append(Cell(low, (work.low[0] + x1 * work.bin_size, work.low[1] + y1 * work.bin_size)))
    side = math.sqrt(sum(cell.area for cell in found) / len(found))
    return Partition(work.plan, tuple(found), MARGIN_SHARE * side)


def shares(work: WorkMap, partition: Partition) -> Float64[np.ndarray, "2 cells"]:
    """Each cell's share of the points and of the pixels that lie in any cell."""
    nx, ny = work.measures.shape[1:]
    x, y = np.meshgrid(np.arange(nx) + 0.5, np.arange(ny) + 0.5, indexing="ij")
    centres = np.stack([x.ravel(), y.ravel()], axis=1) * work.bin_size + np.array(work.low)
    found = np.array([work.measures[:, cell.contains(centres).reshape(nx, ny)].sum(1) for cell in partition.cells])
    return np.asarray((found / np.maximum(found.sum(axis=0), 1)).T)


def _boxes(
    box: tuple[int, int, int, int], cells: int, measures: Int64[np.ndarray, "2 nx ny"]
) -> list[tuple[int, int, int, int]]:
    """The bins of each cell: left, bottom, right and top, the last two exclusive."""
    x0, y0, x1, y1 = box
    if cells == 1:
        return [box]
    along_x = x1 - x0 >= y1 - y0
    across = measures[:, x0:x1, y0:y1].sum(axis=2 if along_x else 1)
    at = _best_cut(across, cells // 2, cells)
    if along_x:
        parts = (x0, y0, x0 + at, y1), (x0 + at, y0, x1, y1)
    else:
        parts = (x0, y0, x1, y0 + at), (x0, y0 + at, x1, y1)
    return _boxes(parts[0], cells // 2, measures) + _boxes(parts[1], cells - cells // 2, measures)


def _best_cut(across: Int64[np.ndarray, "2 n"], left: int, cells: int) -> int:
    """The number of bins before the cut that minimizes the larger measure of the larger side; ties take the first.

    Args:
        across: Both measures of each slice of bins.
        left: Number of cells in the first part.
        cells: Number of cells in both parts.
    """
    if across.shape[1] < 2:
        raise ValueError(f"{across.shape[1]} bins cannot be cut into {cells} cells")
    totals = across.sum(axis=1)
    if not totals.any():
        return max(1, int(across.shape[1]) * left // cells)
    before = np.cumsum(across[:, :-1], axis=1)
    loads = np.stack([before / left, (totals[:, None] - before) / (cells - left)])
    return 1 + int(np.argmin((loads / np.maximum(totals[:, None], 1)).max(axis=(0, 1))))
