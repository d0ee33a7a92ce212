"""The photos and depths of a run, as the surface asks for them: in local metres, read when they are needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, UInt8

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.mvs.depth_maps import KeptMap
from splatpipe.pipeline.photos.photo_list import decode
from splatpipe.pipeline.photos.undistortion import Placed
from splatpipe.pipeline.surface.photo_samples import Lens, PhotoSource
from splatpipe.pipeline.surface.sources import DepthMap, DepthSource

LENS_STEP = 8.0  # pixels


@dataclass(frozen=True, eq=False)
class MetricMap:
    """A depth map in local metres.

    Attributes:
        camera: In the map's grid.
        depth: Along the camera's z, metres; 0 where none is known.
        confidence: How many other photos confirm it.
    """

    camera: Camera
    depth: Float32[np.ndarray, "h w"]
    confidence: UInt8[np.ndarray, "h w"]


def depth_sources(maps: Sequence[KeptMap], local_from_model: Similarity) -> list[DepthSource]:
    """Depth maps of the model's frame in local metres.

    Args:
        maps: What `depths` left.
        local_from_model: The frame's, in metres.
    """
    return [_in_metres(kept, local_from_model) for kept in maps]


def _in_metres(kept: KeptMap, local_from_model: Similarity) -> DepthSource:
    camera = replace(kept.camera, cam_from_world=local_from_model.camera_pose(kept.camera.cam_from_world))

    def load() -> DepthMap:
        found = kept.load()
        return MetricMap(camera, found.depth * np.float32(local_from_model.scale), found.confidence)

    return DepthSource(camera, load)


def times_finer(kept: Sequence[KeptMap], placed: Sequence[Placed]) -> list[float]:
    """How many of a photo's pixels, as it was flown, lie along one of its depths; 1 where the photo is not there.

    Args:
        kept: Depths.
        placed: Photos with their cameras.
    """
    focal = {view.photo.name: view.source.mean_focal_length() for view in placed}
    return [focal.get(each.camera.name, each.camera.fx) / each.camera.fx for each in kept]


def photo_sources(
    placed: Sequence[Placed],
    depths: Mapping[str, DepthSource],
    local_from_model: Similarity,
    folders: tuple[Path, Path],
) -> list[PhotoSource]:
    """The photos as flown, at their full size, through their lenses.

    Args:
        placed: With their pinhole cameras of full size.
        depths: By the photos' names; a photo without any colours nothing.
        local_from_model: The frame's, in metres.
        folders: The part ``ingest.photos``, and the user's photo folder.
    """
    lenses: dict[int, Lens] = {}
    sources = []
    for view in placed:
        number = view.target.camera_id
        if number not in lenses:
            lenses[number] = _lens(view.source, view.target)
        pose = np.vstack([view.image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        target = view.target
        focal = float(target.focal_length_x), float(target.focal_length_y)
        middle = float(target.principal_point_x), float(target.principal_point_y)
        camera = Camera(
            view.photo.name, target.width, target.height, *focal, *middle, local_from_model.camera_pose(pose)
        )
        load = partial(decode, view.photo, *folders)
        sources.append(PhotoSource(camera, load, depths.get(view.photo.name), lenses[number]))
    return sources


def _lens(source: pycolmap.Camera, target: pycolmap.Camera) -> Lens:
    columns = np.arange(0.0, target.width + LENS_STEP, LENS_STEP)
    rows = np.arange(0.0, target.height + LENS_STEP, LENS_STEP)
    pinhole: Float64[np.ndarray, "n 2"] = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    focal = [target.focal_length_x, target.focal_length_y]
    rays = (pinhole - [target.principal_point_x, target.principal_point_y]) / focal
    nodes = np.asarray(source.img_from_cam(np.column_stack([rays, np.ones(len(rays))])), np.float64)
    return Lens(source.width, source.height, LENS_STEP, nodes.reshape(len(rows), len(columns), 2))
