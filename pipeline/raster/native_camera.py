"""A camera in the form that native kernels take."""

from __future__ import annotations

import numpy as np

from splatpipe.pipeline.geometry.camera import Camera

NativeCamera = tuple[np.ndarray, tuple[int, int], tuple[float, float, float, float]]


def native_camera(camera: Camera) -> NativeCamera:
    """Pose, size, and focal lengths and principal point in pixels."""
    pose = np.ascontiguousarray(camera.cam_from_world, np.float64)
    return pose, (camera.width, camera.height), (camera.fx, camera.fy, camera.cx, camera.cy)
