"""More points where the sparse cloud is thin: depths by plane sweep, kept where other photos found the same."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.likeness import Picture
from splatpipe.pipeline.mvs.neighbours import Tracks, inverse_depths, load_tracks, neighbours
from splatpipe.pipeline.mvs.sweep import Depths, sweep
from splatpipe.pipeline.photos.dataset import View
from splatpipe.pipeline.photos.images import reduced_camera
from splatpipe.pipeline.photos.small_views import small_view

MEGAPIXELS = 0.1  # of a photo in the sweep; its planes see it at half the size
SWEPT = 4  # neighbours a photo is compared with
ASKED = 8  # neighbours whose depths have to agree
AGREEING = 2  # so many at least
TOLERANCE = 0.01  # of the depth, within which two photos agree
CELLS = 64  # of a photo's width; one with a sparse point in it gets no other
GROWTH = 2.0 ** (1.0 / 3.0)  # of the voxels, until the points are few enough


@dataclass(frozen=True)
class DensePoints:
    """Points found by the sweep.

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
class Cover:
    """How the points are spread.

    Attributes:
        most: At most so many, evenly.
        inside: Which places count; as many again are left where none does. None where all do.
    """

    most: int
    inside: Callable[[Float64[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]] | None = None


@dataclass(frozen=True)
class _Capture:
    """What every photo's work needs to know.

    Attributes:
        views: Photos to sweep, in name order.
        cameras: Theirs, in the sweep's grid.
        tracks: Which saw which sparse point.
        near: Their neighbours.
        folder: Where depths and colours are kept meanwhile: memory holds those of a few photos only.
    """

    views: Sequence[View]
    cameras: Sequence[Camera]
    tracks: Tracks
    near: Sequence[Sequence[int]]
    folder: Path


def dense_points(
    dataset: Path, views: Sequence[View], cover: Cover, folder: Path, threads: int, report: Reporter
) -> DensePoints:
    """Points on surfaces where the sparse model has few; the same for any number of threads.

    Args:
        dataset: The folder that `undistort` left.
        views: Photos to use, in name order; none that are held out.
        cover: How they are spread.
        folder: Where there is room for a megabyte a photo meanwhile.
        threads: Photos at a time.
        report: Told of progress.

    Raises:
        StageError: if the model or a photo cannot be read.
    """
    cameras = [reduced_camera(view.camera, MEGAPIXELS) for view in views]
    tracks = load_tracks(dataset, [camera.name for camera in cameras])
    near = neighbours(tracks, cameras, ASKED)
    threads_before = cv2.getNumThreads()
    cv2.setNumThreads(1)  # photos are the unit of parallel work
    try:
        with tempfile.TemporaryDirectory(prefix="sweep-", dir=folder) as kept:
            capture = _Capture(views, cameras, tracks, near, Path(kept))
            numbers = range(len(views))
            for done, _ in enumerate(ordered_map(partial(_keep_depths, capture), numbers, threads), start=1):
                report.progress(done, len(views), "sweeping planes", "photos")
            found = []
            for done, points in enumerate(ordered_map(partial(_agreed, capture), numbers, threads), start=1):
                found += [points] if points is not None else []
                report.progress(done, len(views), "comparing depths", "photos")
    finally:
        cv2.setNumThreads(threads_before)
    every = _joined(found)
    if cover.inside is None:
        return thinned(every, tracks.xyz, cover.most)
    within = cover.inside(every.xyz)
    parts = [every.select(np.flatnonzero(rows)) for rows in (within, ~within)]
    return _joined([thinned(part, tracks.xyz, cover.most) for part in parts])


def _joined(parts: Sequence[DensePoints]) -> DensePoints:
    empty = DensePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), np.zeros(0))
    columns = zip(*((part.xyz, part.rgb, part.scores, part.spacing) for part in (empty, *parts)), strict=True)
    return DensePoints(*(np.concatenate(column) for column in columns))


def _keep_depths(capture: _Capture, number: int) -> None:
    """Sweep one photo and keep what it found."""
    bounds = inverse_depths(capture.tracks, number, capture.cameras[number])
    others = capture.near[number][:SWEPT]
    if bounds is None or len(others) < AGREEING:
        return
    photo, colour = _picture(capture.views[number])
    found = sweep(photo, [_picture(capture.views[other])[0] for other in others], bounds)
    np.savez(capture.folder / f"{number}.npz", inverse=found.inverse, score=found.score, colour=colour)


