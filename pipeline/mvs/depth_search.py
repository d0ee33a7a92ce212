"""Depth estimation for all photos of a capture, one by one, and their confirmation by other photos.

Photos and depths are kept in a folder, so that only those of a photo and its neighbours are in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.array_file import save_arrays
from splatpipe.pipeline.mvs.neighbours import SparseVisibility, inverse_depths, load_tracks, neighbours
from splatpipe.pipeline.mvs.patch_match import DepthEstimate, find_depths
from splatpipe.pipeline.mvs.picture import Picture
from splatpipe.pipeline.native import _native
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.photos.pixels.images import reduced_camera
from splatpipe.pipeline.photos.pixels.small_views import small_view
from splatpipe.pipeline.raster.native_camera import native_camera
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.splat.containers.archives import open_archive

MIN_AGREEING = 2  # other photos that have to agree, at least
DEPTH_TOLERANCE = 0.01  # share of the depth within which two photos agree;
TOLERANCE_PX = 0.5  # for distant points, the share that moves the point by this much in the other photo,
MAX_TOLERANCE = 0.2  # but at most this share

Inverse = Float32[np.ndarray, "_ _"]
Axes = tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]


@dataclass(frozen=True)
class ConfirmedDepths:
    """A photo's depths and how many other photos agree; one entry for each pixel with a depth.

    Attributes:
        rows: Rows of the pixels.
        columns: Columns of the pixels.
        inverse: Inverse depths along the camera's z, 1 / world units.
        xyz: Mean of the positions from the photo and from those that agree, world units.
        votes: How many other photos agree.
        cost: One minus the correlation with the two best-matching photos.
    """

    rows: Int64[np.ndarray, " n"]
    columns: Int64[np.ndarray, " n"]
    inverse: Float64[np.ndarray, " n"]
    xyz: Float64[np.ndarray, "n 3"]
    votes: UInt8[np.ndarray, " n"]
    cost: Float32[np.ndarray, " n"]


@dataclass(frozen=True)
class SearchPlan:
    """Settings of the depth search.

    Attributes:
        megapixels: Maximum size of a photo.
        wider: How many times nearer than its sparse points a photo is searched.
        plain: Whether pixels without texture get depths, too; others have to confirm them.
        compared: Neighbours that a photo is matched with, at most 16.
        confirming: Neighbours whose depths may confirm a photo's; at least ``compared``.
    """

    megapixels: float
    wider: float
    plain: bool
    compared: int
    confirming: int


@dataclass(frozen=True)
class DepthSearch:
    """A depth search over a capture: reduced photos, their neighbours, and the folder of the results.

    Attributes:
        views: Photos to use, in name order.
        cameras: Their cameras at the resolution of the depths.
        tracks: Which photo observes which sparse point.
        near: Neighbours of each photo that may confirm its depths, best first.
        folder: Where photos and depths are kept.
        plan: Settings of the search.
    """

    views: Sequence[View]
    cameras: Sequence[Camera]
    tracks: SparseVisibility
    near: Sequence[Sequence[int]]
    folder: Path
    plan: SearchPlan

    @classmethod
    def begin(cls, dataset: Path, views: Sequence[View], folder: Path, plan: SearchPlan) -> DepthSearch:
        """Set up a search, without any depths yet.

        Args:
            dataset: The folder that `undistort` wrote.
            views: Photos to use, in name order.
            folder: Folder for temporary files, with room for 9 bytes per pixel.
            plan: Settings of the search.

        Raises:
            StageError: if the model cannot be read.
        """
        cameras = [reduced_camera(view.camera, plan.megapixels) for view in views]
        tracks = load_tracks(dataset, [camera.name for camera in cameras])
        return cls(views, cameras, tracks, neighbours(tracks, cameras, plan.confirming), folder, plan)

    def run(self, threads: int, report: Reporter) -> None:
        """Estimate depths for every photo without a file in the folder yet; identical for any number of threads.

        Args:
            threads: Photos decoded in parallel, and threads of the kernel.
            report: Receives progress.

        Raises:
            StageError: if a photo cannot be read.
        """
        numbers = range(len(self.views))
        with same_bits(threads):
            for _ in ordered_map(partial(DepthSearch._save_photo, self), numbers, threads):
                pass
            for number in numbers:
                self._save_depths(number)
                report.progress(number + 1, len(self.views), "finding depths", "photos")

    def colours(self, number: int) -> UInt8[np.ndarray, "h w 3"]:
        """A photo's colours, RGB."""
        with open_archive(self._photo_path(number)) as kept:
            return np.asarray(kept["colour"], np.uint8)

    def depths(self, number: int) -> DepthEstimate | None:
        """The depths estimated for a photo; None if it has too few neighbours or points."""
        path = self._depths_path(number)
        if not path.is_file():
            return None
        with open_archive(path) as kept:
            return DepthEstimate(kept["inverse"], kept["cost"])

    def inverse(self, number: int) -> Inverse | None:
        """A photo's inverse depths alone, which confirm a neighbour's; None if it has too few neighbours or points."""
        path = self._depths_path(number)
        if not path.is_file():
            return None
        with open_archive(path) as kept:
            return np.asarray(kept["inverse"], np.float32)

    def agreement(self, number: int) -> ConfirmedDepths | None:
        """How a photo's neighbours confirm its depths; None if it has none."""
        return agreement_of(number, self.cameras, self.near[number], (self.depths(number), self.inverse))

    def _photo_path(self, number: int) -> Path:
        return self.folder / f"photo-{number}.npz"

    def _depths_path(self, number: int) -> Path:
        return self.folder / f"depths-{number}.npz"

    def _save_photo(self, number: int) -> None:
        """Reduce one photo and store it: its neighbours need it, too."""
        if self._photo_path(number).is_file():
            return
        _, colour, mask = small_view(self.views[number], self.plan.megapixels)
        counts = np.ones(colour.shape[:2], np.bool_) if mask is None else mask
        save_arrays(self._photo_path(number), colour=colour, counts=counts)

    def _save_depths(self, number: int) -> None:
        """Estimate one photo's depths and store them."""
        if self._depths_path(number).is_file():
            return
        bounds = inverse_depths(self.tracks, number, self.cameras[number], self.plan.wider)
        others = self.near[number][: self.plan.compared]
        if bounds is None or len(others) < MIN_AGREEING:
            return
        pictures = [self._picture(other) for other in others]
        found = find_depths(self._picture(number), pictures, bounds, number, self.plan.plain)
        save_arrays(self._depths_path(number), inverse=found.inverse, cost=found.cost)

    def _picture(self, number: int) -> Picture:
        with open_archive(self._photo_path(number)) as kept:
            grey = np.asarray(cv2.cvtColor(kept["colour"], cv2.COLOR_RGB2GRAY), np.uint8)
            return Picture(self.cameras[number], grey, kept["counts"])


