"""Depths of all photos of a capture, found one by one, and where other photos found the same.

Photos and depths lie in a folder meanwhile, so that memory holds those of a photo and its neighbours only.
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
from splatpipe.pipeline.photos.dataset import View
from splatpipe.pipeline.photos.images import reduced_camera
from splatpipe.pipeline.photos.small_views import small_view
from splatpipe.pipeline.raster import _native
from splatpipe.pipeline.raster.native_camera import native_camera
from splatpipe.pipeline.raster.threads import same_bits

AGREEING = 2  # so many have to agree at least
TOLERANCE = 0.01  # of the depth, within which two photos agree;
TOLERANCE_PX = 0.5  # far away as much of it as moves the point so far in the other's photo,
LOOSEST = 0.2  # of the depth at most

Inverse = Float32[np.ndarray, "_ _"]
Axes = tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]


@dataclass(frozen=True)
class ConfirmedDepths:
    """What other photos say of a photo's depths; a row for each pixel with one.

    Attributes:
        rows: Of the pixels.
        columns: Of the pixels.
        inverse: Inverse depths along the camera's z, 1 / world units.
        xyz: Mean of the places that the photo and those which agree have found, world units.
        votes: How many other photos agree.
        cost: One minus the correlation with the two photos most alike.
    """

    rows: Int64[np.ndarray, " n"]
    columns: Int64[np.ndarray, " n"]
    inverse: Float64[np.ndarray, " n"]
    xyz: Float64[np.ndarray, "n 3"]
    votes: UInt8[np.ndarray, " n"]
    cost: Float32[np.ndarray, " n"]


@dataclass(frozen=True)
class SearchPlan:
    """How depths are looked for.

    Attributes:
        megapixels: Of a photo at most.
        wider: Times nearer than its sparse points that a photo is searched.
        plain: Whether pixels without texture at hand have depths, too: others have to confirm them.
        compared: Neighbours that a photo is compared with, 16 at most.
        asked: Neighbours whose depths are asked whether they agree; no fewer.
    """

    megapixels: float
    wider: float
    plain: bool
    compared: int
    asked: int


@dataclass(frozen=True)
class DepthSearch:
    """Photos of one size, who is compared with whom, and where what is found lies.

    Attributes:
        views: Photos to use, in name order.
        cameras: Theirs, in the grid that depths are found in.
        tracks: Which saw which sparse point.
        near: Neighbours of each that are asked, the best first.
        folder: Where photos and depths are kept.
        plan: How they are looked for.
    """

    views: Sequence[View]
    cameras: Sequence[Camera]
    tracks: SparseVisibility
    near: Sequence[Sequence[int]]
    folder: Path
    plan: SearchPlan

    @classmethod
    def begin(cls, dataset: Path, views: Sequence[View], folder: Path, plan: SearchPlan) -> DepthSearch:
        """A search that has found nothing yet.

        Args:
            dataset: The folder that `undistort` left.
            views: Photos to use, in name order.
            folder: Where there is room meanwhile: 9 bytes a pixel.
            plan: How they are looked for.

        Raises:
            StageError: if the model cannot be read.
        """
        cameras = [reduced_camera(view.camera, plan.megapixels) for view in views]
        tracks = load_tracks(dataset, [camera.name for camera in cameras])
        return cls(views, cameras, tracks, neighbours(tracks, cameras, plan.asked), folder, plan)

    def run(self, threads: int, report: Reporter) -> None:
        """Find the depths of every photo that has none in the folder yet; the same for any number of threads.

        Args:
            threads: Photos at a time where they are decoded, and the kernel's.
            report: Told of progress.

        Raises:
            StageError: if a photo cannot be read.
        """
        numbers = range(len(self.views))
        with same_bits(threads):
            for _ in ordered_map(partial(DepthSearch._keep_photo, self), numbers, threads):
                pass
            for number in numbers:
                self._keep_depths(number)
                report.progress(number + 1, len(self.views), "finding depths", "photos")

    def colours(self, number: int) -> UInt8[np.ndarray, "h w 3"]:
        """A photo's colours, RGB."""
        with np.load(self._photo_path(number)) as kept:
            return np.asarray(kept["colour"], np.uint8)

    def depths(self, number: int) -> DepthEstimate | None:
        """What was found in a photo; None for one that has too few neighbours or points."""
        path = self._depths_path(number)
        if not path.is_file():
            return None
        with np.load(path) as kept:
            return DepthEstimate(kept["inverse"], kept["cost"])

    def inverse(self, number: int) -> Inverse | None:
        """The inverse depths alone: what a neighbour is asked for."""
        path = self._depths_path(number)
        if not path.is_file():
            return None
        with np.load(path) as kept:
            return np.asarray(kept["inverse"], np.float32)

    def agreement(self, number: int) -> ConfirmedDepths | None:
        """What a photo's neighbours say of its depths; None where it has none."""
        return agreement_of(number, self.cameras, self.near[number], (self.depths(number), self.inverse))

    def _photo_path(self, number: int) -> Path:
        return self.folder / f"photo-{number}.npz"

    def _depths_path(self, number: int) -> Path:
        return self.folder / f"depths-{number}.npz"

    def _keep_photo(self, number: int) -> None:
        """Make one photo small and keep it: its neighbours ask for it, too."""
        if self._photo_path(number).is_file():
            return
        _, colour, mask = small_view(self.views[number], self.plan.megapixels)
        counts = np.ones(colour.shape[:2], np.bool_) if mask is None else mask
        save_arrays(self._photo_path(number), colour=colour, counts=counts)

    def _keep_depths(self, number: int) -> None:
        """Look at one photo and keep what it found."""
        if self._depths_path(number).is_file():
            return
        bounds = inverse_depths(self.tracks, number, self.cameras[number], self.plan.wider)
        others = self.near[number][: self.plan.compared]
        if bounds is None or len(others) < AGREEING:
            return
        pictures = [self._picture(other) for other in others]
        found = find_depths(self._picture(number), pictures, bounds, number, self.plan.plain)
        save_arrays(self._depths_path(number), inverse=found.inverse, cost=found.cost)

    def _picture(self, number: int) -> Picture:
        with np.load(self._photo_path(number)) as kept:
            grey = np.asarray(cv2.cvtColor(kept["colour"], cv2.COLOR_RGB2GRAY), np.uint8)
            return Picture(self.cameras[number], grey, kept["counts"])


def agreement_of(
    number: int,
    cameras: Sequence[Camera],
    others: Sequence[int],
    depths: tuple[DepthEstimate | None, Callable[[int], Inverse | None]],
) -> ConfirmedDepths | None:
    """What other photos say of a photo's depths; None where it has none.

    Args:
        number: The photo's.
        cameras: Of all photos, in the grids of their depths.
        others: Numbers of those that are asked.
        depths: The photo's own, and the inverse depths of another one by its number; None where there are none.
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
    """Ask a camera's own depths for the places of a photo's points.

    Args:
        places: x, y, z of the points, world units.
        photo: The camera that found them.
        camera: The one that is asked.
        inverse: Its inverse depths, 0 where it has none.
        found: Where it puts them along its rays is added to the first, and a vote to the second, where that is where
            they are.
    """
    parallax = camera.fx * float(np.linalg.norm(camera.centre() - photo.centre()))  # of something one unit deep, pixels
    agreeing = TOLERANCE, TOLERANCE_PX, LOOSEST, max(parallax, 1e-9)
    _native.confirm(inverse, native_camera(camera), places, agreeing, *found)
