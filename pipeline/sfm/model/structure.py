"""Convert a model's points and tracks to arrays, and arrays back to a model on a view graph's keypoints."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64

from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

Track = list[tuple[int, int]]
"""Photo and keypoint of each observation, sorted."""


@dataclass(frozen=True)
class Structure:
    """Points in a fixed order, sorted by track.

    Attributes:
        points: (m, 3), model units.
        tracks: The observations of each.
    """

    points: Float64[np.ndarray, "m 3"]
    tracks: Sequence[Track]

    def rows(self, counts: Mapping[int, int]) -> dict[int, Int64[np.ndarray, " _"]]:
        """Return, for every photo, the row of the point that each keypoint observes, or -1.

        Args:
            counts: Number of keypoints of each photo.
        """
        found = {number: np.full(count, -1, np.int64) for number, count in counts.items()}
        for row, track in enumerate(self.tracks):
            for photo, keypoint in track:
                found[photo][keypoint] = row
        return found


def read_structure(model: pycolmap.Reconstruction) -> Structure:
    """Return the points and tracks of a model.

    Observations are read photo by photo: reading them point by point takes three times as long.
    """
    images = [model.images[number] for number in sorted(model.reg_image_ids())]
    keypoints = [image.get_observation_point2D_idxs() for image in images]
    ids = np.array([seen.point3D_id for image in images for seen in image.get_observation_points2D()], np.int64)
    numbers, first, which = np.unique(ids, return_index=True, return_inverse=True)
    order = np.argsort(first)  # by the first observation, which no two tracks share: sorted by track
    rows = np.argsort(order)[which]
    listed = ((image.image_id, keypoint) for image, seen in zip(images, keypoints, strict=True) for keypoint in seen)
    tracks: list[Track] = [[] for _ in numbers]
    for row, element in zip(rows.tolist(), listed, strict=True):
        tracks[row].append(element)
    points = model.points3D
    places = [points[number].xyz for number in numbers[order].tolist()]
    return Structure(np.array(places, np.float64).reshape(-1, 3), tracks)


def make_model(
    cameras: Iterable[pycolmap.Camera],
    poses: Mapping[int, pycolmap.Rigid3d],
    verified: ViewGraph,
    structure: Structure,
) -> pycolmap.Reconstruction:
    """Build a model whose photos have all keypoints of a view graph, including those added since.

    Args:
        cameras: The photos' cameras, as calibrated.
        poses: cam_from_world of the placed photos.
        verified: Names, cameras and keypoints of the photos.
        structure: Observations of placed photos only; points of fewer than two are left out.
    """
    model = pycolmap.Reconstruction()
    for camera in sorted(cameras, key=lambda camera: camera.camera_id):
        model.add_camera_with_trivial_rig(camera)
    for number in sorted(poses):
        places = verified.keypoints[number].astype(np.float64)
        image = pycolmap.Image(verified.names[number], places, verified.camera_of[number], number)
        model.add_image_with_trivial_frame(image, poses[number])
    grey = np.zeros(3, np.uint8)  # the keypoints have the colours
    for place, track in zip(structure.points, structure.tracks, strict=True):
        if len(track) >= 2:
            elements = [pycolmap.TrackElement(*element) for element in track]
            model.add_point3D(place, pycolmap.Track(elements), grey)
    model.update_point_3d_errors()
    return model


def poses_of(model: pycolmap.Reconstruction) -> dict[int, pycolmap.Rigid3d]:
    """Return cam_from_world of every placed photo."""
    return {number: model.images[number].cam_from_world() for number in sorted(model.reg_image_ids())}


def cameras_of(model: pycolmap.Reconstruction) -> dict[int, pycolmap.Camera]:
    """Return the cameras of the placed photos, by number."""
    used = {model.images[number].camera_id for number in model.reg_image_ids()}
    return {number: model.cameras[number] for number in sorted(used)}


def without(model: pycolmap.Reconstruction, verified: ViewGraph, photos: Collection[int]) -> pycolmap.Reconstruction:
    """Return the model without some photos and without the points that fewer than two other photos observe."""
    structure = read_structure(model)
    tracks = [[element for element in track if element[0] not in photos] for track in structure.tracks]
    poses = {number: pose for number, pose in poses_of(model).items() if number not in photos}
    used = {verified.camera_of[number] for number in poses}
    cameras = [camera for number, camera in cameras_of(model).items() if number in used]
    return make_model(cameras, poses, verified, Structure(structure.points, tracks))


def loosely_tied(model: pycolmap.Reconstruction) -> set[int]:
    """Return the photos whose points only one other photo observes: how far they are from it, nothing determines.

    None of a model of two photos, whose scale is free.
    """
    if model.num_reg_images() <= 2:
        return set()
    partners: dict[int, set[int]] = {number: set() for number in model.reg_image_ids()}
    for point in model.points3D.values():
        photos = {element.image_id for element in point.track.elements}
        for number in photos:
            partners[number] |= photos
    return {number for number, seen in partners.items() if len(seen) <= 2}  # it and the other one
