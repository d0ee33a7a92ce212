"""Photo coverage: what each photo sees, and where, from a coarse model's depth or from the sparse points it observes.

A photo sees the first surface on each of its rays, however near the ground below its camera is: an oblique photo sees
little of what it flies over. The depth is sampled coarsely; each sample stands for an equal number of pixels. Without
depth (sky, beyond the model) nothing is seen. Without a coarse model the photo's pixels are spread evenly over the
points that it observes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.images import reduced_camera

MEGAPIXELS = 0.01  # samples per photo: 40 kB of depth, and half a megapixel of a 20-megapixel photo still has 250


@dataclass(frozen=True, eq=False)
class Samples:
    """Places that a photo sees.

    Attributes:
        pixels: Positions in the dataset's photo, pixels.
        places: Positions in the model's frame.
        weights: Number of pixels of the dataset's photo that each sample stands for.
        distances: Depths along the camera's axis, world units.
    """

    pixels: Float64[np.ndarray, "n 2"]
    places: Float64[np.ndarray, "n 3"]
    weights: Float64[np.ndarray, " n"]
    distances: Float64[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class PhotoCoverage:
    """The coverage of one photo.

    Attributes:
        camera: The dataset's camera.
        grid: The same camera at the size of the samples.
        depth: The coarse model's depth along the view axis, 0 where it has none; None without such a model.
        mask: Which samples count; None if all do.
        observed: Rows of the sparse points that the photo observes, ascending.
    """

    camera: Camera
    grid: Camera
    depth: Float32[np.ndarray, "h w"] | None
    mask: Bool[np.ndarray, "h w"] | None
    observed: Int64[np.ndarray, " _"]

    @property
    def pixels(self) -> float:
        """Number of the dataset photo's pixels that count."""
        share = 1.0 if self.mask is None else float(self.mask.mean())
        return share * self.camera.width * self.camera.height

    def samples(self, xyz: Float64[np.ndarray, "p 3"]) -> Samples:
        """The places that the photo sees.

        Args:
            xyz: All sparse points.
        """
        return self.of_points(xyz) if self.depth is None else self._of_depth(self.depth)

    def of_points(self, xyz: Float64[np.ndarray, "p 3"]) -> Samples:
        """The sparse points that it observes, each with an equal share of its pixels."""
        rows, pixels, depths = self.camera.in_view(xyz[self.observed])
        weights = np.full(len(rows), self.pixels / max(len(rows), 1))
        return Samples(pixels, xyz[self.observed[rows]], weights, depths)

    def _of_depth(self, depth: Float32[np.ndarray, "h w"]) -> Samples:
        there = (depth > 0.0) & np.isfinite(depth)
        if self.mask is not None:
            there &= self.mask
        rows, columns = np.nonzero(there)
        pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
        distances = depth[rows, columns].astype(np.float64)
        scale = np.array([self.camera.width / self.grid.width, self.camera.height / self.grid.height])
        weights = np.full(len(rows), float(scale.prod()))
        return Samples(pixels * scale, self.grid.unproject(pixels, distances), weights, distances)


def photo_coverages(
    cameras: Sequence[Camera],
    observed: Sequence[Int64[np.ndarray, " _"]],
    depth_of: Callable[[Camera], Float32[np.ndarray, "h w"]] | None,
    mask_of: Callable[[Camera], Bool[np.ndarray, "h w"] | None] | None = None,
) -> list[PhotoCoverage]:
    """The coverage of each photo.

    Args:
        cameras: The dataset's cameras.
        observed: Rows of the sparse points that each photo observes.
        depth_of: Renders a camera's median depth of the coarse model; None before there is one.
        mask_of: Which pixels of a camera count, in its grid; None if all do.
    """
    found = []
    for camera, rows in zip(cameras, observed, strict=True):
        grid = reduced_camera(camera, MEGAPIXELS)
        depth = None if depth_of is None else depth_of(grid)
        found.append(PhotoCoverage(camera, grid, depth, None if mask_of is None else mask_of(grid), rows))
    return found
