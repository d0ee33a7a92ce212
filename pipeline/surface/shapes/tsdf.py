"""A mesh from depths by a truncated signed distance function (TSDF; Curless and Levoy, SIGGRAPH 1996), with open3d.

Every voxel near the surface stores the mean signed distance to the surface along the photos' optical axes. Photos that
see through a voxel count as well, so they clear away the false surfaces of a single photo.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.surface.depths.photo_set import PhotoSet
from splatpipe.pipeline.surface.shapes.blocks import BAND, MIN_PHOTOS, SIDE, Blocks, Box, depths_in
from splatpipe.pipeline.surface.shapes.triangles import TriangleMesh, in_order

FARTHEST_M = 1e4  # open3d requires a depth limit
RADIUS_FACTOR = 1.01  # times a block's half diagonal: includes blocks that touch the view's sides, despite rounding


def open3d() -> Any:
    """Import open3d.

    Raises:
        MachineError: if it, or a system library that it needs, is not installed.
    """
    try:
        return importlib.import_module("open3d")
    except ModuleNotFoundError as error:
        raise MachineError(
            "The mesh is made by open3d, which is not installed.",
            hint=f"Install it: {sys.executable} -m pip install 'splatpipe[mesh]'",
        ) from error
    except (ImportError, OSError) as error:
        raise MachineError(
            f"The mesh is made by open3d, which cannot be loaded: {error}.",
            hint="On Debian and Ubuntu: apt-get install libusb-1.0-0 libgl1 libgomp1.",
        ) from error


def tsdf_mesh(photos: PhotoSet, box: Box, blocks: Blocks, threads: int, report: Reporter) -> TriangleMesh:
    """Mesh the surface that photos see, in an order that is independent of the number of threads.

    Args:
        photos: Photos with their depths.
        box: The part of the world to mesh.
        blocks: Voxel blocks near the surface.
        threads: Photos whose depths are read in parallel.
        report: Receives progress.

    Raises:
        MachineError: if open3d is not installed.
    """
    o3d = open3d()
    size = blocks.places.shape[1]
    if not size:
        return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    core = o3d.core
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1), (1)), blocks.voxel_m, SIDE, size, core.Device("CPU:0")
    )
    places = np.ascontiguousarray(blocks.places.T.astype(np.int32))
    grid.hashmap().activate(core.Tensor(places))
    numbers = photos.with_depths()
    for done, (camera, depth) in enumerate(_depths(photos, box, numbers, threads), start=1):
        near = np.flatnonzero(_in_view(camera, blocks))
        if near.size:
            intrinsic, extrinsic = core.Tensor(camera.k()), core.Tensor(_pose(camera, blocks))
            image = o3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(depth)))
            grid.integrate(core.Tensor(places[near]), image, intrinsic, extrinsic, 1.0, FARTHEST_M, BAND)
        report.progress(done, len(numbers), "joining depths to a surface", "photos")
    found = grid.extract_triangle_mesh(MIN_PHOTOS - 0.5)  # open3d omits voxels of that weight or less
    vertices = found.vertex.positions.numpy().astype(np.float64) + blocks.low
    return in_order(TriangleMesh(vertices, found.triangle.indices.numpy().astype(np.int64)))


def _depths(
    photos: PhotoSet, box: Box, numbers: list[int], threads: int
) -> Iterator[tuple[Camera, Float32[np.ndarray, "h w"]]]:
    return ordered_map(partial(_depths_of, photos, box), numbers, threads)


def _depths_of(photos: PhotoSet, box: Box, number: int) -> tuple[Camera, Float32[np.ndarray, "h w"]]:
    found = photos.depth_map(number)
    return found.camera, depths_in(box, found)


def _pose(camera: Camera, blocks: Blocks) -> np.ndarray:
    """Camera pose relative to the blocks' corner: coordinates near zero, where float32 is precise enough."""
    pose = camera.cam_from_world.copy()
    pose[:3, 3] += pose[:3, :3] @ blocks.low
    return pose


def _in_view(camera: Camera, blocks: Blocks) -> Bool[np.ndarray, " n"]:
    """Blocks that may be partly inside a camera's view."""
    reach = RADIUS_FACTOR * SIDE * blocks.voxel_m * np.sqrt(3.0) / 2.0
    pose = camera.cam_from_world
    x, y, depth = pose[:3, :3] @ blocks.centres() + pose[:3, 3:]
    inside = depth > -reach
    for along, focal, centre, size in (
        (x, camera.fx, camera.cx, camera.width),
        (y, camera.fy, camera.cy, camera.height),
    ):
        for edge, sign in ((0.0, 1.0), (float(size), -1.0)):  # the sides of the view are planes through the camera
            slope = (edge - centre) / focal
            inside &= sign * (along - slope * depth) > -reach * np.hypot(1.0, slope)
    return np.asarray(inside)
