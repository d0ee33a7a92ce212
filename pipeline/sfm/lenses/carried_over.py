"""Carry the lenses and poses of a trial, which adjusts some of the points, over to the whole model."""

from __future__ import annotations

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from splatpipe.pipeline.geometry.meeting_rays import ray_equations
from splatpipe.pipeline.sfm.lenses.held_out import MIN_ANGLE, TrackObservations, world_rays
from splatpipe.pipeline.sfm.lenses.lens_model import is_known, named_params, set_lens
from splatpipe.pipeline.sfm.model.structure import Observations, read_observations
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

REWEIGHTINGS = 3  # rounds of weighting rays by the distance to the point from the previous round
MIN_POINTS = 6  # points that turn and shift a photo of which the trial knew nothing


def carry_over(
    model: pycolmap.Reconstruction, lensed: pycolmap.Reconstruction, verified: ViewGraph
) -> pycolmap.Reconstruction:
    """Return a copy of the model with a trial's lenses and poses, and its points where their rays meet.

    That is close to adjusted, so one adjustment of everything is enough. Photos that the trial left out are turned and
    shifted to the points of the others; points whose rays are nearly parallel stay where they are.

    Args:
        model: The whole model, in the frame of the trial.
        lensed: The trial's model.
        verified: The view graph, with the keypoints of ``model``.
    """
    result = pycolmap.Reconstruction(model)
    for number, camera in result.cameras.items():
        lens = lensed.cameras[number]
        if is_known(lens.model_name):
            set_lens(camera, lens.model_name, named_params(lens))
    tried = set(lensed.reg_image_ids())
    left = sorted(set(result.reg_image_ids()) - tried)
    for number in sorted(tried):
        _set_pose(result.images[number], lensed.images[number].cam_from_world())
    seen = read_observations(result)
    points, meet = _meeting_points(result, verified, seen, ~np.isin(seen.photo, left))
    for number in left:
        _turn_to(result.images[number], verified, seen, points, meet)
    if left:
        points, meet = _meeting_points(result, verified, seen, np.ones(len(seen.photo), bool))
    held = result.points3D
    for row in np.flatnonzero(meet).tolist():
        held[int(seen.ids[row])].xyz = points[row]
    return result


def _set_pose(image: pycolmap.Image, pose: pycolmap.Rigid3d) -> None:
    image.frame.set_cam_from_world(image.camera_id, pose)


def _meeting_points(
    model: pycolmap.Reconstruction, verified: ViewGraph, seen: Observations, chosen: Bool[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, "m 3"], Bool[np.ndarray, " m"]]:
    """Return where the rays of the chosen observations meet, and the mask of points for which they do."""
    pixels = np.zeros((len(seen.photo), 2))
    for number in np.unique(seen.photo).tolist():
        mine = seen.of(number)
        pixels[mine] = verified.keypoints[number][seen.keypoint[mine]]
    row = seen.row[chosen]
    _, centres, rays = world_rays(model, TrackObservations(row, seen.photo[chosen], pixels[chosen]))
    weights = np.ones(len(row))
    for _ in range(REWEIGHTINGS):
        points, meet = ray_equations(row, len(seen.ids), centres, rays, weights).solved(MIN_ANGLE**2)
        distance = np.linalg.norm(points[row] - centres, axis=1)
        weights = np.where(meet[row], 1.0 / np.maximum(distance, 1e-9) ** 2, 0.0)
    return points, meet


def _turn_to(
    image: pycolmap.Image,
    verified: ViewGraph,
    seen: Observations,
    points: Float64[np.ndarray, "m 3"],
    known: Bool[np.ndarray, " m"],
) -> None:
    """Turn and shift a photo to the known ones of the points that it observes, if there are enough."""
    mine = seen.of(image.image_id)
    rows, keypoints = seen.row[mine][known[seen.row[mine]]], seen.keypoint[mine][known[seen.row[mine]]]
    if len(rows) < MIN_POINTS:
        return
    pixels = verified.keypoints[image.image_id][keypoints].astype(np.float64)
    found = pycolmap.refine_absolute_pose(
        image.cam_from_world(), pixels, points[rows], np.ones(len(rows), bool), image.camera
    )
    if found is not None:
        _set_pose(image, found["cam_from_world"])
