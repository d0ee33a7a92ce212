"""Which pixels of a photo count when a block is trained: those that show its cell and what is near it.

The rest is drawn as the coarse pass left it. What the photo shows sharper there would draw the block's own Gaussians
over it, and those in the margin most of all.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from splatpipe.pipeline.train.blocks.partition import Partition
from splatpipe.pipeline.train.blocks.photo_coverage import PhotoCoverage

MARGINS = 2.0  # around the cell: what is trained reaches one, and casts its light a little farther

SampleMask = Bool[np.ndarray, "rows columns"]
"""What of a whole photo counts, by the cells of a grid that covers it."""


def counted_samples(
    partition: Partition, block: int, sight: PhotoCoverage, xyz: Float64[np.ndarray, "p 3"]
) -> SampleMask:
    """What of a photo counts for a block, by the samples of its depth.

    Counted are samples whose place lies in the cell grown by ``MARGINS``, those without a depth (what is there, nobody
    knows), those at sparse points there that the photo observes (thin things before a far ground), and all beside one
    that counts: so in each window of the block something counts.

    Args:
        partition: The cells.
        block: The number of one.
        sight: What the photo sees.
        xyz: All sparse points.
    """
    shape = (sight.grid.height, sight.grid.width)
    if sight.depth is None:
        return np.ones(shape, np.bool_)
    reach = MARGINS * partition.margin
    there = (sight.depth > 0.0) & np.isfinite(sight.depth)
    rows, columns = np.nonzero(there)
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    places = sight.grid.unproject(pixels, sight.depth[rows, columns].astype(np.float64))
    found = ~there
    found[rows, columns] = partition.near(block, reach, places)
    points = sight.of_points(xyz)
    scale = np.array([shape[1] / sight.camera.width, shape[0] / sight.camera.height])
    inside = partition.near(block, reach, points.places)
    across, down = np.clip((points.pixels[inside] * scale).astype(np.int64), 0, np.array(shape[::-1]) - 1).T
    found[down, across] = True
    return np.asarray(cv2.dilate(found.view(np.uint8), np.ones((3, 3), np.uint8))).view(np.bool_)
