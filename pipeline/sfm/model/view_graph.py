"""The result of matching in memory: each photo's keypoints and the verified matches between pairs of photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float32, UInt32


@dataclass(frozen=True)
class ViewGraph:
    """The view graph; images and cameras have COLMAP's numbers, which count from 1 in name order.

    Attributes:
        names: Names of all photos, placed or not.
        camera_of: Camera id of each photo.
        cameras: As they were before mapping: focal lengths from the metadata.
        keypoints: Locations in the stored pixel grid, pixels; the centre of the first pixel is at (0.5, 0.5).
        matches: For each pair (i, j), i < j, that has any: keypoint rows in i and in j, geometrically verified.
    """

    names: Mapping[int, str]
    camera_of: Mapping[int, int]
    cameras: Mapping[int, pycolmap.Camera]
    keypoints: Mapping[int, Float32[np.ndarray, "_ 2"]]
    matches: Mapping[tuple[int, int], UInt32[np.ndarray, "_ 2"]]


def read_verified(database: Path) -> ViewGraph:
    """Read the view graph from the database that matching wrote."""
    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.image_id)
        keypoints = {
            image.image_id: np.ascontiguousarray(
                np.asarray(opened.read_keypoints(image.image_id), np.float32).reshape(-1, 6)[:, :2]
            )
            for image in images
        }
        numbers, geometries = opened.read_two_view_geometries()
        found = {}
        for pair, geometry in sorted(zip(numbers, geometries, strict=True), key=lambda entry: entry[0]):
            i, j = pycolmap.pair_id_to_image_pair(pair)
            rows = np.asarray(geometry.inlier_matches, np.uint32).reshape(-1, 2)
            if len(rows):
                found[i, j] = rows if i < j else np.ascontiguousarray(rows[:, ::-1])
        return ViewGraph(
            names={image.image_id: image.name for image in images},
            camera_of={image.image_id: image.camera_id for image in images},
            cameras={camera.camera_id: camera for camera in opened.read_all_cameras()},
            keypoints=keypoints,
            matches={tuple(sorted(pair)): rows for pair, rows in found.items()},
        )
