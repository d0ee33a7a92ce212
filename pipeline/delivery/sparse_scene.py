"""The sparse points and the cameras' frusta as binary glTF, for any 3D viewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from numpy.typing import NDArray

from splatpipe.pipeline.delivery.delivery_frame import pose_in_world
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import Points
from splatpipe.pipeline.splat.containers.glb_container import FLOAT, UNSIGNED_BYTE, write_head
from splatpipe.pipeline.survey.crs.frames import Frame

FRUSTUM_PER_SPACING = 0.35  # depth of a drawn frustum over the distance to the next camera: they do not overlap
FRUSTUM_COLOUR = (255, 140, 0, 255)
FRUSTUM_PATHS = (1, 2, 3, 4, 1), (1, 0, 2, 3, 0, 4)  # through the centre, 0, and the image's corners
FRUSTUM_ENDS = [end for path in FRUSTUM_PATHS for pair in pairwise(path) for end in pair]
POINTS, LINES = 0, 1  # glTF's topologies
GLTF_FROM_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # +Z up to glTF's +Y up


def sparse_glb(points: Points, cameras: Sequence[Camera], frame: Frame) -> bytes:
    """The sparse points and the cameras' frusta as binary glTF, world units, +Y up.

    Args:
        points: In the model's frame.
        cameras: In the model's frame.
        frame: georef's.
    """
    meshes = []
    usable = np.isfinite(points.xyz).all(axis=1)
    if usable.any():
        xyz = frame.world_from_model.apply(points.xyz[usable]) @ GLTF_FROM_WORLD.T
        opaque = np.full((len(xyz), 1), 255, np.uint8)
        meshes.append(_Mesh("points", POINTS, xyz.astype("<f4"), np.hstack((points.rgb[usable], opaque))))
    if cameras:
        ends = _frusta(cameras, frame).astype("<f4")
        colours = np.tile(np.array(FRUSTUM_COLOUR, np.uint8), (len(ends), 1))
        meshes.append(_Mesh("cameras", LINES, ends, colours))
    arrays = [array for mesh in meshes for array in (mesh.positions, mesh.colours)]
    file = BytesIO()
    write_head(file, _document(meshes, arrays), sum(array.nbytes for array in arrays))
    return file.getvalue() + b"".join(array.tobytes() for array in arrays)


@dataclass(frozen=True)
class _Mesh:
    """What is drawn as one object: ``mode`` is glTF's topology."""

    name: str
    mode: int
    positions: Float32[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 4"]


def _document(meshes: Sequence[_Mesh], arrays: Sequence[NDArray[Any]]) -> dict[str, Any]:
    """The glTF document, section 3 of the specification: each array is a buffer view and an accessor."""
    starts = np.cumsum([0, *(array.nbytes for array in arrays)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes}
        for start, array in zip(starts, arrays, strict=False)
    ]
    plain = {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 0, "roughnessFactor": 0}}
    document: dict[str, Any] = {
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "asset": {"version": "2.0", "generator": "splatpipe"},
    }
    if not meshes:  # the specification allows no empty lists
        return {**document, "scenes": [{}]}
    return document | {
        "accessors": [_accessor(number, array) for number, array in enumerate(arrays)],
        "meshes": [
            {
                "name": mesh.name,
                "primitives": [
                    {"attributes": {"POSITION": 2 * k, "COLOR_0": 2 * k + 1}, "mode": mesh.mode, "material": 0}
                ],
            }
            for k, mesh in enumerate(meshes)
        ],
        "materials": [plain],
        "nodes": [{"name": mesh.name, "mesh": k} for k, mesh in enumerate(meshes)],
        "buffers": [{"byteLength": starts[-1]}],
        "bufferViews": views,
    }


def _accessor(view: int, array: NDArray[Any]) -> dict[str, Any]:
    is_colour = array.dtype == np.uint8
    kind = {"componentType": UNSIGNED_BYTE, "normalized": True} if is_colour else {"componentType": FLOAT}
    limits = {"max": array.max(axis=0).tolist(), "min": array.min(axis=0).tolist()}
    return {"bufferView": view, "byteOffset": 0, **kind, "count": len(array), "type": f"VEC{array.shape[1]}", **limits}


def _frusta(cameras: Sequence[Camera], frame: Frame) -> Float64[np.ndarray, "ends 3"]:
    """Ends of the line segments of the cameras' frusta, two each."""
    poses = [pose_in_world(camera, frame) for camera in cameras]
    depth = FRUSTUM_PER_SPACING * _camera_spacing(np.array([centre for _, centre in poses]))
    ends: list[Float64[np.ndarray, "18 3"]] = []
    for camera, (rotation, centre) in zip(cameras, poses, strict=True):
        u = (np.array([0.0, camera.width, camera.width, 0.0]) - camera.cx) / camera.fx
        v = (np.array([0.0, 0.0, camera.height, camera.height]) - camera.cy) / camera.fy
        corners = depth * np.stack((u, v, np.ones(4)), axis=1) @ rotation.T
        vertices = np.vstack((centre, centre + corners)) @ GLTF_FROM_WORLD.T
        ends.append(vertices[FRUSTUM_ENDS])
    return np.vstack(ends)


def _camera_spacing(centres: Float64[np.ndarray, "n 3"]) -> float:
    """Median distance from a camera to its nearest neighbour elsewhere, world units; 1 for a single place."""
    nearest = []
    for centre in centres:
        distance = np.linalg.norm(centres - centre, axis=1)
        nearest.append(float(np.min(distance[distance > 0.0], initial=np.inf)))
    spacing = float(np.median(nearest))
    return spacing if np.isfinite(spacing) else 1.0
