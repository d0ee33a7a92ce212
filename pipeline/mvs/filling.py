"""Photo depths, with gaps filled from the splat.

Photogrammetry takes precedence: on the demo its depths scatter half as much as those of the splat, which covers plain
and shiny surfaces better. The splat's surfaces lie behind the true ones, everywhere by about the same part of a pixel;
this offset is estimated from pixels with both depths and subtracted.
"""

from __future__ import annotations

import numpy as np

from splatpipe.pipeline.mvs.depth_maps import DepthMap

MIN_CONFIDENCE = 5  # rendered depths below it are not used: on plain walls, 3 in 4 were over 2 GSD off, 1 in 8 above it
MAX_DEPTH_DIFFERENCE = 0.02  # difference of two depths, relative, up to which they are one surface's
MIN_PIXELS = 1000  # pixels with both depths needed to estimate the offset


def fill_gaps(found: DepthMap, rendered: DepthMap) -> DepthMap:
    """Fill the gaps in a photo's depths with rendered ones.

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
        raise ValueError(f"depths of {found.depth.shape} and of {rendered.depth.shape} have different grids")
    sure = rendered.confidence >= MIN_CONFIDENCE
    fills = sure & (found.confidence == 0)
    depth = np.where(fills, rendered.depth * np.float32(1.0 - median_offset(found, rendered)), found.depth)
    return DepthMap(depth.astype(np.float32), np.where(fills, rendered.confidence, found.confidence))


def median_offset(found: DepthMap, rendered: DepthMap) -> float:
    """Median offset of rendered behind photo depths, as a share of the depth; 0 if few pixels have both."""
    both = (found.confidence > 0) & (rendered.confidence >= MIN_CONFIDENCE)
    share = rendered.depth[both].astype(np.float64) / found.depth[both] - 1.0
    share = share[np.abs(share) < MAX_DEPTH_DIFFERENCE]
    return float(np.median(share)) if share.size >= MIN_PIXELS else 0.0
