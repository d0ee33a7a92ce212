"""Photo depths, with gaps filled from the splat.

Photogrammetry takes precedence: on the demo its depths scatter half as much as those of the splat, which covers plain
and shiny surfaces better. The splat's surfaces lie behind the true ones, everywhere by about the same part of a pixel;
this offset is estimated from pixels with both depths and subtracted.
"""

from __future__ import annotations

import numpy as np

from splatpipe.pipeline.mvs.depth_maps import DepthMap

MIN_CONFIDENCE = 5  # of a rendered depth: with fewer, 3 in 4 on plain walls were more than 2 GSD off, else 1 in 8
SAME = 0.02  # of the depth, within which both are on the same surface
FEWEST = 1000  # pixels with both depths needed to estimate the offset


def filled(found: DepthMap, rendered: DepthMap) -> DepthMap:
    """Combine a photo's depths from both sources.

    Args:
        found: Depths estimated from photos.
        rendered: Depths rendered from the splat, at the same resolution.

    Returns:
        The photo's depths unchanged and, in their gaps, rendered depths that enough photos confirm, moved nearer by the
        offset between both where both are known.

    Raises:
        ValueError: if the sizes differ.
    """
    if found.depth.shape != rendered.depth.shape:
        raise ValueError(f"depths of {found.depth.shape} and of {rendered.depth.shape} are not of one grid")
    sure = rendered.confidence >= MIN_CONFIDENCE
    takes = sure & (found.confidence == 0)
    depth = np.where(takes, rendered.depth * np.float32(1.0 - behind(found, rendered)), found.depth)
    return DepthMap(depth.astype(np.float32), np.where(takes, rendered.confidence, found.confidence))


def behind(found: DepthMap, rendered: DepthMap) -> float:
    """Median offset of rendered behind photo depths, as a share of the depth; 0 if few pixels have both."""
    both = (found.confidence > 0) & (rendered.confidence >= MIN_CONFIDENCE)
    share = rendered.depth[both].astype(np.float64) / found.depth[both] - 1.0
    share = share[np.abs(share) < SAME]
    return float(np.median(share)) if share.size >= FEWEST else 0.0
