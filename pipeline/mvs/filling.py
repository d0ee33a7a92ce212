"""Depths found in a photo, and where there are none those of the splat.

Photogrammetry leads wherever it finds something: on the demo its depths scatter half as much as those of the splat,
which knows more of what is plain or shiny. Its surfaces lie behind the true ones, everywhere by about the same part of
a pixel, so that is taken off: the photo tells how much it is.
"""

from __future__ import annotations

import numpy as np

from splatpipe.pipeline.mvs.depth_maps import DepthMap

LEAST_CONFIDENCE = 5  # of a rendered depth: with fewer, 3 in 4 on plain walls were more than 2 GSD off, else 1 in 8
SAME = 0.02  # of the depth, within which both mean the same surface
FEWEST = 1000  # pixels that have both, to tell how far apart they are


def filled(found: DepthMap, rendered: DepthMap) -> DepthMap:
    """A photo's depths from both sources.

    Args:
        found: In the photo.
        rendered: From the splat, in the same grid.

    Returns:
        What was found, as it was, and elsewhere rendered depths that enough photos confirm, nearer by as much as they
        are farther where both are known.

    Raises:
        ValueError: if the grids differ.
    """
    if found.depth.shape != rendered.depth.shape:
        raise ValueError(f"depths of {found.depth.shape} and of {rendered.depth.shape} are not of one grid")
    sure = rendered.confidence >= LEAST_CONFIDENCE
    takes = sure & (found.confidence == 0)
    depth = np.where(takes, rendered.depth * np.float32(1.0 - behind(found, rendered)), found.depth)
    return DepthMap(depth.astype(np.float32), np.where(takes, rendered.confidence, found.confidence))


def behind(found: DepthMap, rendered: DepthMap) -> float:
    """How far rendered depths lie behind those found, as a share of the depth: the median; 0 where few have both."""
    both = (found.confidence > 0) & (rendered.confidence >= LEAST_CONFIDENCE)
    share = rendered.depth[both].astype(np.float64) / found.depth[both] - 1.0
    share = share[np.abs(share) < SAME]
    return float(np.median(share)) if share.size >= FEWEST else 0.0
