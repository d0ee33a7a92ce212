"""How much to widen pixel thresholds for large photos, whose keypoints are extracted from downscaled images."""

from __future__ import annotations

from collections.abc import Iterable

import pycolmap

# Presets extract keypoints at 1,600 to 3,200 pixels, and COLMAP's thresholds are made for such images. In a photo of
# 5,472 pixels the errors of the same keypoints scale accordingly; thresholds were set on captures of at most 3,000.
USUAL_PX = 3200


def pixel_tolerance_scale(cameras: Iterable[pycolmap.Camera]) -> float:
    """Return the factor by which to widen pixel thresholds; 1 for photos of the usual size and smaller.

    Args:
        cameras: The photos' cameras; the largest image counts.
    """
    return max([1.0, *(float(max(camera.width, camera.height)) / USUAL_PX for camera in cameras)])
