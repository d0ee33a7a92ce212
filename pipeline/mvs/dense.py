"""Extra points where the sparse cloud is thin: PatchMatch depths, kept where other photos confirm them."""

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
from splatpipe.pipeline.mvs.depth_search import MIN_AGREEING, DepthSearch, SearchPlan
from splatpipe.pipeline.mvs.neighbours import load_tracks
from splatpipe.pipeline.mvs.options import DENSE_MEGAPIXELS
from splatpipe.pipeline.photos.pixels.covering import covering_photos
from splatpipe.pipeline.photos.pixels.dataset import View

NEAR_MARGIN = 1.25  # factor by which the search starts nearer than the sparse points: thin places have none yet
NEIGHBOURS = 8  # photos that a photo is matched with, and whose depths may confirm its own
CELLS = 64  # across a photo's width; a cell with a sparse point gets no dense one
FEW_PHOTOS = 48  # up to this many, all are used, of more, some: depths that three photos confirm need overlap
GROWTH = 2.0 ** (1.0 / 3.0)  # factor by which voxels grow until the points are few enough


@dataclass(frozen=True)
class DensePoints:
    """Points that depths of several photos agree on.

    Attributes:
        xyz: Positions, world units.
        rgb: Colours.
        scores: Confidence of each point; higher is better.
        spacing: Size of a photo's cell at each point, world units.
    """

    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    scores: Float64[np.ndarray, " n"]
    spacing: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, rows: Int64[np.ndarray, " k"]) -> DensePoints:
        """The points of these rows."""
        return DensePoints(self.xyz[rows], self.rgb[rows], self.scores[rows], self.spacing[rows])


@dataclass(frozen=True)
class PointBudget:
    """How many points to keep, where, and from photos of what size.

    Attributes:
        most: Maximum number of points, spread evenly.
        inside: Returns which points lie in the area of interest; up to ``most`` more are kept outside. None: no area.
        megapixels: Size of the photos that they are estimated from.
    """

    most: int
    inside: Callable[[Float64[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]] | None = None
    megapixels: float = DENSE_MEGAPIXELS


def covering_views(dataset: Path, views: Sequence[View]) -> list[View]:
    """The views that suffice to show the scene (``covering_photos``), in the order given.

    Raises:
        StageError: if the model cannot be read.
    """
    tracks = load_tracks(dataset, [view.camera.name for view in views])
    return [views[number] for number in covering_photos(tracks.seen, len(tracks.xyz), FEW_PHOTOS)]


def dense_points(
    dataset: Path, views: Sequence[View], cover: PointBudget, folder: Path, threads: int, report: Reporter
) -> DensePoints:
    """Points on surfaces where the sparse model has few; identical for any number of threads.

    Args:
        dataset: The folder that `undistort` wrote.
        views: Photos to use, in name order; no held-out views.
        cover: How many points to keep, where, and from photos of what size.
        folder: Folder for temporary files, with room for a megabyte per photo.
        threads: Photos compared in parallel, and threads of the kernel.
        report: Receives progress.

    Raises:
        StageError: if the model or a photo cannot be read.
    """
    with tempfile.TemporaryDirectory(prefix="depths-", dir=folder) as kept:
        plan = SearchPlan(cover.megapixels, NEAR_MARGIN, False, NEIGHBOURS, NEIGHBOURS)
        search = DepthSearch.begin(dataset, views, Path(kept), plan)
        search.run(threads, report)
        found = []
        for done, points in enumerate(
            ordered_map(partial(_confirmed_points, search), range(len(views)), threads), start=1
        ):
            found += [points] if points is not None else []
            report.progress(done, len(views), "comparing depths", "photos")
        sparse = search.tracks.xyz
    every = _concatenate(found)
    if cover.inside is None:
        return thin_out(every, sparse, cover.most)
    within = cover.inside(every.xyz)
    parts = [every.select(np.flatnonzero(rows)) for rows in (within, ~within)]
    return _concatenate([thin_out(part, sparse, cover.most) for part in parts])


def _concatenate(parts: Sequence[DensePoints]) -> DensePoints:
    empty = DensePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), np.zeros(0))
    columns = zip(*((part.xyz, part.rgb, part.scores, part.spacing) for part in (empty, *parts)), strict=True)
    return DensePoints(*(np.concatenate(column) for column in columns))


def _confirmed_points(search: DepthSearch, number: int) -> DensePoints | None:
    """The most confident confirmed point for each cell of a photo without a sparse point."""
    agreement = search.agreement(number)
    if agreement is None:
        return None
    camera, rows, columns = search.cameras[number], agreement.rows, agreement.columns
    sure = np.flatnonzero(agreement.votes >= MIN_AGREEING)
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
    """Index of the square cell that each pixel lies in."""
    size = camera.width / CELLS
    return np.asarray(np.floor(y / size) * (CELLS + 1) + np.floor(x / size), np.int64)


def thin_out(points: DensePoints, sparse: Float64[np.ndarray, "m 3"], most: int) -> DensePoints:
    """Keep the most confident point of each voxel without a sparse point; voxels grow until few enough points remain.

    A voxel is about as large as its point's spacing, rounded to a power of two times the median spacing, so that it has
    about the same size in the photos near and far.

    Args:
        points: Points from all photos.
        sparse: Existing points, world units.
        most: Maximum number of points to keep, at least 1.
    """
    if len(points) == 0:
        return points
    middle = float(np.median(points.spacing))
    sizes = middle * 2.0 ** np.round(np.log2(points.spacing / middle))
    by_score = np.argsort(-points.scores, kind="stable")
    while True:
        rows = _first_per_voxel(points.xyz[by_score], sizes[by_score], sparse)
        if rows.size <= most:
            return points.select(np.sort(by_score[rows]))
        sizes = sizes * GROWTH


def _first_per_voxel(
    points: Float64[np.ndarray, "n 3"], sizes: Float64[np.ndarray, " n"], sparse: Float64[np.ndarray, "m 3"]
) -> Int64[np.ndarray, " k"]:
    """Rows of the first point in each voxel that holds neither a sparse point nor one kept from a smaller voxel."""
    origin = points.min(axis=0)  # so that all points end up in one voxel
    taken, kept = sparse, []
    for size in np.unique(sizes):
        rows = np.flatnonzero(sizes == size)
        voxels = np.floor((np.concatenate([taken, points[rows]]) - origin) / size)
        _, first = np.unique(voxels, axis=0, return_index=True)
        kept.append(rows[np.sort(first[first >= len(taken)]) - len(taken)])
        taken = np.concatenate([taken, points[kept[-1]]])
    return np.asarray(np.sort(np.concatenate(kept)), np.int64)
