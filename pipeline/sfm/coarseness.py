"""How much wider bounds in pixels have to be for large photos, whose keypoints are found in reduced ones."""

from __future__ import annotations

from collections.abc import Iterable

import pycolmap

# Presets look for keypoints in photos of 1,600 to 3,200 pixels, and COLMAP's bounds are made for such. In a photo of
# 5,472 the same keypoints err by as many pixels more; no capture that bounds were set on has more than 3,000.
USUAL_PX = 3200


def coarseness(cameras: Iterable[pycolmap.Camera]) -> float:
    """Times by which bounds in pixels are wider than those of photos of usual size; 1 for these and smaller ones.

    Args:
        cameras: Of the photos; the largest counts.
    """
    return max([1.0, *(float(max(camera.width, camera.height)) / USUAL_PX for camera in cameras)])
