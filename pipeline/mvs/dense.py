"""More points where the sparse cloud is thin: depths by PatchMatch, kept where other photos found the same."""

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
from splatpipe.pipeline.mvs.neighbours import Tracks, inverse_depths, load_tracks, neighbours
from splatpipe.pipeline.mvs.patch_match import Depths, find_depths
from splatpipe.pipeline.mvs.picture import Picture
from splatpipe.pipeline.photos.dataset import View
from splatpipe.pipeline.photos.images import reduced_camera
from splatpipe.pipeline.photos.small_views import small_view
from splatpipe.pipeline.raster.threads import same_bits

MEGAPIXELS = 0.05  # of a photo: most depths good to half a hundredth
COMPARED = 8  # neighbours a photo is compared with
ASKED = 8  # neighbours whose depths have to agree
AGREEING = 2  # so many at least
TOLERANCE = 0.01  # of the depth, within which two photos agree;
TOLERANCE_PX = 0.5  # far away as much of it as moves the point so far in the other's photo,
LOOSEST = 0.2  # of the depth at most
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
        views: Photos to use, in name order.
        cameras: Theirs, in the small photos' grid.
        tracks: Which saw which sparse point.
        near: Their neighbours.
        folder: Where small photos and depths are kept meanwhile: memory holds those of a few only.
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
        threads: Photos at a time where depths are compared, and the kernel's.
        report: Told of progress.

    Raises:
        StageError: if the model or a photo cannot be read.
    """
    cameras = [reduced_camera(view.camera, MEGAPIXELS) for view in views]
    tracks = load_tracks(dataset, [camera.name for camera in cameras])
    near = neighbours(tracks, cameras, ASKED)
    with tempfile.TemporaryDirectory(prefix="depths-", dir=folder) as kept, same_bits(threads):
        capture = _Capture(views, cameras, tracks, near, Path(kept))
        numbers = range(len(views))
        for _ in ordered_map(partial(_keep_photo, capture), numbers, threads):
            pass
        for number in numbers:
            _keep_depths(capture, number)
            report.progress(number + 1, len(views), "finding depths", "photos")
        found = []
        for done, points in enumerate(ordered_map(partial(_agreed, capture), numbers, threads), start=1):
            found += [points] if points is not None else []
            report.progress(done, len(views), "comparing depths", "photos")
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


def _keep_photo(capture: _Capture, number: int) -> None:
    """Make one photo small and keep it: its neighbours ask for it, too."""
    _, colour, mask = small_view(capture.views[number], MEGAPIXELS)
    counts = np.ones(colour.shape[:2], np.bool_) if mask is None else mask
    np.savez(capture.folder / f"photo-{number}.npz", colour=colour, counts=counts)


def _keep_depths(capture: _Capture, number: int) -> None:
    """Look at one photo and keep what it found."""
    bounds = inverse_depths(capture.tracks, number, capture.cameras[number])
    others = capture.near[number][:COMPARED]
    if bounds is None or len(others) < AGREEING:
        return
    found = find_depths(_picture(capture, number), [_picture(capture, other) for other in others], bounds, number)
    np.savez(capture.folder / f"depths-{number}.npz", inverse=found.inverse, cost=found.cost)


def _picture(capture: _Capture, number: int) -> Picture:
    with np.load(capture.folder / f"photo-{number}.npz") as kept:
        grey = np.asarray(cv2.cvtColor(kept["colour"], cv2.COLOR_RGB2GRAY), np.uint8)
        return Picture(capture.cameras[number], grey, kept["counts"])


def _kept(capture: _Capture, number: int) -> Depths | None:
    path = capture.folder / f"depths-{number}.npz"
    if not path.is_file():
        return None
    with np.load(path) as kept:
        return Depths(kept["inverse"], kept["cost"])


def _agreed(capture: _Capture, number: int) -> DensePoints | None:
    """One point for each cell of a photo that has no sparse one: the surest of those that other photos confirm."""
    depths = _kept(capture, number)
    if depths is None:
        return None
    with np.load(capture.folder / f"photo-{number}.npz") as kept:
        colour = kept["colour"]
    camera = capture.cameras[number]
    free = depths.inverse > 0.0
    rows, columns = np.nonzero(free)
    inverse = depths.inverse[rows, columns].astype(np.float64)
    points = camera.unproject(np.stack([columns + 0.5, rows + 0.5], axis=1), 1.0 / inverse)
    total, votes = points.copy(), np.ones(len(points))
    for other in capture.near[number]:
        theirs = _kept(capture, other)
        if theirs is not None:
            moved, agrees = _confirmed(points, camera, capture.cameras[other], theirs.inverse)
            total[agrees] += moved[agrees]
            votes += agrees
    sure = np.flatnonzero(votes > AGREEING)
    cell = _cells(camera, columns[sure] + 0.5, rows[sure] + 0.5)
    taken = camera.project(capture.tracks.xyz[capture.tracks.seen[number]])
    thin = ~np.isin(cell, _cells(camera, taken[:, 0], taken[:, 1]))
    sure, cell = sure[thin], cell[thin]
    scores = votes[sure] - depths.cost[rows[sure], columns[sure]]
    order = np.lexsort((sure, -scores, cell))
    first = order[np.unique(cell[order], return_index=True)[1]]
    chosen = sure[first]
    spacing = camera.width / CELLS / camera.fx / inverse[chosen]
    xyz = total[chosen] / votes[chosen, None]
    return DensePoints(xyz, colour[rows[chosen], columns[chosen]], scores[first], spacing)


def _confirmed(
    points: Float64[np.ndarray, "n 3"], photo: Camera, camera: Camera, inverse: Float32[np.ndarray, "h w"]
) -> tuple[Float64[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Points of a photo where a camera's own depths put them along its rays, and whether that is where they are."""
    rows, pixels, depth = camera.in_view(points)
    x, y = pixels.T.astype(np.int64)
    ratio = np.zeros(len(points))  # of the point's depth over the one that the camera found
    ratio[rows] = depth * inverse[y, x]
    centre = camera.centre()
    parallax = camera.fx * float(np.linalg.norm(centre - photo.centre()))  # of something one unit deep, in pixels
    tolerance = np.zeros(len(points))
    tolerance[rows] = np.clip(TOLERANCE_PX * depth / max(parallax, 1e-9), TOLERANCE, LOOSEST)
    agrees = np.abs(ratio - 1.0) < tolerance
    moved = centre + (points - centre) / np.where(agrees, ratio, 1.0)[:, None]
    return moved, agrees


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
