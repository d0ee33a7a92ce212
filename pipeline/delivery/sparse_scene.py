"""The sparse points and the cameras' frusta as binary glTF, for any 3D viewer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from jaxtyping import Float64

from splatpipe.pipeline.delivery.delivery_frame import pose_in_world
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import Points
from splatpipe.pipeline.survey.crs.frames import Frame

FRUSTUM_PER_SPACING = 0.35  # depth of a drawn frustum over the distance to the next camera: they do not overlap
FRUSTUM_COLOUR = (255, 140, 0, 255)
GLTF_FROM_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # +Z up to glTF's +Y up


def sparse_glb(points: Points, cameras: Sequence[Camera], frame: Frame) -> bytes:
    """The sparse points and the cameras' frusta as binary glTF, world units, +Y up.

    Args:
        points: In the model's frame.
        cameras: In the model's frame.
        frame: georef's.
    """
    scene = trimesh.Scene()
    usable = np.isfinite(points.xyz).all(axis=1)
    if usable.any():
        xyz = frame.world_from_model.apply(points.xyz[usable]) @ GLTF_FROM_WORLD.T
        opaque = np.full((len(xyz), 1), 255, np.uint8)
        cloud = trimesh.PointCloud(xyz, colors=np.hstack((points.rgb[usable], opaque)))
        scene.add_geometry(cloud, geom_name="points", node_name="points")
    if cameras:
        scene.add_geometry(_frusta(cameras, frame), geom_name="cameras", node_name="cameras")
    return bytes(scene.export(file_type="glb"))


def _frusta(cameras: Sequence[Camera], frame: Frame) -> trimesh.path.Path3D:
    poses = [pose_in_world(camera, frame) for camera in cameras]
    depth = FRUSTUM_PER_SPACING * _camera_spacing(np.array([centre for _, centre in poses]))
    vertices: list[Float64[np.ndarray, "5 3"]] = []
    lines: list[list[int]] = []
    for camera, (rotation, centre) in zip(cameras, poses, strict=True):
        u = (np.array([0.0, camera.width, camera.width, 0.0]) - camera.cx) / camera.fx
        v = (np.array([0.0, 0.0, camera.height, camera.height]) - camera.cy) / camera.fy
        corners = depth * np.stack((u, v, np.ones(4)), axis=1) @ rotation.T
        first = 5 * len(lines) // 2
        vertices.append(np.vstack((centre, centre + corners)) @ GLTF_FROM_WORLD.T)
        ring = [first + 1, first + 2, first + 3, first + 4, first + 1]
        lines += [ring, [first + 1, first, first + 2, first + 3, first, first + 4]]
    entities = [trimesh.path.entities.Line(line) for line in lines]
    colours = np.tile(np.array(FRUSTUM_COLOUR, np.uint8), (len(entities), 1))
    return trimesh.path.Path3D(entities, vertices=np.vstack(vertices), process=False, colors=colours)


def _camera_spacing(centres: Float64[np.ndarray, "n 3"]) -> float:
    """Median distance from a camera to its nearest neighbour elsewhere, world units; 1 for a single place."""
    nearest = []
    for centre in centres:
        distance = np.linalg.norm(centres - centre, axis=1)
        nearest.append(float(np.min(distance[distance > 0.0], initial=np.inf)))
    spacing = float(np.median(nearest))
    return spacing if np.isfinite(spacing) else 1.0
