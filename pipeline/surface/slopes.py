"""Slopes of depth maps: how inverse depths grow from pixel to pixel."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from splatpipe.pipeline.raster import _native


def slopes(depth: Float32[np.ndarray, "h w"], focal_px: float) -> Float32[np.ndarray, "2 h w"]:
    """How inverse depths grow from each pixel to the next one to the right, and below; nan where that is not known.

    By least squares over pairs of pixels on both sides, up to two away, that lie in one plane with the pixel: depths
    that differ by no more than ten pixels' widths. From one side alone at a surface's rim; not known of a pixel without
    neighbours.

    Args:
        depth: Along the camera's z; 0 where there is none.
        focal_px: The camera's focal length.

    Raises:
        ValueError: if there are no pixels.
    """
    found = np.empty((2, *depth.shape), np.float32)
    _native.slopes(np.ascontiguousarray(depth), focal_px, found)
    return found