def agreement_of(
    number: int,
    cameras: Sequence[Camera],
    others: Sequence[int],
    depths: tuple[DepthEstimate | None, Callable[[int], Inverse | None]],
) -> ConfirmedDepths | None:
    """How other photos confirm a photo's depths; None if it has none.

    Args:
        number: Index of the photo.
        cameras: Cameras of all photos at the resolution of their depths.
        others: Indices of the photos that may confirm.
        depths: The photo's own depths, and a function that returns another photo's inverse depths by its index; None
            where there are none.
    """
    own, inverse_of = depths
    if own is None:
        return None
    camera = cameras[number]
    rows, columns = np.nonzero(own.inverse > 0.0)
    inverse = own.inverse[rows, columns].astype(np.float64)
    points = camera.unproject(np.stack([columns + 0.5, rows + 0.5], axis=1), 1.0 / inverse)
    total, votes = points.copy(), np.zeros(len(points), np.uint8)
    east, north, up = tuple(np.ascontiguousarray(axis) for axis in points.T)
    for other in others:
        theirs = inverse_of(other)
        if theirs is not None:
            confirm((east, north, up), camera, cameras[other], theirs, (total, votes))
    return ConfirmedDepths(rows, columns, inverse, total / (1.0 + votes)[:, None], votes, own.cost[rows, columns])


def confirm(
    places: Axes,
    photo: Camera,
    camera: Camera,
    inverse: Float32[np.ndarray, "h w"],
    found: tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, " n"]],
) -> None:
    """Check a photo's points against another camera's depths.

    Args:
        places: x, y, z of the points, world units.
        photo: The camera of the photo that the points come from.
        camera: The other camera.
        inverse: The other camera's inverse depths, 0 where it has none.
        found: Updated in place: where the other camera's depth agrees with a point, the position that it gives is added
            to the first array, and a vote to the second.
    """
    parallax = camera.fx * float(np.linalg.norm(camera.centre() - photo.centre()))  # pixels, at a depth of one unit
    agreeing = DEPTH_TOLERANCE, TOLERANCE_PX, MAX_TOLERANCE, max(parallax, 1e-9)
    _native.confirm(inverse, native_camera(camera), places, agreeing, *found)
