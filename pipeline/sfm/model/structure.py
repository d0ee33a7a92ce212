"""Convert a model's points and observations to arrays, and arrays back to a model on a view graph's keypoints."""

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


@dataclass(frozen=True)
class Observations:
    """Points of a model, and the observations of them by all photos or by some, photo by photo.

    Attributes:
        photo: COLMAP's number of the photo of each observation, ascending.
        keypoint: Its keypoint, ascending within a photo.
        row: The row of its point.
        ids: (m,) COLMAP's ids of the points, in the order of their first observations, which is that of their tracks.
        points: (m, 3), model units.
    """

    photo: Int64[np.ndarray, " n"]
    keypoint: Int64[np.ndarray, " n"]
    row: Int64[np.ndarray, " n"]
    ids: Int64[np.ndarray, " m"]
    points: Float64[np.ndarray, "m 3"]

    def of(self, photo: int) -> slice:
        """Return the rows of a photo's observations."""
        return slice(*np.searchsorted(self.photo, [photo, photo + 1]).tolist())

    def rows(self, counts: Mapping[int, int]) -> dict[int, Int64[np.ndarray, " _"]]:
        """Return, for every photo, the row of the point that each keypoint observes, or -1.

        Args:
            counts: Number of keypoints of each photo.
        """
        found = {}
        for number, count in counts.items():
            mine = self.of(number)
            found[number] = np.full(count, -1, np.int64)
            found[number][self.keypoint[mine]] = self.row[mine]
        return found

    def structure(self) -> Structure:
        """Return the points with their tracks."""
        tracks: list[Track] = [[] for _ in self.ids]
        listed = zip(self.photo.tolist(), self.keypoint.tolist(), strict=True)
        for row, element in zip(self.row.tolist(), listed, strict=True):
            tracks[row].append(element)
        return Structure(self.points, tracks)


def read_observations(model: pycolmap.Reconstruction, photos: Collection[int] | None = None) -> Observations:
    """Return the observations of some placed photos, or of all, and the points that they observe.

    They are read photo by photo: reading them point by point takes three times as long.
    """
    images = [model.images[number] for number in sorted(model.reg_image_ids() if photos is None else photos)]
    seen = [observed_points(image) for image in images]
    photo = np.repeat(np.array([image.image_id for image in images], np.int64), [len(ids) for _, ids in seen])
    keypoint = np.concatenate([np.zeros(0, np.int64), *(keypoints for keypoints, _ in seen)])
    observed = np.concatenate([np.zeros(0, np.int64), *(ids for _, ids in seen)])
    ids, first, which = np.unique(observed, return_index=True, return_inverse=True)
    order = np.argsort(first)
    points = model.points3D
    places = np.array([points[number].xyz for number in ids[order].tolist()], np.float64).reshape(-1, 3)
    return Observations(photo, keypoint, np.argsort(order)[which], ids[order], places)


def observed_points(image: pycolmap.Image) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """Return the keypoints of a photo that observe a point, ascending, and the ids of these points."""
    ids = np.array([seen.point3D_id for seen in image.get_observation_points2D()], np.int64)
    return np.array(image.get_observation_point2D_idxs(), np.int64), ids


def read_structure(model: pycolmap.Reconstruction) -> Structure:
    """Return the points and tracks of a model."""
    return read_observations(model).structure()


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


def without(model: pycolmap.Reconstruction, photos: Collection[int]) -> pycolmap.Reconstruction:
    """Return the model without some photos and without the points that fewer than two other photos observe."""
    left = pycolmap.Reconstruction(model)
    observations = pycolmap.ObservationManager(left)
    for number in sorted(set(photos).intersection(left.reg_image_ids())):  # an adjustment may have dropped some
        observations.deregister_frame(left.images[number].frame_id)
    left.tear_down()
    left.update_point_3d_errors()
    return left


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
