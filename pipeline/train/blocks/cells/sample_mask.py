"""Which pixels of a photo count when a block is trained: those that show its cell and its surroundings.

The rest is rendered from the coarse pass. Where the photo is sharper than that, it would pull the block's own Gaussians
over the rest, above all those in the margin.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.train.blocks.cells.partition import Partition
from splatpipe.pipeline.train.blocks.cells.photo_coverage import PhotoCoverage

MARGINS = 2.0  # around the cell: trained Gaussians lie within one margin, and their footprints reach slightly farther

SampleMask = Bool[np.ndarray, "rows columns"]
"""The part of a whole photo that counts, as cells of a grid over it."""


def counted_samples(
    partition: Partition, block: int, coverage: PhotoCoverage, xyz: Float64[np.ndarray, "p 3"]
) -> SampleMask:
    """The part of a photo that counts for a block, by the samples of its depth.

    Samples count if their place lies in the cell grown by ``MARGINS``, if they have no depth (unknown), or if the photo
    observes a sparse point there (thin objects in front of distant ground); so do the neighbours of all these. Every
    window of the block therefore has pixels that count.

    Args:
        partition: The cells.
        block: The block's number.
        coverage: The photo's coverage.
        xyz: All sparse points.
    """
    shape = (coverage.grid.height, coverage.grid.width)
    if coverage.depth is None:
        return np.ones(shape, np.bool_)
    reach = MARGINS * partition.margin
    there = (coverage.depth > 0.0) & np.isfinite(coverage.depth)
    rows, columns = np.nonzero(there)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    places = coverage.grid.unproject(pixels, coverage.depth[rows, columns].astype(np.float64))
    found = ~there
    found[rows, columns] = partition.near(block, reach, places)
    points = coverage.of_points(xyz)
    scale = np.array([shape[1] / coverage.camera.width, shape[0] / coverage.camera.height])
    inside = partition.near(block, reach, points.places)
    across, down = np.clip((points.pixels[inside] * scale).astype(np.int64), 0, np.array(shape[::-1]) - 1).T
    found[down, across] = True
    return np.asarray(cv2.dilate(found.view(np.uint8), np.ones((3, 3), np.uint8))).view(np.bool_)