def _picture(view: View) -> tuple[Picture, UInt8[np.ndarray, "h w 3"]]:
    camera, colour, mask = small_view(view, MEGAPIXELS)
    grey = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY).astype(np.float32) / np.float32(255.0)
    counts = np.ones(grey.shape, np.bool_) if mask is None else mask
    return Picture(camera, grey, counts), colour


def _kept(capture: _Capture, number: int) -> tuple[Depths, UInt8[np.ndarray, "h w 3"]] | None:
    path = capture.folder / f"{number}.npz"
    if not path.is_file():
        return None
    with np.load(path) as kept:
        return Depths(kept["inverse"], kept["score"]), kept["colour"]


def _agreed(capture: _Capture, number: int) -> DensePoints | None:
    """One point for each cell of a photo that has no sparse one: the surest of those that other photos confirm."""
    kept = _kept(capture, number)
    if kept is None:
        return None
    depths, colour = kept
    camera = capture.cameras[number]
    free = depths.inverse > 0.0
    rows, columns = np.nonzero(free)
    inverse = depths.inverse[rows, columns].astype(np.float64)
    points = camera.unproject(np.stack([columns + 0.5, rows + 0.5], axis=1), 1.0 / inverse)
    total, votes = points.copy(), np.ones(len(points))
    for other in capture.near[number]:
        theirs = _kept(capture, other)
        if theirs is not None:
            moved, agrees = _confirmed(points, capture.cameras[other], theirs[0].inverse)
            total[agrees] += moved[agrees]
            votes += agrees
    sure = np.flatnonzero(votes > AGREEING)
    cell = _cells(camera, columns[sure] + 0.5, rows[sure] + 0.5)
    taken = camera.project(capture.tracks.xyz[capture.tracks.seen[number]])
    thin = ~np.isin(cell, _cells(camera, taken[:, 0], taken[:, 1]))
    sure, cell = sure[thin], cell[thin]
    scores = votes[sure] + depths.score[rows[sure], columns[sure]]
    order = np.lexsort((sure, -scores, cell))
    first = order[np.unique(cell[order], return_index=True)[1]]
    chosen = sure[first]
    spacing = camera.width / CELLS / camera.fx / inverse[chosen]
    xyz = total[chosen] / votes[chosen, None]
    return DensePoints(xyz, colour[rows[chosen], columns[chosen]], scores[first], spacing)


def _confirmed(
    points: Float64[np.ndarray, "n 3"], camera: Camera, inverse: Float32[np.ndarray, "h w"]
) -> tuple[Float64[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Points where a camera's own depths put them along its rays, and whether that is where they are."""
    rows, pixels, depth = camera.in_view(points)
    x, y = pixels.T.astype(np.int64)
    ratio = np.zeros(len(points))  # of the point's depth over the one that the camera found
    ratio[rows] = depth * inverse[y, x]
    agrees = np.abs(ratio - 1.0) < TOLERANCE
    centre = camera.centre()
    moved = centre + (points - centre) / np.where(agrees, ratio, 1.0)[:, None]
    return moved, agrees


def _cells(camera: Camera, x: Float64[np.ndarray, " n"], y: Float64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Number of the square cell that each pixel lies in."""
    size = camera.width / CELLS
    return np.asarray(np.floor(y / size) * (CELLS + 1) + np.floor(x / size), np.int64)


def thinned(points: DensePoints, sparse: Float64[np.ndarray, "m 3"], most: int) -> DensePoints:
    """The surest point of each voxel without a sparse one; voxels grow until few enough are left.

    Args:
        points: From all photos.
        sparse: Points that are there already, world units.
        most: At most so many are left, at least 1.
    """
    if len(points) == 0:
        return points
    size = float(np.median(points.spacing))
    ranked = np.argsort(-points.scores, kind="stable")
    while True:
        rows = _one_each(points.xyz[ranked], sparse, size)
        if rows.size <= most:
            return points.select(np.sort(ranked[rows]))
        size *= GROWTH


def _one_each(
    points: Float64[np.ndarray, "n 3"], sparse: Float64[np.ndarray, "m 3"], size: float
) -> Int64[np.ndarray, " k"]:
    """Rows of the first point in each voxel that has none of ``sparse`` in it."""
    origin = points.min(axis=0)  # so that they share one voxel in the end
    voxels = np.floor((np.concatenate([sparse, points]) - origin) / size)
    _, first = np.unique(voxels, axis=0, return_index=True)
    return np.asarray(np.sort(first[first >= len(sparse)]) - len(sparse), np.int64)
