"""Carry the lenses and poses of a trial, which adjusts some of the points, over to the whole model."""

from __future__ import annotations

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from splatpipe.pipeline.geometry.meeting_rays import ray_equations
from splatpipe.pipeline.geometry.similarity import Similarity, fit_similarity
from splatpipe.pipeline.sfm.lenses.held_out import TrackObservations, world_rays
from splatpipe.pipeline.sfm.lenses.lens_model import is_known, named_params, set_lens
from splatpipe.pipeline.sfm.model.structure import Observations, read_observations
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph

REWEIGHTINGS = 3  # rounds of weighting rays by the distance to the point from the previous round
MEETING_RATIO = 1e-4  # two rays that meet at 1.1 degrees; mapping keeps points from 1.5
MIN_POINTS = 6  # points that turn and shift a photo of which the trial knew nothing


def carry_over(
    model: pycolmap.Reconstruction, lensed: pycolmap.Reconstruction, verified: ViewGraph
) -> pycolmap.Reconstruction:
    """Return a copy of the model with a trial's lenses and poses, and its points where their rays meet.

    That is close to adjusted, so one adjustment of everything is enough. A trial also moves everything a little, since
    it holds the first photo while the principal point moves: what it left out, photos and points whose rays are nearly
    parallel, moves along; such photos are then turned and shifted to the points of the others.

    Args:
        model: The whole model.
        lensed: The trial's model, of some of its points and photos.
        verified: The view graph, with the keypoints of ``model``.
    """
    result = pycolmap.Reconstruction(model)
    for number, camera in result.cameras.items():
        lens = lensed.cameras[number]
        if is_known(lens.model_name):
            set_lens(camera, lens.model_name, named_params(lens))
    tried = set(lensed.reg_image_ids())
    for number in sorted(tried):
        _set_pose(result.images[number], lensed.images[number].cam_from_world())
    seen = read_observations(result)
    points, meet = _meeting_points(result, verified, seen, tried)
    if int(meet.sum()) < MIN_POINTS:
        return result
    scale, rotation, translation = fit_similarity(seen.points[meet], points[meet], np.ones(int(meet.sum())))
    along = Similarity(float(scale), rotation, translation)
    turned = set()
    for number in sorted(set(result.reg_image_ids()) - tried):
        image, pose = result.images[number], np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        _set_pose(image, pycolmap.Rigid3d(along.camera_pose(pose)[:3]))
        if _turn(image, verified, seen, points, meet):
            turned.add(number)
    if turned:
        points, meet = _meeting_points(result, verified, seen, tried | turned)
    held, moved = result.points3D, np.where(meet[:, None], points, along.apply(seen.points))
    for number, place in zip(seen.ids.tolist(), moved, strict=True):
        held[number].xyz = place
    return result


def _set_pose(image: pycolmap.Image, pose: pycolmap.Rigid3d) -> None:
    image.frame.set_cam_from_world(image.camera_id, pose)


def _meeting_points(
    model: pycolmap.Reconstruction, verified: ViewGraph, seen: Observations, photos: set[int]
) -> tuple[Float64[np.ndarray, "m 3"], Bool[np.ndarray, " m"]]:
    """Return where the rays from some photos meet, and the mask of points for which they do, before all cameras."""
    chosen = np.isin(seen.photo, sorted(photos))
    photo, row = seen.photo[chosen], seen.row[chosen]
    listed = [verified.keypoints[number][seen.keypoint[seen.of(number)]] for number in sorted(photos)]
    pixels = np.concatenate([np.zeros((0, 2)), *listed])
    _, centres, rays = world_rays(model, TrackObservations(row, photo, pixels))
    sound = np.any(rays, axis=1)  # where the lens's distortion cannot be inverted, there is no ray
    weights = sound.astype(np.float64)
    points, meet = np.zeros((len(seen.ids), 3)), np.zeros(len(seen.ids), bool)
    for _ in range(REWEIGHTINGS):
        points, meet = ray_equations(row, len(seen.ids), centres, rays, weights).solved(MEETING_RATIO)
        distance = np.linalg.norm(points[row] - centres, axis=1)
        weights = np.where(sound & meet[row], 1.0 / np.maximum(distance, 1e-9) ** 2, 0.0)
    behind = sound & (np.einsum("ni,ni->n", points[row] - centres, rays) <= 0.0)
    meet[row[behind]] = False
    return points, meet


def _turn(
    image: pycolmap.Image,
    verified: ViewGraph,
    seen: Observations,
    points: Float64[np.ndarray, "m 3"],
    known: Bool[np.ndarray, " m"],
) -> bool:
    """Turn and shift a photo to the known ones of the points that it observes; return whether there were enough."""
    mine = seen.of(image.image_id)
    of_known = known[seen.row[mine]]
    rows, keypoints = seen.row[mine][of_known], seen.keypoint[mine][of_known]
    if len(rows) < MIN_POINTS:
        return False
    pixels = verified.keypoints[image.image_id][keypoints].astype(np.float64)
    found = pycolmap.refine_absolute_pose(
        image.cam_from_world(), pixels, points[rows], np.ones(len(rows), bool), image.camera
    )
    if found is not None:
        _set_pose(image, found["cam_from_world"])
    return found is not None
