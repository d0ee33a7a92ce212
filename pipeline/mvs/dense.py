"""More points where the sparse cloud is thin: depths by PatchMatch, kept where other photos found the same."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.depth_search import AGREEING, DepthSearch, SearchPlan
from splatpipe.pipeline.photos.dataset import View

MEGAPIXELS = 0.05  # of a photo: most depths good to half a hundredth
WIDER = 1.25  # times nearer than its sparse points: thin places have no points yet
NEIGHBOURS = 8  # that a photo is compared with, and whose depths are asked
PLAN = SearchPlan(MEGAPIXELS, WIDER, False, NEIGHBOURS, NEIGHBOURS)
CELLS = 64  # of a photo's width; one with a sparse point in it gets no other
GROWTH = 2.0 ** (1.0 / 3.0)  # of the voxels, until the points are few enough


@dataclass(frozen=True)
class DensePoints:
    """Points that depths of several photos agree on.

    Attributes:
        xyz: Positions, world units.
        rgb: Colours.
        scores: How sure each is, higher is surer.
        spacing: Size of a photo's cell at each, world units.
    """

    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    scores: Float64[np.ndarray, " n"]
    spacing: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, rows: Int64[np.ndarray, " k"]) -> DensePoints:
        """Those rows of it."""
        return DensePoints(self.xyz[rows], self.rgb[rows], self.scores[rows], self.spacing[rows])


@dataclass(frozen=True)
class PointBudget:
    """How the points are spread.

    Attributes:
        most: At most so many, evenly.
        inside: Which places count; as many again are left where none does. None where all do.
    """

    most: int
    inside: Callable[[Float64[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]] | None = None


def dense_points(
    dataset: Path, views: Sequence[View], cover: PointBudget, folder: Path, threads: int, report: Reporter
) -> DensePoints:
    """Points on surfaces where the sparse model has few; the same for any number of threads.

    Args:
        dataset: The folder that `undistort` left.
        views: Photos to use, in name order; none that are held out.
        cover: How they are spread.
        folder: Where there is room for a megabyte a photo meanwhile.
        threads: Photos at a time where depths are compared, and the kernel's.
        report: Told of progress.

    Raises:
        StageError: if the model or a photo cannot be read.
    """
    with tempfile.TemporaryDirectory(prefix="depths-", dir=folder) as kept:
        search = DepthSearch.begin(dataset, views, Path(kept), PLAN)
        search.run(threads, report)
        found = []
        for done, points in enumerate(ordered_map(partial(_agreed, search), range(len(views)), threads), start=1):
            found += [points] if points is not None else []
            report.progress(done, len(views), "comparing depths", "photos")
        sparse = search.tracks.xyz
    every = _joined(found)
    if cover.inside is None:
        return thinned(every, sparse, cover.most)
    within = cover.inside(every.xyz)
    parts = [every.select(np.flatnonzero(rows)) for rows in (within, ~within)]
    return _joined([thinned(part, sparse, cover.most) for part in parts])


def _joined(parts: Sequence[DensePoints]) -> DensePoints:
    empty = DensePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), np.zeros(0))
    columns = zip(*((part.xyz, part.rgb, part.scores, part.spacing) for part in (empty, *parts)), strict=True)
    return DensePoints(*(np.concatenate(column) for column in columns))


def _agreed(search: DepthSearch, number: int) -> DensePoints | None:
    """One point for each cell of a photo that has no sparse one: the surest of those that other photos confirm."""
    agreement = search.agreement(number)
    if agreement is None:
        return None
    camera, rows, columns = search.cameras[number], agreement.rows, agreement.columns
    sure = np.flatnonzero(agreement.votes >= AGREEING)
    cell = _cells(camera, columns[sure] + 0.5, rows[sure] + 0.5)
    taken = camera.project(search.tracks.xyz[search.tracks.seen[number]])
    thin = ~np.isin(cell, _cells(camera, taken[:, 0], taken[:, 1]))
    sure, cell = sure[thin], cell[thin]
    scores = agreement.votes[sure].astype(np.float64) - agreement.cost[sure]
    order = np.lexsort((sure, -scores, cell))
    first = order[np.unique(cell[order], return_index=True)[1]]
    chosen = sure[first]
    spacing = camera.width / CELLS / camera.fx / agreement.inverse[chosen]
    colours = search.colours(number)[rows[chosen], columns[chosen]]
    return DensePoints(agreement.xyz[chosen], colours, scores[first], spacing)


def _cells(camera: Camera, x: Float64[np.ndarray, " n"], y: Float64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Number of the square cell that each pixel lies in."""
    size = camera.width / CELLS
    return np.asarray(np.floor(y / size) * (CELLS + 1) + np.floor(x / size), np.int64)


def thinned(points: DensePoints, sparse: Float64[np.ndarray, "m 3"], most: int) -> DensePoints:
    """The surest point of each voxel without a sparse one; voxels grow until few enough are left.

    A voxel is about as large as its point's spacing, a power of two times the median's: as wide in the photos far away
    as near by.

    Args:
        points: From all photos.
        sparse: Points that are there already, world units.
        most: At most so many are left, at least 1.
    """
    if len(points) == 0:
        return points
    middle = float(np.median(points.spacing))
    sizes = middle * 2.0 ** np.round(np.log2(points.spacing / middle))
    ranked = np.argsort(-points.scores, kind="stable")
    while True:
        rows = _one_each(points.xyz[ranked], sizes[ranked], sparse)
        if rows.size <= most:
            return points.select(np.sort(ranked[rows]))
        sizes = sizes * GROWTH


def _one_each(
    points: Float64[np.ndarray, "n 3"], sizes: Float64[np.ndarray, " n"], sparse: Float64[np.ndarray, "m 3"]
) -> Int64[np.ndarray, " k"]:
    """Rows of the first point in each voxel that has none of ``sparse`` in it, nor any of a smaller voxel."""
    origin = points.min(axis=0)  # so that they share one voxel in the end
    taken, kept = sparse, []
    for size in np.unique(sizes):
        rows = np.flatnonzero(sizes == size)
        voxels = np.floor((np.concatenate([taken, points[rows]]) - origin) / size)
        _, first = np.unique(voxels, axis=0, return_index=True)
        kept.append(rows[np.sort(first[first >= len(taken)]) - len(taken)])
        taken = np.concatenate([taken, points[kept[-1]]])
    return np.asarray(np.sort(np.concatenate(kept)), np.int64)
