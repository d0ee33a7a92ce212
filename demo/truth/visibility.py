"""True visibility: which of the capture's photos see a place."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from splatpipe.demo.truth.depth_maps import load, true_cameras
from splatpipe.demo.truth.truth import Triangles, depth_map
from splatpipe.pipeline.geometry.camera import Camera

BEHIND_M = 0.03  # tolerance by which a photo's depth may be less than a visible place's: less than half a pixel's slant
MIN_COSINE = 0.087  # cosine of 85°: at flatter angles, a surface is seen as a line
HALF = 2  # divisor of the photos' size for computed depths
MIN_VIEWS = 3  # photos that determine a place's position with redundancy


@dataclass(frozen=True, eq=False)
class TrueView:
    """A photo's camera and its true depth map, metres along its axis; infinite where there is nothing."""

    camera: Camera
    depth: Float32[np.ndarray, "h w"]


def true_views(surface: Triangles, folder: Path | None = None) -> list[TrueView]:
    """Load or compute the true views of all photos of the capture.

    Args:
        surface: All triangles.
        folder: Output of ``demo.truth.depth_maps``; None to compute depths here, at half the size, in a CPU minute.
    """
    if folder is not None:
        held = [load(path) for path in sorted(folder.glob("*.npz"))]
        return [TrueView(camera, np.where(depth > 0.0, depth, np.float32(np.inf))) for camera, depth, _ in held]
    halves = [camera.scaled(camera.width // HALF, camera.height // HALF) for camera in true_cameras()[1]]
    return [TrueView(camera, depth_map(camera, surface).astype(np.float32)) for camera in halves]


def photos_that_see(
    places: Float64[np.ndarray, "n 3"], normals: Float64[np.ndarray, "n 3"], views: Iterable[TrueView]
) -> UInt8[np.ndarray, " n"]:
    """Count the photos that see each place of a surface.

    Args:
        places: East, north, up in metres.
        normals: Unit normals there, to either side.
        views: The photos.
    """
    count = np.zeros(len(places), np.uint8)
    for view in views:
        rows, pixels, depths = view.camera.in_view(places)
        rays = view.camera.centre() - places[rows]
        facing = np.abs((rays * normals[rows]).sum(axis=1)) > MIN_COSINE * np.linalg.norm(rays, axis=1)
        count[rows[facing & _is_first(view.depth, pixels, depths)]] += 1
    return count


def _is_first(
    depth: Float32[np.ndarray, "h w"], pixels: Float64[np.ndarray, "n 2"], expected: Float64[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Whether nothing occludes places, judged by the farthest of the four pixels around each."""
    farthest = cv2.dilate(depth, np.ones((2, 2), np.uint8), anchor=(1, 1), borderType=cv2.BORDER_REPLICATE)
    column, row = np.clip(np.floor(pixels + 0.5).astype(np.intp), 0, np.array(depth.shape[::-1]) - 1).T
    return np.asarray(expected <= farthest[row, column] + BEHIND_M)
