"""Ground truth of the demo capture: camera poses, surface and depth maps."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
import trimesh
from jaxtyping import Bool, Float64

from splatpipe.demo import CAPTURE
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.similarity import Similarity, fit_similarity

Poses = dict[str, Float64[np.ndarray, "4 4"]]
Triangles = Float64[np.ndarray, "m 3 3"]


def true_poses() -> Poses:
    """``cam_from_world`` of each photo by name; east, north, up in metres."""
    photos = json.loads((CAPTURE / "truth.json").read_text(encoding="utf-8"))["photos"]
    return {photo["name"]: np.array(photo["cam_from_world"]) for photo in photos}


def true_surface() -> Triangles:
    """The corners of all triangles of the scene; east, north, up in metres."""
    return np.asarray(trimesh.load_mesh(CAPTURE / "surface.ply").triangles, dtype=np.float64)


def centre(pose: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, " 3"]:
    """A camera's centre in the world."""
    return np.asarray(-pose[:3, :3].T @ pose[:3, 3])


def truth_from_model(poses: Mapping[str, Float64[np.ndarray, "4 4"]]) -> Similarity:
    """The least-squares similarity transform from a model's camera centres to the true ones.

    Args:
        poses: ``cam_from_world`` of the model's photos by their names, which are the capture's; at least three.

    Raises:
        KeyError: if a photo is not one of the capture.
    """
    true = true_poses()
    source = np.array([centre(pose) for pose in poses.values()])
    target = np.array([centre(true[name]) for name in poses])
    scale, rotation, translation = fit_similarity(source, target, np.ones(len(source)))
    return Similarity(float(scale), rotation, translation)


def depth_map(camera: Camera, triangles: Triangles) -> Float64[np.ndarray, "h w"]:
    """Depth of the first triangle on each pixel's ray, along the view axis; infinite where there is none.

    Exact at the pixel's centre, also for triangles that reach behind the camera: the edges are tested as planes through
    its centre (Olano and Greer: "Triangle Scan Conversion using 2D Homogeneous Coordinates", 1997).

    Args:
        camera: In the triangles' frame.
        triangles: Their corners.
    """
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    corners = triangles @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    corners = corners[_may_be_seen(camera, corners)]
    planes = np.cross(np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1))  # b × c, c × a, a × b
    volume = (corners[:, 0] * planes[:, 0]).sum(axis=1)
    solid = volume != 0.0  # seen edge-on, a triangle is a line
    depth = np.full((camera.height, camera.width), np.inf)
    for edges, det, box in zip(planes[solid], volume[solid], _boxes(camera, corners[solid]), strict=True):
        left, top, right, bottom = box
        across, down = x[left:right], y[top:bottom, None]
        weights = [(u * across + (v * down + w)) / det for u, v, w in edges]
        inside = (weights[0] >= 0.0) & (weights[1] >= 0.0) & (weights[2] >= 0.0)
        # 1/z: the sum of the corners' weights for the pixel's ray at depth 1.
        total = weights[0] + weights[1] + weights[2]
        inside &= total > 0.0
        there = depth[top:bottom, left:right]
        np.minimum(there, 1.0 / np.where(inside, total, 1.0), out=there, where=inside)
    return depth


def _may_be_seen(camera: Camera, corners: Triangles) -> Bool[np.ndarray, " m"]:
    """Triangles that do not lie entirely outside any one side of the frustum."""
    x, y, z = (corners[..., axis] for axis in range(3))
    column, row = x * camera.fx + z * camera.cx, y * camera.fy + z * camera.cy  # times depth: no division by it
    sides = (z, column, z * camera.width - column, row, z * camera.height - row)
    return np.asarray(~np.any([(side <= 0.0).all(axis=1) for side in sides], axis=0))


def _boxes(camera: Camera, corners: Triangles) -> list[list[int]]:
    """Left, top, right, bottom (exclusive) of the pixels that a triangle may cover: all, if it reaches behind."""
    z = corners[..., 2:]
    ahead = (z > 0.0).all(axis=(1, 2))
    safe = np.where(ahead[:, None, None], z, 1.0)
    places = camera.pixels_of(corners[..., :2] / safe)
    limit = np.array([camera.width, camera.height])
    low = np.clip(np.floor(places.min(axis=1) - 0.5), 0, limit)
    high = np.clip(np.ceil(places.max(axis=1) + 0.5), 0, limit)
    low, high = np.where(ahead[:, None], low, 0), np.where(ahead[:, None], high, limit)
    boxes: list[list[int]] = np.hstack([low, high]).astype(int).tolist()
    return boxes
